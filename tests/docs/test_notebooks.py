"""The notebooks run as they stand, hold what they gave when they ran, and install metrpo where it is missing."""

import base64
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import notebooks
from places import ROOT, SUPPORT

NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
PLACES = ("/home/", "/root/", "/tmp/", "/work/", "C:\\")
"""Parts of paths of the machine on which they were run."""


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook, tmp_path):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    ran = subprocess.run(
        [sys.executable, SUPPORT / "notebooks.py", notebook],
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    told = [line.split()[0] for line in stored_text(notebooks.cells(notebook)[-1]).splitlines()]
    assert [line.split()[0] for line in ran.stdout.splitlines()][-len(told) :] == told, "as in its last output"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_what_it_gave(notebook):
    cells = notebooks.cells(notebook)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), "run from top to bottom"
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    pictures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert pictures
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for picture in pictures)
    text = notebook.read_text("utf-8")
    assert len(text) < 200_000
    assert not [place for place in PLACES if place in text]
    shape = json.loads(text)
    assert (shape["nbformat"], shape["metadata"]["kernelspec"]["name"]) == (4, "python3")
    assert len({cell["id"] for cell in shape["cells"]}) == len(shape["cells"])


@pytest.mark.parametrize("missing", [True, False])
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_first_cell_installs_metrpo_where_it_is_missing(notebook, missing, monkeypatch):
    asked = []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if missing else name)
    monkeypatch.setattr(subprocess, "run", lambda words, check: asked.append(words[1:]))
    exec("".join(notebooks.cells(notebook)[0]["source"]), {})
    assert asked == [["-m", "pip", "install", "--quiet", "metrpo"]] * missing


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["own_environment", "quick_start"]


def stored_text(cell):
    return "".join("".join(output.get("text", "")) for output in cell["outputs"])
