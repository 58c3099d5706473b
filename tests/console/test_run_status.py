"""How far a run is, and whether a process is at it, as its directory says."""

import dataclasses
import fcntl
import os
import threading
import time
from pathlib import Path

import pytest

from metrpo.config import Config
from metrpo.console.run_status import is_running, status_of
from metrpo.run.find import read
from metrpo.run.lock import claim
from seen_runs import a_run, healthy

CONFIG = Config("Swimmer", iterations=20)
TIMED = [r | {"wall_seconds": 2.0 * r["iteration"] ** 2} for r in healthy(10)]


def test_the_time_left_does_not_count_the_compilation(tmp_path):
    rows = [r | {"wall_seconds": 60.0 + 2.0 * r["iteration"]} for r in healthy(2)]
    assert status_of(read(a_run(tmp_path / "a", CONFIG, rows))).seconds_per_iteration == pytest.approx(2)
    assert status_of(read(a_run(tmp_path / "b", CONFIG, rows[:1]))).seconds_per_iteration is None


def test_whether_a_run_lives_is_seen_without_touching_its_lock(tmp_path):
    config = Config("Swimmer")
    assert not is_running(tmp_path)
    held = claim(tmp_path, config)
    before = (tmp_path / ".lock").stat()
    assert is_running(tmp_path)
    after = (tmp_path / ".lock").stat()
    assert (before.st_mtime_ns, before.st_size) == (after.st_mtime_ns, after.st_size)
    held.close()
    assert not is_running(tmp_path), "the file stays, with a pid that lives"
    assert (tmp_path / ".lock").read_text() == str(os.getpid())
    with open(tmp_path / "other", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert not is_running(tmp_path), "another lock of the same process"
    claim(tmp_path, config).close()  # a look never kept a run from starting


def test_watching_never_keeps_a_run_from_starting(tmp_path):
    """50 claims while another thread looks without a pause."""
    claim(tmp_path, Config("Swimmer")).close()
    over = threading.Event()

    def look():
        while not over.is_set():
            is_running(tmp_path)

    looker = threading.Thread(target=look)
    looker.start()
    try:
        for _ in range(50):
            claim(tmp_path, Config("Swimmer")).close()
    finally:
        over.set()
        looker.join()


def test_without_a_list_of_locks_the_process_counts(tmp_path, monkeypatch):
    real = Path.read_text
    monkeypatch.setattr(
        Path, "read_text", lambda self, *a, **k: real(Path("/nonexistent") if "proc" in str(self) else self, *a, **k)
    )
    (tmp_path / ".lock").write_text(str(os.getpid()))
    assert is_running(tmp_path)
    (tmp_path / ".lock").write_text("")
    assert not is_running(tmp_path)
    (tmp_path / ".lock").write_text("999999999")
    assert not is_running(tmp_path)


def test_budget_in_real_steps(tmp_path):
    a_run(tmp_path / "a", dataclasses.replace(CONFIG, real_steps=36_000), TIMED)
    seen = status_of(read(tmp_path / "a"), now=time.time() + 100)
    assert (seen.iteration, seen.iterations, seen.state) == (10, 12, "stopped")
    assert 99 < seen.seconds_since < 200
    a_run(tmp_path / "b", dataclasses.replace(CONFIG, real_steps=30_000), TIMED)
    assert status_of(read(tmp_path / "b")).state == "finished"
    a_run(
        tmp_path / "c", dataclasses.replace(CONFIG, real_steps=0, iterations=10), [r | {"real_steps": 0} for r in TIMED]
    )
    assert status_of(read(tmp_path / "c")).state == "finished"
