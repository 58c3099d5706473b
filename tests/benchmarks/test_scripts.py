"""Every script under `benchmarks/` finds what it imports from the package, whatever was renamed there."""

import runpy
import sys

import pytest

from places import ROOT

FOLDER = ROOT / "benchmarks"
SCRIPTS = sorted(str(path.relative_to(FOLDER)) for path in FOLDER.rglob("*.py"))
OF_THEIR_OWN = {"cosmic_ray", "torch", "stable_baselines3"}
"""What scripts ask for that `make setup` does not install."""


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_finds_what_it_imports(script, monkeypatch):
    path = FOLDER / script
    monkeypatch.setattr(sys, "path", [str(path.parent), *sys.path])
    try:
        names = runpy.run_path(str(path), run_name="imported")
    except ModuleNotFoundError as error:
        if error.name not in OF_THEIR_OWN:
            raise
        pytest.skip(f"needs {error.name}")
    assert names["__doc__"]
