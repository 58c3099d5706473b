"""A run on a machine without a common disk: whenever the sending breaks off, the driver has a run to go on with.

The store's disk fails in its n-th operation (`faults.Disk`), for every n. The machine that works sends after everything
that it does to a file, or once in an iteration; what comes next begins in an empty folder, with what the driver has.
"""

from __future__ import annotations

import os
import re

import pytest

import tiny_run
from faults import Disk
from metrpo.launch.ray.store import Store
from metrpo.launch.ray.sync import Copy
from metrpo.run.metrics import read_metrics
from metrpo.training import train
from tiny_run import CONFIG, ITERATIONS, differing, result

RUN = "Probe/k-1/seed-0"


def sent(out, node, disk, often):
    """One command, until the disk fails: a store, and a machine that runs the run in the new folder `node`."""
    store, log = Store(str(out)), node.with_suffix(".log")
    log.touch()
    with disk, pytest.MonkeyPatch.context() as patch:
        copy = Copy(store, RUN, node, log)

        def sending(real):
            def act(*arguments, **named):
                real(*arguments, **named)
                if str(arguments[-1]).startswith(str(node) if often else str(node / "metrics.csv")):
                    copy.send()

            return act

        for name in ("replace", "link", "unlink"):
            patch.setattr(os, name, sending(getattr(os, name)))
        train(CONFIG, node)
        copy.send()
    for lock in store._locks.values():
        lock.close()  # as the kernel does when a process ends


@pytest.fixture(autouse=True, scope="module")
def _cheap():
    with tiny_run.cheap():
        yield


@pytest.fixture(scope="module", params=[True, False], ids=["often", "seldom"])
def uninterrupted(request, tmp_path_factory):
    """What a run ends with that is not sent, and how many operations the store needs for one that is."""
    alone, node, out = (tmp_path_factory.mktemp(name) / "run" for name in ("alone", "node", "out"))
    train(CONFIG, alone)
    disk = Disk(out)
    sent(out, node, disk, request.param)
    expected = result(alone)
    assert differing(result(out / RUN), expected) == []
    assert len(read_metrics(out / RUN / "metrics.csv")) == ITERATIONS
    assert disk.count > 20
    return expected, disk.count, request.param


def assert_it_can_go_on(uninterrupted, tmp_path, fault, numbers):
    expected, count, often = uninterrupted
    for at in numbers(count):
        out, directory = tmp_path / f"out-{at}", tmp_path / f"out-{at}" / RUN
        disk = Disk(out, at, fault)
        sent(out, tmp_path / f"first-{at}", disk, often)
        assert disk.hit
        if (metrics := directory / "metrics.csv").exists():
            states = [int(re.sub(r"\D", "", path.name)) for path in directory.glob("checkpoints/iteration-*.npz")]
            assert len(read_metrics(metrics)) <= max(states), f"ahead of its checkpoints after {disk.done[-1]}"
        sent(out, tmp_path / f"second-{at}", Disk(out), often)
        assert differing(result(directory), expected) == [], f"{fault} in {disk.done[-1]}"


@pytest.mark.parametrize("fault", ["kill", "power"])
def test_broken_off_in_some_operations(uninterrupted, tmp_path, fault):
    assert_it_can_go_on(uninterrupted, tmp_path, fault, lambda count: range(5, count + 1, 41))


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("fault", ["kill", "power"])
def test_broken_off_in_every_operation(uninterrupted, tmp_path, fault):
    assert_it_can_go_on(uninterrupted, tmp_path, fault, lambda count: range(1, count + 1))
