"""A Ray cluster of three nodes on one machine: one is lost, the driver is killed, and nothing is missing in the end.

With the folder of the runs shared, and with every node in a folder of its own.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from metrpo import read_metrics
from metrpo.errors import RunDirectoryError
from metrpo.launch.grid import Grid, values_of
from metrpo.launch.status import words
from places import SUPPORT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray: make ray, or pip install 'metrpo[ray]'"),
]

CART = f"{SUPPORT / 'carts.py'}:CART"
RUNS = 12
FAILS = 3
"""Seed of the run that always does; the first three are under way at the same time."""
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
SLOW = ENVIRONMENT | {"METRPO_TEST_STEP_SECONDS": "0.05"}
ALONE = """
import sys
from metrpo.commands import main
for line in sys.stdin:
    assert main.main(line.rstrip("\\n").split("\\t")) == 0
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
    """By seed; that of `FAILS` is going to fail."""
    settings = dict(values_of(f"{name}={value}") for name, value in TINY.items())
    return Grid((CART,), seeds=tuple(range(RUNS + 1)), settings=settings).runs()


def sweep(cluster, out, *more, seeds=f"0:{RUNS + 1}", environment=SLOW):
    grid = [f"{name}={value}" for name, value in TINY.items()]
    command = ["sweep", "--tasks", CART, "--seeds", seeds, "--set", *grid, "--out", str(out)]
    return subprocess.Popen(
        [sys.executable, "-m", "metrpo", *command, "--backend", "ray", "--address", cluster.address, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
    )


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The runs one after the other, in a process that does nothing else."""
    out = tmp_path_factory.mktemp("alone")
    lines = "\n".join("\t".join(words(run, out / run.name)) for run in runs() if run.seed != FAILS)
    command = [sys.executable, "-c", ALONE]
    subprocess.run(command, input=lines, text=True, check=True, stdout=subprocess.DEVNULL, env=ENVIRONMENT)
    return out


def metrics(out):
    return list(out.glob("*/*/seed-*/metrics.csv"))


def finished(out):
    return [path for path in metrics(out) if len(read_metrics(path)) == ITERATIONS]


def under_way(out):
    """How many runs have finished an iteration and not all."""
    return len(metrics(out)) - len(finished(out))


def begun_again(out):
    """How many runs have been begun more than once."""
    return sum(log.read_text().count("metrpo: on ") > 1 for log in out.glob("*/*/seed-*.log"))


def wait_for(driver, condition):
    while not condition():
        assert driver.poll() is None, driver.communicate()[0]
        time.sleep(0.1)


def test_a_lost_node_and_a_killed_driver_cost_nothing(alone, cluster, tmp_path):
    out, everything = tmp_path / "out", runs()
    fails = out / everything[FAILS].name
    fails.mkdir(parents=True)
    (fails / "notes.txt").touch()  # metrpo writes into no folder that holds something else

    driver = sweep(cluster, out)
    wait_for(driver, lambda: under_way(out) == 3)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    wait_for(driver, lambda: begun_again(out) and len(finished(out)) >= RUNS // 2 and under_way(out))
    driver.send_signal(signal.SIGKILL)
    driver.communicate()
    before = {path: path.stat().st_mtime_ns for path in finished(out)}
    assert len(before) < RUNS, "killed too late"

    driver = sweep(cluster, out)
    text, _ = driver.communicate()
    assert driver.returncode == 1, text
    assert f"{len(before)} of 13 runs are finished" in text
    assert f"seed-{FAILS}: FAILED" in text
    assert "notes.txt" in text
    assert "1 of 13 runs failed" in text
    assert {path: path.stat().st_mtime_ns for path in before} == before, "finished runs are left alone"
    assert begun_again(out) >= 3, "that of the lost node, one that was under way when the driver died, the failing one"
    for run in everything:
        for name in DERIVED if run.seed != FAILS else ():
            assert (out / run.name / name).read_bytes() == (alone / run.name / name).read_bytes(), f"{run.name}: {name}"


SEEDS = (0, 1, 2, 4)
"""Of the runs that are sent; three are under way at the same time."""


def processes():
    """The runs' own: process id -> its words."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            line = (folder / "cmdline").read_text().split("\0")
            if "metrpo.launch.tied" in line and CART in line:
                found[int(folder.name)] = line
    return found


def opened(pid):
    """What a process has open, and its working directory."""
    found = []
    for link in [*Path(f"/proc/{pid}/fd").glob("*"), Path(f"/proc/{pid}/cwd")]:
        with suppress(OSError):
            found.append(os.readlink(link))
    return found


def parent(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def run_dir(line):
    return Path(line[line.index("--run-dir") + 1])


def node_and_seed_to_lose(cluster, out):
    """A node but the driver's whose run has finished an iteration and not all, with the run's seed; or None."""
    raylets = {node.all_processes["raylet"][0].process.pid: node for node in cluster.worker_nodes}
    for pid, line in processes().items():
        directory = run_dir(line)
        with suppress(OSError, RunDirectoryError):  # it has ended, or its first iteration has not
            node = raylets.get(parent(parent(pid)))
            rows = len(read_metrics(out.joinpath(*directory.parts[-3:], "metrics.csv")))
            if node is not None and 0 < rows < ITERATIONS:
                return node, int(directory.name.removeprefix("seed-"))
    return None


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="looks at other processes by Linux's /proc")
def test_nodes_that_share_no_disk_work_in_folders_of_their_own(alone, cluster, tmp_path):
    out, seen, touched, lost = tmp_path / "out", {}, set(), []

    def look():
        for pid, line in processes().items():
            seen[pid] = line
            touched.update(path for path in opened(pid) if path.startswith(str(out)))

    def a_run_has_something_to_lose():
        look()
        lost[:] = [node_and_seed_to_lose(cluster, out)]
        return lost[0] is not None

    seeds, slow = ",".join(map(str, SEEDS)), SLOW | {"METRPO_TEST_STEP_SECONDS": "0.2"}
    driver = sweep(cluster, out, "--storage", "sent", seeds=seeds, environment=slow)
    wait_for(driver, a_run_has_something_to_lose)
    node, seed = lost[0]
    cluster.remove_node(node, allow_graceful=False)
    while driver.poll() is None:
        look()
        time.sleep(0.1)
    text = driver.communicate()[0]
    assert driver.returncode == 0, text

    folders = {run_dir(line) for line in seen.values()}  # a process that is about to become git has the same line
    for folder in folders:
        shutil.rmtree(folder.parents[2], ignore_errors=True)  # the lost node has left its own
    attempts = sum(log.read_text().count("metrpo: on ") for log in out.glob("*/*/seed-*.log"))
    assert len(folders) == attempts == len(SEEDS) + 1, "each in one of its own, and one more for the lost one"
    assert not [word for line in seen.values() for word in line if str(out) in word]
    assert touched == set()
    chosen = [run for run in runs() if run.seed in SEEDS]
    (again,) = (run for run in chosen if run.seed == seed)
    log = (out / f"{again.name}.log").read_text()
    assert log.count("metrpo: on ") == 2
    assert log.count(f"iteration 1/{ITERATIONS} ") == log.split("metrpo: on ")[1].count(f"iteration 1/{ITERATIONS} "), (
        "it went on from what had come back"
    )
    for run in chosen:
        for name in DERIVED:
            assert (out / run.name / name).read_bytes() == (alone / run.name / name).read_bytes(), f"{run.name}: {name}"
