"""`benchmarks/gpu_check.py` without a GPU: what it judges, that it always finishes, and what it writes."""

from __future__ import annotations

import argparse
import json
import runpy
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import probe
from metrpo import training
from places import ROOT

BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture
def check():
    return runpy.run_path(str(BENCHMARKS / "gpu_check.py"))


@pytest.fixture
def parity():
    return runpy.run_path(str(BENCHMARKS / "gpu_parity.py"))


def test_parity_passes_other_roundings_and_fails_tf32(parity):
    rng = np.random.default_rng(0)
    plain = {"fit": rng.standard_normal(1000), "cg residual": np.array(0.1)}
    moved = {"fit": plain["fit"] * (1 + 2.0**-23 * rng.standard_normal(1000))}

    def judged(error):
        return parity["table"]({"fit": plain["fit"] * (1 + error)}, plain, moved)["fit"]["holds"]

    assert judged(0.0)
    assert judged(2.0**-21)
    assert not judged(2.0**-11 * rng.standard_normal(1000)), "TF32 keeps 10 bits"
    assert not judged(np.nan)
    wild = {"fit": 2 * plain["fit"]}
    assert not parity["table"]({"fit": 1.1 * plain["fit"]}, plain, wild)["fit"]["holds"], "the tolerance has a ceiling"


def test_what_hangs_or_fails_is_said_and_ended(check):
    within = check["_within"]
    assert within([sys.executable, "-c", ""], 60) == "done"
    assert within([sys.executable, "-c", "raise SystemExit(3)"], 60) == "failed with exit code 3"
    assert within([sys.executable, "-c", "import time; time.sleep(60)"], 0.2) == "out of time"


def test_the_record_is_written_after_every_part(check, tmp_path, monkeypatch):
    outcomes = iter(["done", "out of time", "failed with exit code 1", "done", "done", "done"])
    out, seen = tmp_path / "gpu.json", []

    def part(command, limit):
        seen.append(json.loads(out.read_text())["parts"] if out.exists() else {})
        if len(seen) < 3:
            Path(command[command.index("--out") + 1]).write_text('{"kept": 1}')
        return next(outcomes)

    run_all = check["run_all"]
    monkeypatch.setitem(run_all.__globals__, "_within", part)
    run_all(argparse.Namespace(out=out, seconds=60.0, tiny=True, commit=None))
    parts = json.loads(out.read_text())["parts"]
    assert [len(s) for s in seen] == list(range(6))
    assert list(parts) == ["where", *check["PARTS"]]
    assert parts["parity"]["outcome"] == "out of time"
    assert parts["parity"]["result"] == {"kept": 1}
    assert parts["paper Swimmer"] == {
        "outcome": "failed with exit code 1",
        "seconds": pytest.approx(0, abs=1),
        "result": None,
    }


def test_a_presets_iterations_are_timed_while_time_is_left(check, monkeypatch):
    row = {"real_steps": 9, "return_real": 1.0, "return_imagined": 2.0, "updates": 5, "accepted_updates": 5}
    row |= {"fit_passes": 5, "seconds_fit": 1.0, "seconds_improve": 3.0, "seconds_validate": 1.0}

    def step(config, state, progress):
        time.sleep(0.05)
        return argparse.Namespace(iteration=state.iteration + 1), row

    monkeypatch.setattr(training, "init", lambda config: argparse.Namespace(iteration=0))
    monkeypatch.setattr(training, "step", step)
    saved: list[dict] = []
    with probe.registered():
        check["stages"]("Probe", "paper", False, 60.0, saved.append)
        assert [len(record["iterations"]) for record in saved] == [1, 2, 3]
        assert saved[-1]["cut"] == {"iterations": "3", "validate.max_updates": "50"}
        first = saved[-1]["iterations"][0]
        assert (first["seconds_fit"], first["seconds_per_update"]) == (1.0, 4 / 5)
        assert first["seconds"] >= 0.05
        saved.clear()
        check["stages"]("Probe", "paper", False, 0.07, saved.append)
    assert [len(record["iterations"]) for record in saved] == [1], "a second iteration would have taken too long"
