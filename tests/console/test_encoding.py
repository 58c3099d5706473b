"""Output on terminals, pipes and logs that are not Unicode, and users who have no home."""

import io
import os
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from rich.console import Console

from metrpo.console.encoding import print_anywhere
from metrpo.console.progress import LiveProgress, PlainProgress
from metrpo.run import machine
from places import GUARANTEES, SUPPORT

ROW = {"iteration": 1, "real_steps": 200, "return_real": 1.5, "return_real_std": 0.5}


def written(encoding, say):
    """What `say()` leaves on a stdout of this encoding, as bytes."""
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding, write_through=True)
    with redirect_stdout(stream), redirect_stderr(io.TextIOWrapper(io.BytesIO(), encoding)):
        print_anywhere()
        say()
    return raw.getvalue()


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("3.1 ± 0.2", b"3.1 +- 0.2\n"),
        ("• 2 × 5 … ∞", b"* 2 x 5 ... inf\n"),
        ("▁▂▃▄▅▆▇█", b"_.,-=+*#\n"),
        ("Zoë, 机", b"Zoe, ?\n"),
        ("runs/\udcff", b"runs/\\xff\n"),
        ("plain", b"plain\n"),
    ],
)
def test_ascii_gets_what_it_can_show(text, plain):
    assert written("ascii", lambda: print(text)) == plain


def test_what_an_encoding_has_stays():
    assert written("latin-1", lambda: print("3.1 ± 0.2, ▁")) == b"3.1 \xb1 0.2, _\n"
    assert written("utf-8", lambda: print("3.1 ± 0.2, ▁")) == "3.1 ± 0.2, ▁\n".encode()


def test_stderr_too_and_streams_that_are_no_files():
    error = io.TextIOWrapper(raw := io.BytesIO(), "ascii", write_through=True)
    with redirect_stdout(io.StringIO()), redirect_stderr(error):
        print_anywhere()
        print("±", file=sys.stderr)
    assert raw.getvalue() == b"+-\n"


def test_progress_is_told_on_an_ascii_terminal():
    assert b"1.5 +- 0.5" in written("ascii", lambda: PlainProgress().end(ROW))

    def live():
        shown = LiveProgress(Console(force_terminal=True))
        shown.begin(1, 2)
        shown.stage("fit", 10)
        shown.update(3)
        shown.end(ROW)
        shown.close()

    assert b"1.5 +- 0.5" in written("ascii", live)


@pytest.fixture
def a_run(tmp_path):
    """A finished run of the probe."""
    return Path(shutil.copytree(GUARANTEES / "format-1", tmp_path / "run"))


EVERY = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import probe
from metrpo.commands import main
from metrpo.commands.train import say_outcome
with probe.registered():
    for command in (["--help"], ["evaluate", sys.argv[2], "--episodes", "1"], ["watch", sys.argv[2], "--once"]):
        assert main.main(command) == 0, command
        print("=====")
    say_outcome(Path(sys.argv[2]), video=False)  # what a finished run says
"""


def test_commands_end_well_in_the_c_locale(a_run):
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": ""}
    command = [sys.executable, "-c", EVERY, str(SUPPORT), str(a_run)]
    ran = subprocess.run(command, env=environment, capture_output=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.isascii()
    _, evaluated, watched, trained = ran.stdout.decode().split("=====")
    assert "+- 0.00 (min" in evaluated
    assert "me-trpo" in watched
    assert " +- " in trained
    assert "policy.npz" in trained


HOMELESS = """
import os, pwd, sys
def unknown(*_):
    raise KeyError("getpwuid(): uid not found")
pwd.getpwuid = unknown  # as for a number that no passwd entry names
from metrpo.commands import main
sys.exit(main.main(sys.argv[1:]))
"""


def without_home(*arguments, **variables):
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR")}
    command = [sys.executable, "-c", HOMELESS, *arguments]
    return subprocess.run(command, env=environment | variables, capture_output=True, text=True)


def test_a_user_without_a_home_gets_everything(a_run, tmp_path):
    found = without_home("train", "Swimmer", "--help", TMPDIR=str(tmp_path))
    assert (found.returncode, found.stderr) == (0, "")
    drawn = without_home("plot", str(a_run), "--out", str(tmp_path / "curve.svg"), TMPDIR=str(tmp_path))
    assert (drawn.returncode, drawn.stderr) == (0, "")
    assert (tmp_path / f"metrpo-cache-{os.getuid()}").is_dir()


def test_the_cache_lies_where_one_may_write(monkeypatch, tmp_path):
    for name in ("XDG_CACHE_HOME", "MPLCONFIGDIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert machine.cache_folder() == tmp_path / ".cache" / "metrpo"
    monkeypatch.setattr(machine.os, "access", lambda *_: False)  # HOME=/ in a container
    assert machine.cache_folder().name == f"metrpo-cache-{os.getuid()}"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "named"))
    assert machine.cache_folder() == tmp_path / "named" / "metrpo"
