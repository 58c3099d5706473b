"""A Ray cluster of three nodes on one machine: one is lost, the driver is killed, and nothing is missing in the end."""

import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from metrpo import read_metrics
from metrpo.experiments.standing import words
from metrpo.experiments.sweep import Grid, values_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1200),
    pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray: make ray, or pip install 'metrpo[ray]'"),
]

CART = f"{Path(__file__).parents[1] / 'carts.py'}:CART"
RUNS = 12
ITERATIONS = 3
TINY = {
    "deterministic": True,
    "trust_reward": True,
    "iterations": ITERATIONS,
    "evaluation_episodes": 1,
    "collect.steps": 40,
    "ensemble.members": 2,
    "ensemble.hidden": "[8]",
    "fit.max_passes": 4,
    "imagine.steps": 60,
    "validate.max_updates": 4,
}
DERIVED = ("metrics.csv", "policy.npz", "config.json", f"checkpoints/iteration-{ITERATIONS:05d}.npz")

ENVIRONMENT = os.environ | {"MUJOCO_GL": "disabled"}
ALONE = """
import sys
from metrpo import cli
for line in sys.stdin:
    assert cli.main(line.rstrip("\\n").split("\\t")) == 0
"""


@pytest.fixture
def cluster():
    """Three machines, as far as Ray can tell, with one core each; the driver belongs to the first."""
    from ray.cluster_utils import Cluster

    small = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        found = Cluster(initialize_head=True, head_node_args={**small, "include_dashboard": False})
        try:
            for _ in range(2):
                found.add_node(**small)
            yield found
        finally:
            found.shutdown()


def runs():
    """By seed; the first one is going to fail."""
    settings = dict(values_of(f"{name}={value}") for name, value in TINY.items())
    return Grid((CART,), seeds=tuple(range(RUNS + 1)), settings=settings).runs()


def sweep(cluster, out):
    grid = [f"{name}={value}" for name, value in TINY.items()]
    command = ["sweep", "--tasks", CART, "--seeds", f"0:{RUNS + 1}", "--set", *grid, "--out", str(out)]
    return subprocess.Popen(
        [sys.executable, "-m", "metrpo", *command, "--backend", "ray", "--address", cluster.address],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=ENVIRONMENT,
    )


@pytest.fixture
def alone(tmp_path):
    """The runs one after the other, in a process that does nothing else."""
    out = tmp_path / "alone"
    lines = "\n".join("\t".join(words(run, out / run.name)) for run in runs()[1:])
    subprocess.run([sys.executable, "-c", ALONE], input=lines, text=True, check=True, env=ENVIRONMENT)
    return out


def metrics(out):
    return list(out.glob("*/*/seed-*/metrics.csv"))


def iterations(out):
    """How far each run that has begun is."""
    return [len(read_metrics(path)) for path in metrics(out)]


def wait_for(driver, condition):
    while not condition():
        assert driver.poll() is None, driver.communicate()[0]
        time.sleep(0.1)


def test_a_lost_node_and_a_killed_driver_cost_nothing(alone, cluster, tmp_path):
    out, (fails, *good) = tmp_path / "out", runs()
    (out / fails.name).mkdir(parents=True)
    (out / fails.name / "notes.txt").touch()  # metrpo writes into no folder that holds something else

    driver = sweep(cluster, out)
    wait_for(driver, lambda: len(iterations(out)) >= 2 and min(iterations(out)) < ITERATIONS)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    wait_for(driver, lambda: iterations(out).count(ITERATIONS) >= RUNS // 2)
    driver.send_signal(signal.SIGKILL)
    driver.communicate()
    finished = {path: path.stat().st_mtime_ns for path in metrics(out) if len(read_metrics(path)) == ITERATIONS}
    assert len(finished) < RUNS, "killed too late"

    driver = sweep(cluster, out)
    text, _ = driver.communicate()
    assert driver.returncode == 1, text
    assert "seed-0: FAILED" in text
    assert "notes.txt" in text
    assert "1 of 13 runs failed" in text
    assert {path: path.stat().st_mtime_ns for path in finished} == finished, "finished runs are left alone"
    for run in good:
        for name in DERIVED:
            assert (out / run.name / name).read_bytes() == (alone / run.name / name).read_bytes(), f"{run.name}: {name}"
    begun = [log.read_text().count("  collect\n") for log in out.glob("*/*/seed-*.log")]
    assert any(count > ITERATIONS for count in begun), "no run was broken off"
