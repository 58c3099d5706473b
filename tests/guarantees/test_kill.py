"""`kill -9` in the middle of real stages, then the same command: the run ends as if it had never been killed."""

import os
import signal
import subprocess
import sys
import time

import pytest

# Of the fast tests, guarantees/test_kill_anywhere.py kills processes, within single operations.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

STAGES = ("collect", "fit", "improve", "evaluate")
TINY = [
    "--deterministic",
    "--iterations",
    "2",
    "--collect.steps",
    "400",
    "--ensemble.members",
    "2",
    "--ensemble.hidden",
    "16",
    "16",
    "--fit.max-steps",
    "200",
    "--imagine.steps",
    "2000",
    "--validate.max-updates",
    "10",
    "--validate.starts",
    "5",
    "--evaluation-episodes",
    "2",
]
DERIVED = ("metrics.csv", "policy.npz", "policy.json", "config.json", "curve.png", "checkpoints/iteration-00002.npz")


def start(run_dir):
    return subprocess.Popen(
        [sys.executable, "-m", "metrpo", "train", "Swimmer", "--run-dir", str(run_dir), *TINY],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"MUJOCO_GL": "disabled"},  # no video: only the run matters here
    )


def run_to_the_end(run_dir):
    process = start(run_dir)
    process.communicate(timeout=300)
    assert process.returncode == 0


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("uninterrupted") / "run"
    run_to_the_end(run_dir)
    return run_dir


@pytest.mark.parametrize(("iteration", "stage"), [(1, "improve"), *((2, stage) for stage in STAGES)])
def test_a_run_killed_in_any_stage_resumes_byte_for_byte(iteration, stage, uninterrupted, tmp_path):
    run_dir = tmp_path / "run"
    process = start(run_dir)
    for line in process.stdout:
        if line.startswith(f"iteration {iteration}/2") and line.rstrip().endswith(stage):
            time.sleep(0.05)  # into the stage
            process.send_signal(signal.SIGKILL)
            break
    process.stdout.close()
    assert process.wait() == -signal.SIGKILL, "it ended before it could be killed"
    assert not (run_dir / "checkpoints/iteration-00002.npz").exists()
    run_to_the_end(run_dir)
    for name in DERIVED:
        assert (run_dir / name).read_bytes() == (uninterrupted / name).read_bytes(), f"{name} differs"
