"""The tutorial's code does what it says."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest

from metrpo.commands import main
from metrpo.run import machine
from metrpo.run.metrics import read_metrics
from places import ROOT

PAGE = ROOT / "docs" / "tutorial.md"
FEW = ["--collect.steps", "1500", "--imagine.steps", "500", "--validate.max-updates", "5", "--fit.max-steps", "20"]


def blocks(language):
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return [code for name, code in fenced if name == language]


@pytest.fixture
def there(tmp_path, monkeypatch):
    """The tutorial's files in an empty directory, which is the current one."""
    for code in blocks("python"):
        name = re.match(r"# (\w+\.py)\n", code)[1]
        (tmp_path / name).write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(machine, "prepare", lambda *_: None)
    return tmp_path


def commands():
    return [line.split()[1:] for line in blocks("")[0].splitlines() if line.startswith("metrpo ")]


def test_it_has_forty_lines_of_code():
    lines = [line for code in (*blocks("python"), *blocks("")) for line in code.splitlines() if line.strip()]
    assert len(lines) <= 40


def test_every_command_works_and_the_policy_drives(there, capsys):
    train, evaluate, export = commands()
    assert main.main([*train, *FEW, "--evaluation-episodes", "1", "--no-video"]) == 0
    rows = read_metrics(there / "runs" / "cart" / "metrics.csv")
    assert rows[-1]["real_steps"] >= 3000
    assert main.main(evaluate) == 0
    assert "cart.py:task: return" in capsys.readouterr().out
    assert main.main(export) == 0
    done = subprocess.run([sys.executable, "drive.py"], capture_output=True, text=True)
    force = np.array(done.stdout.strip(" []\n").split(), float)
    assert done.returncode == 0, done.stderr
    assert force.shape == (1,)
    assert np.abs(force).max() <= 2


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_cart_is_brought_to_the_middle(there):
    """As the tutorial has it, 3,000 real steps: -10 when measured. No force earns -108, a tuned PD controller -4.4."""
    assert main.main([*commands()[0], "--no-video"]) == 0
    rows = read_metrics(there / "runs" / "cart" / "metrics.csv")
    assert rows[-1]["return_real"] > -15
