"""A run that is killed anywhere, in any operation on the disk, and started again ends as one that never stopped.

One process on the probe stands for many: `faults.Disk` ends it within its n-th operation on the disk, for every n, and
what comes next finds on disk what another process would. The slow tests kill real processes.
"""

from __future__ import annotations

import random
import signal
import subprocess
import time

import numpy as np
import pytest

import probe
import tiny_run
from metrpo import external
from metrpo.run.episodes import EpisodeLog
from metrpo.run.metrics import read_metrics
from tiny_run import CONFIG, EPISODES, ITERATIONS, Counted, by_steps, by_train, differing, drive, process_line, result


@pytest.fixture(autouse=True, scope="module")
def _cheap():
    with tiny_run.cheap():
        yield


@pytest.fixture(scope="module", params=[by_train, by_steps], ids=["train", "steps"])
def uninterrupted(request, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("uninterrupted") / "new" / "run"
    (operations,) = drive(request.param, run_dir, [])
    assert Counted.kept == ITERATIONS * EPISODES
    expected = result(run_dir)
    assert {"checkpoints/iteration-00003.npz", "metrics.csv", "policy.npz", "policy.json", "curve.png"} < set(expected)
    assert [row["iteration"] for row in read_metrics(run_dir / "metrics.csv")] == [1, 2, 3]
    return request.param, operations, expected


def assert_nothing_is_lost(run_dir, uninterrupted, deaths, fault):
    commands, _, expected = uninterrupted
    processes = drive(commands, run_dir, deaths, fault)
    where = f"{fault} at {[p[-1] for p in processes[:-1]]}"
    assert differing(result(run_dir), expected) == [], where
    assert Counted.kept <= ITERATIONS * EPISODES, f"{where}: an episode that was on disk was played again"
    return len(processes) - 1


def every(uninterrupted, tmp_path, fault, numbers):
    for n in numbers:
        died = assert_nothing_is_lost(tmp_path / str(n) / "new" / "run", uninterrupted, [n], fault)
        assert died == 1
    return len(numbers)


def test_what_is_counted_is_what_the_run_does(uninterrupted):
    _, operations, _ = uninterrupted
    kinds = {text.split()[0] for text in operations}
    assert kinds >= {"open", "write", "flush", "fsync", "replace", "link", "unlink", "mkdir"}
    assert len(operations) > 240


@pytest.mark.parametrize("fault", ["kill", "power"])
def test_killed_in_one_operation_of_seventeen(uninterrupted, tmp_path, fault):
    operations = len(uninterrupted[1])
    assert every(uninterrupted, tmp_path, fault, range(3 + 8 * (fault == "power"), operations + 1, 17)) > 12


@pytest.mark.parametrize("seed", range(4))
def test_killed_again_and_again(uninterrupted, tmp_path, seed):
    chance = random.Random(seed)
    deaths = [chance.randint(1, 60) for _ in range(20)]
    died = assert_nothing_is_lost(tmp_path / "new" / "run", uninterrupted, deaths, chance.choice(["kill", "power"]))
    assert died >= 4


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("fault", ["kill", "power"])
def test_killed_in_every_operation(uninterrupted, tmp_path, fault):
    every(uninterrupted, tmp_path, fault, range(1, len(uninterrupted[1]) + 1))


def test_a_log_added_half_way_is_added_once(tmp_path):
    run_dir, log = tmp_path / "new" / "run", tmp_path / "log.npz"
    played = [probe.rollout(probe.PROBE, seed, lambda t, s: -s) for seed in range(3)]
    whole = [np.concatenate([e[0][:-1] for e in played]), np.concatenate([e[0][1:] for e in played])]
    whole += [np.concatenate([e[i] for e in played]) for i in (1, 2)]
    ends = {"terminated": np.zeros(60), "truncated": np.tile(np.arange(probe.HORIZON) == probe.HORIZON - 1, 3)}
    np.savez(log, **dict(zip(("states", "next_states", "actions", "rewards"), whole, strict=True)), **ends)

    def commands(run_dir):
        yield lambda: external.collect(run_dir, data=log)

    external.begin(CONFIG, run_dir)
    (operations,) = drive(commands, run_dir, [])
    assert len(operations) > 40
    for n in range(1, len(operations) + 1, 5):
        run_dir = tmp_path / str(n) / "new" / "run"
        external.begin(CONFIG, run_dir)
        drive(commands, run_dir, [n])
        waiting = EpisodeLog(run_dir).pending()
        assert [e.rewards.sum() for e in waiting] == [pytest.approx(r.sum(), rel=1e-5) for _, _, r in played]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_real_kills_at_random_moments(tmp_path):
    """24 times `kill -9`, at moments drawn from the time that the rest of the run takes, in 6 runs."""
    started = time.monotonic()
    subprocess.run(process_line(tmp_path / "uninterrupted"), check=True, stdout=subprocess.DEVNULL)
    takes, chance, kills = time.monotonic() - started, random.Random(0), 0
    expected = result(tmp_path / "uninterrupted")
    run = 0
    while kills < 24:
        run_dir = tmp_path / str(run)
        run += 1
        for _ in range(4):
            process = subprocess.Popen(process_line(run_dir), stdout=subprocess.DEVNULL)
            try:
                process.wait(chance.uniform(0.3, 1.0) * takes)
            except subprocess.TimeoutExpired:
                process.kill()
            kills += process.wait() == -signal.SIGKILL
        subprocess.run(process_line(run_dir), check=True, stdout=subprocess.DEVNULL)
        assert differing(result(run_dir), expected) == [], f"run {run}"
