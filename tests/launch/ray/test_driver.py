"""Many runs on a Ray cluster, without Ray: what is asked of it, what its machines do, and how ends are told."""

from __future__ import annotations

import dataclasses
import inspect
import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import get_args

import pytest

from metrpo.commands import main, parse
from metrpo.console.interrupt import Stopped
from metrpo.errors import ConfigError, MetrpoError, RunDirectoryError
from metrpo.launch.backend import Backend, Means
from metrpo.launch.dispatch import BACKENDS
from metrpo.launch.ray import driver, sync, worker
from metrpo.launch.ray.worker import Ended, Order
from metrpo.launch.run_spec import RunSpec
from metrpo.run import lock

RUNS = [RunSpec("Swimmer", "k-1", seed, (("iterations", 3),), "fast") for seed in range(4)]
ROW = {"iteration": 3, "real_steps": 30, "return_real": 1.5}
MEANS = Means("ray", jobs=2, cpus=3, gpus=0.5, address="auto", storage="sent")
SHARED = dataclasses.replace(MEANS, storage="shared")


# ---------------------------------------------------------------- options and table


def test_every_backend_in_the_table_has_the_same_signature():
    assert set(BACKENDS) == set(get_args(Backend))
    assert len({str(inspect.signature(function)) for function in BACKENDS.values()}) == 1


@pytest.mark.parametrize("command", [["sweep"], ["reproduce", "all"]])
def test_options(command):
    typed = ["--backend", "ray", "--jobs", "2", "--cpus", "3", "--gpus", "0.5", "--address", "auto"]
    typed += ["--storage", "sent"]
    assert parse.parse([*command, *typed]).means == MEANS
    assert parse.parse(command).means == Means("local", None, None, 0.0, None, "shared")


@pytest.mark.parametrize(
    ("means", "message"),
    [
        ({"jobs": 0}, "jobs: expected at least 1, got 0"),
        ({"cpus": 0}, "cpus: expected at least 1, got 0"),
        ({"gpus": 1.0}, "gpus: works with --backend ray only"),
        ({"address": "here:1"}, "address: works with --backend ray only"),
        ({"storage": "sent"}, "storage: works with --backend ray only; add that, or leave --storage out"),
        ({"backend": "ray", "gpus": 1.5}, "gpus: expected a whole number or a fraction of 1, got 1.5"),
        ({"backend": "ray", "gpus": -1.0}, "gpus: expected a whole number"),
        ({"backend": "ray", "gpus": float("nan")}, "gpus: expected a whole number"),
        ({"backend": "ray", "address": "ray://here:1"}, "address: expected HOST:PORT or auto"),
    ],
)
def test_impossible_means_are_refused(means, message):
    with pytest.raises(ConfigError, match=message):
        Means(**means)


