"""Twenty runs at once on one machine: each finishes in its own directory, and none disturbs another or the cache."""

import os
import subprocess
import sys

import pytest

from metrpo import read_metrics
from places import SUPPORT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

RUNS = 20
TINY = {
    "deterministic": True,
    "iterations": 2,
    "evaluation_episodes": 1,
    "collect.steps": 40,
    "ensemble.members": 2,
    "ensemble.hidden": (8,),
    "fit.batch_size": 20,
    "fit.max_passes": 4,
    "imagine.steps": 60,
    "policy.hidden": (4,),
    "validate.max_updates": 4,
    "validate.starts": 4,
}
DERIVED = ("metrics.csv", "policy.npz", "config.json", "checkpoints/iteration-00002.npz")


def environment(cache):
    path = os.pathsep.join([str(SUPPORT), *sys.path])
    inherited = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    return inherited | {"PYTHONPATH": path, "XDG_CACHE_HOME": str(cache), "MUJOCO_GL": "disabled"}


def metrpo(cache, *arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "metrpo", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(cache),
    )


def start(run_dir, seed, cache):
    settings = []
    for name, value in TINY.items():
        option = f"--{name.replace('_', '-')}"
        settings += [option] if value is True else [option, *(value if isinstance(value, tuple) else [value])]
    return metrpo(cache, "train", "probe:PROBE", "--seed", seed, "--run-dir", run_dir, "--no-video", *settings)


def output(run_dir):
    return [(run_dir / name).read_bytes() for name in DERIVED]


def test_twenty_runs_started_at_once_finish_as_they_would_alone(tmp_path):
    cache = tmp_path / "cache"
    together = [start(tmp_path / f"run-{n}", n // 2, cache) for n in range(RUNS)]
    said = [process.communicate()[0] for process in together]
    assert [process.returncode for process in together] == [0] * RUNS, said
    for n in range(0, RUNS, 2):  # two of each seed
        assert output(tmp_path / f"run-{n}") == output(tmp_path / f"run-{n + 1}")
        assert len(read_metrics(tmp_path / f"run-{n}" / "metrics.csv")) == 2
    assert output(tmp_path / "run-0") != output(tmp_path / "run-2")
    # Neither does being alone change anything, nor what twenty left in the cache, nor its absence.
    for name, where in (("warm", cache), ("cold", tmp_path / "empty")):
        alone = start(tmp_path / name, 0, where)
        text, _ = alone.communicate()
        assert alone.returncode == 0, text
        assert output(tmp_path / name) == output(tmp_path / "run-0")


def test_runs_in_one_directory_are_refused_but_for_one(tmp_path):
    together = [start(tmp_path / "run", 0, tmp_path / "cache") for _ in range(4)]
    said = [process.communicate()[0] for process in together]
    codes = [process.returncode for process in together]
    assert sorted(codes) in ([0, 2, 2, 2], [0, 0, 2, 2], [0, 0, 0, 2], [0] * 4), (
        said
    )  # one may start after another's end
    assert all("in use" in text for text, code in zip(said, codes, strict=True) if code)
    assert [row["iteration"] for row in read_metrics(tmp_path / "run" / "metrics.csv")] == [1, 2]


def test_the_number_of_jobs_changes_nothing(tmp_path):
    grid = [f"{name}={list(value) if isinstance(value, tuple) else value}" for name, value in TINY.items()]
    for jobs in ("1", "3"):
        out = ["--jobs", jobs, "--out", tmp_path / jobs]
        process = metrpo(tmp_path / "cache", "sweep", "--tasks", "probe:PROBE", "--seeds", "0:3", "--set", *grid, *out)
        text, _ = process.communicate()
        assert process.returncode == 0, text
    runs = sorted(path.parent.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("metrics.csv"))
    assert len(runs) == 3
    for run in runs:
        assert output(tmp_path / "1" / run) == output(tmp_path / "3" / run)