def test_without_ray_it_is_said_how_to_get_it(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert main.main(["sweep", "--seeds", "0", "--backend", "ray", "--out", str(tmp_path)]) == 2
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "pip install 'metrpo[ray]'" in capsys.readouterr().err


# ---------------------------------------------------------------- the driver


class TaskError(Exception):
    def __init__(self, cause):
        self.cause = cause


class LostError(Exception):
    pass


class FakeRay:
    """A cluster on which nothing is run: `outcomes` says how the run of a seed ends; None: it goes on."""

    exceptions = SimpleNamespace(RayTaskError=TaskError, RayError=(TaskError, LostError))

    def __init__(self, outcomes, at_wait=lambda: None, stubborn=False):
        self.outcomes, self.at_wait, self.stubborn = outcomes, at_wait, stubborn
        self.asked, self.function, self.orders, self.cancelled, self.most = None, None, [], [], 0
        self.on = False

    def init(self, **how):
        assert not how["log_to_driver"]
        self.address, self.on = how["address"], True
        signal.signal(signal.SIGTERM, lambda *_: sys.exit("Ray's own"))

    def shutdown(self):
        self.on = False

    def remote(self, **asked):
        self.asked = asked

        def decorate(function):
            self.function = function
            return SimpleNamespace(remote=lambda *order: self.orders.append(order) or len(self.orders) - 1)

        return decorate

    def wait(self, refs, num_returns, timeout):
        assert (num_returns, timeout) == (len(refs), 0)
        self.most = max(self.most, len(refs))
        self.at_wait()
        asked = [] if self.stubborn else [ref for ref, _ in self.cancelled]
        return [ref for ref in refs if self.outcomes[ref] is not None or ref in asked], []

    def get(self, ref):
        if isinstance(self.outcomes[ref], Exception):
            raise self.outcomes[ref]
        return self.outcomes[ref]

    def cancel(self, ref, force=False, recursive=True):
        assert force or not recursive, "a task that is asked to stop still sends what it has"
        self.cancelled.append((ref, force))

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": 4.0}}, {"Alive": False, "Resources": {"CPU": 4.0, "GPU": 1.0}}]

    def cluster_resources(self):
        return {"CPU": 4.0}

    def available_resources(self):
        return {"CPU": 1.0}


@pytest.fixture
def on(monkeypatch, tmp_path):
    """Runs RUNS on a fake cluster; returns the cluster, the failed runs and what was told."""
    monkeypatch.setattr(driver, "_POLL", 0.001)
    # A shell that starts the tests in the background has Ctrl-C ignored.
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}

    def run(ray, means=SHARED):
        monkeypatch.setitem(sys.modules, "ray", ray)
        told = []
        try:
            return driver.run_on_ray(RUNS, tmp_path, means, told.append), told
        finally:
            assert not ray.on, "the cluster is let go"
            assert {n: signal.getsignal(n) for n in handlers} == handlers, "handlers are put back"

    yield run
    for number, handler in before.items():
        signal.signal(number, handler)


def test_what_is_asked_of_ray(on, monkeypatch, tmp_path):
    monkeypatch.setenv("XLA_FLAGS", "--xla_mine")
    ray = FakeRay([Ended(0, (ROW,), 7.0)] * 4)
    failed, told = on(ray)
    assert failed == []
    assert ray.address == "auto"
    assert (ray.asked["num_cpus"], ray.asked["num_gpus"]) == (3, 0.5)
    assert ray.asked["max_retries"] == driver.RETRIES
    assert ray.asked["retry_exceptions"] is False
    assert ray.most == 2, "jobs"
    assert ray.function is worker.attend
    (order,) = ray.orders[1]
    directory = str(tmp_path / RUNS[1].name)
    assert order.words == ("train", *RUNS[1].arguments, "--run-dir", directory, "--no-video")
    assert (order.directory, order.log, order.folder) == (directory, f"{directory}.log", os.getcwd())
    assert order.environment["XLA_FLAGS"] == "--xla_mine"
    assert (order.cpus, order.gpus) == (3, 0.5)
    assert "at most 2 at a time on the Ray cluster, 3 CPU and 0.5 GPU for each; 1 machines, 3 of 4 CPUs in use" in told
    assert any("no machine of the cluster has 3 CPU and 0.5 GPU" in line for line in told)
    assert told[-1].startswith("[4/4] Swimmer/k-1/seed-")
    assert told[-1].endswith("iteration 3/3, 30 real steps, return 1.5, in 7 s")
    ray = FakeRay([Ended(0, (ROW,), 7.0)] * 4)
    on(ray, Means("ray"))
    assert (ray.asked["num_cpus"], ray.asked["num_gpus"], ray.most) == (1, 0.0, 4)


def test_what_is_asked_of_machines_that_share_no_disk(on, monkeypatch, tmp_path):
    monkeypatch.setattr(driver.sync, "start_store", lambda ray, out: f"the store of {out}")
    ray = FakeRay([Ended(0, (ROW,), 7.0)] * 4)
    failed, _ = on(ray, MEANS)
    assert failed == []
    assert ray.function is sync.attend_for
    order, name, store = ray.orders[2]
    assert (order.directory, name, store) == (str(tmp_path / name), RUNS[2].name, f"the store of {tmp_path}")


def test_a_failed_run_stops_no_other_and_its_reason_is_shown(on, tmp_path):
    log = tmp_path / f"{RUNS[0].name}.log"
    log.parent.mkdir(parents=True)
    log.write_text("what went wrong\n")
    (tmp_path / f"{RUNS[3].name}.log").touch()
    outcomes = [Ended(2, (), 7.0), TaskError(MetrpoError("no such disk")), LostError("node died"), Ended(0, (), 1.0)]
    failed, told = on(FakeRay(outcomes))
    assert failed == RUNS
    text = "\n".join(told)
    assert "seed-0: FAILED after 7 s (exit code 2)" in text
    assert "      what went wrong" in text
    assert "seed-1: FAILED (MetrpoError): no such disk" in text
    assert "seed-2: FAILED because its machine or worker was lost, after 20 retries (LostError)" in text
    assert "seed-3: FAILED" in text, "it ended short of its budget"
    failed, _ = on(FakeRay([Ended(1, (ROW,), 7.0), *[Ended(0, (ROW,), 7.0)] * 3]))
    assert failed == RUNS[:1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("times", [1, 2])
def test_stopping(on, number, times):
    left = [times]

    def ask():
        if left[0]:
            left[0] -= 1
            signal.raise_signal(number)

    ray = FakeRay([None] * 4, ask, stubborn=times == 2)
    with pytest.raises(Stopped) as stopped:
        on(ray)
    assert stopped.value.number == number
    assert ray.cancelled[:2] == [(0, False), (1, False)], "each is asked to end"
    assert ray.cancelled[2:] == ([(0, True), (1, True)] if times == 2 else []), "and killed when asked once more"


def test_what_ray_cannot_reach_is_said(on):
    ray = FakeRay([])
    ray.init = lambda **_: (_ for _ in ()).throw(ConnectionError("nobody answers\nand more"))
    with pytest.raises(MetrpoError, match=r"cannot reach the Ray cluster auto \(nobody answers\); start one with"):
        on(ray)
    with pytest.raises(MetrpoError, match=r"cannot reach the Ray cluster 127.0.0.1:1 "):
        on(FakeRay([]), Means("ray", address="127.0.0.1:1"))


# ---------------------------------------------------------------- a machine of the cluster


def order(tmp_path, *words, **more):
    run = tmp_path / "out" / "run"
    plain = {"folder": str(tmp_path), "environment": {}, "cpus": 2, "gpus": 0.0}
    return Order(words, str(run), f"{run}.log", **plain | more)


def test_what_is_forwarded():
    here = {
        "XLA_FLAGS": "--a",
        "JAX_PLATFORMS": "cpu",
        "MUJOCO_GL": "egl",
        "OMP_NUM_THREADS": "3",
        "METRPO_X": "1",
        "PYTHONPATH": "/code",
        "HOME": "/home/me",
        "CUDA_VISIBLE_DEVICES": "0,1",
        "RAY_ADDRESS": "there",
    }
    kept = {"XLA_FLAGS", "JAX_PLATFORMS", "MUJOCO_GL", "OMP_NUM_THREADS", "METRPO_X", "PYTHONPATH"}
    assert worker.forwarded(here) == {name: here[name] for name in kept}


def test_a_run_gets_its_share_of_the_machine(tmp_path):
    here = {"CUDA_VISIBLE_DEVICES": "1", "PATH": "/bin", "OMP_NUM_THREADS": "64"}
    found = worker.surroundings(order(tmp_path), here)
    assert found["PATH"] == "/bin"
    assert found["JAX_PLATFORMS"] == "cpu"
    assert {found[name] for name in ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")} == {"2"}
    assert found["XLA_FLAGS"] == "--xla_force_host_platform_device_count=2"
    found = worker.surroundings(order(tmp_path, gpus=1.0), here)
    assert found["CUDA_VISIBLE_DEVICES"] == "1", "Ray's choice"
    assert not {"JAX_PLATFORMS", "XLA_PYTHON_CLIENT_MEM_FRACTION"} & set(found)
    found = worker.surroundings(order(tmp_path, gpus=0.25), here)
    assert float(found["XLA_PYTHON_CLIENT_MEM_FRACTION"]) == pytest.approx(0.225)
    mine = {"NPROC": "5", "JAX_PLATFORMS": "cuda", "XLA_FLAGS": "--xla_force_host_platform_device_count=7"}
    found = worker.surroundings(order(tmp_path, environment=mine), here)
    assert {name: found[name] for name in mine} == mine, "what was forwarded counts"


def test_a_run_is_a_process_of_its_own(tmp_path):
    ended = worker.attend(order(tmp_path, "train", "Swimer", "--run-dir", "out/run"))
    assert (ended.code, ended.rows) == (2, ())
    log = (tmp_path / "out" / "run.log").read_text()
    assert log.startswith(f"metrpo: on {os.uname().nodename}\n")
    assert "unknown task 'Swimer'" in log


def test_the_last_row_is_told(tmp_path):
    directory = tmp_path / "out" / "run"
    directory.mkdir(parents=True)
    (directory / "metrics.csv").write_text("iteration,real_steps\n1,10\n2,20\n")
    assert worker.attend(order(tmp_path, "--version")).rows == ({"iteration": 2, "real_steps": 20},)


def test_where_the_disk_is_not_shared_it_is_said(tmp_path):
    with pytest.raises(MetrpoError, match="expected the folder /nowhere, got none"):
        worker.attend(order(tmp_path, folder="/nowhere"))
    (tmp_path / "out").touch()
    with pytest.raises(MetrpoError, match=r"cannot write .*out/run"):
        worker.attend(order(tmp_path))


def test_a_task_that_is_cancelled_asks_its_run_to_stop(monkeypatch):
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"])
    sleep, left = time.sleep, [KeyboardInterrupt]

    def interrupted(seconds):
        if left:
            raise left.pop()
        sleep(seconds)

    monkeypatch.setattr(worker.time, "sleep", interrupted)
    assert worker._wait(process, lambda: None) == -signal.SIGTERM


def test_a_directory_that_is_held_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "_POLL", 0.01)
    held = lock.hold(tmp_path)
    with pytest.raises(lock.DirectoryInUse, match="is in use by another process"):
        lock.wait_until_free(tmp_path, 0.05)
    threading.Timer(0.2, held.close).start()
    lock.wait_until_free(tmp_path, 60)
    assert held.closed
    with pytest.raises(RunDirectoryError, match="cannot write"):
        lock.wait_until_free(tmp_path / "none", 60)


PARENT = """
import os, subprocess, sys, time
child = "import sys, time; from metrpo.launch.tied import tie; tie(int(sys.argv[1]));"
child += "print('tied', flush=True); time.sleep(100)"
subprocess.Popen([sys.executable, "-c", child, str(os.getpid())])
time.sleep(100)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux kills a process with its parent")
def test_a_run_ends_with_its_killed_parent():
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE)
    assert parent.stdout.readline() == b"tied\n"
    parent.kill()
    began = time.monotonic()
    assert parent.stdout.read() == b"", "which the child would hold open"
    parent.stdout.close()
    parent.wait()
    assert time.monotonic() - began < 50


def test_a_run_whose_parent_has_gone_does_not_begin():
    line = [sys.executable, "-m", "metrpo.launch.tied", "1", "--version"]
    done = subprocess.run(line, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")
    assert "its parent 1 has ended" in done.stderr
