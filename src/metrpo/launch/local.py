"""Many runs on this machine: one process each, among which the cores are divided."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from metrpo.console.result_lines import duration
from metrpo.counting import counted
from metrpo.errors import MetrpoError
from metrpo.launch.backend import Means
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import Tell, has_spent, log_of, rows_of, standing, tail, tell_failure, tell_success, words
from metrpo.run import machine

_POLL = 0.5
"""Seconds between two looks at the processes."""
_REPORT = 60.0
"""Seconds between two progress reports."""


@dataclass(frozen=True)
class _Child:
    run: RunSpec
    process: subprocess.Popen[bytes]
    cores: tuple[int, ...]
    began: float


def run_locally(runs: list[RunSpec], out: Path, means: Means, tell: Tell) -> list[RunSpec]:
    """Runs all, several at a time on their own cores, and returns those that failed (see `reproduce`)."""
    jobs = means.jobs or max(1, machine.cores() // (means.cpus or 1))
    tell(f"{jobs} at a time on this machine")
    machine.divide_gpu(jobs)
    free, failed = shares_of_cores(jobs, means.cpus), list[RunSpec]()
    children: list[_Child] = []
    reported = time.monotonic()
    waiting = list(runs)
    try:
        while waiting or children:
            while waiting and free:
                run, cores = waiting.pop(0), free.pop(0)
                children.append(_Child(run, start(run, out, cores), cores, time.monotonic()))
            time.sleep(_POLL)
            for child in [c for c in children if c.process.poll() is not None]:
                children.remove(child)
                free.append(child.cores)
                ended = len(runs) - len(waiting) - len(children)
                if _finish(child, out, f"{ended}/{len(runs)}", tell):
                    failed.append(child.run)
            if time.monotonic() - reported > _REPORT:
                reported = time.monotonic()
                for child in children:
                    tell(f"  {child.run.name}: {standing(child.run, rows_of(child.run, out))}")
    finally:
        _stop(children, tell)
    return failed


def _stop(children: list[_Child], tell: Tell) -> None:
    """Stops the runs: each finishes its iteration. When interrupted, stops them at once."""
    if children:
        tell(f"stopping {counted(len(children), 'run')} at the end of an iteration; press again to stop at once")
    try:
        _ask_to_stop(children)
    except BaseException:
        _ask_to_stop(children)
        raise


def _ask_to_stop(children: list[_Child]) -> None:
    for child in children:
        child.process.terminate()
    for child in children:
        child.process.wait()


def start(run: RunSpec, out: Path, cores: tuple[int, ...]) -> subprocess.Popen[bytes]:
    """Starts the run as its own `metrpo train` on these cores. Raises `MetrpoError` when `out` cannot be written."""
    directory = out / run.name
    try:
        directory.mkdir(parents=True, exist_ok=True)
        log = os.open(log_of(run, out), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        raise MetrpoError(f"cannot write {directory}: {error.strerror or error}; choose another --out") from error
    # Its own session: Ctrl-C goes to this process only, which then ends its children one by one.
    process = subprocess.Popen(_command(run, directory), stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
    os.close(log)  # the process has its own
    if cores:
        with contextlib.suppress(OSError):  # it may have ended already
            os.sched_setaffinity(process.pid, cores)
    return process


def _command(run: RunSpec, directory: Path) -> list[str]:
    return [sys.executable, "-m", "metrpo", *words(run, directory)]


def _finish(child: _Child, out: Path, count: str, tell: Tell) -> bool:
    """Reports how a run ended; returns whether it failed."""
    rows, seconds = rows_of(child.run, out), time.monotonic() - child.began
    if child.process.returncode == 0 and has_spent(child.run, rows):
        tell_success(child.run, count, rows, seconds, tell)
        return False
    log = log_of(child.run, out)
    why = f"after {duration(seconds)} (exit code {child.process.returncode}); the end of {log}:"
    tell_failure(child.run, count, why, tail(log), tell)
    return True


def shares_of_cores(jobs: int, each: int | None = None) -> list[tuple[int, ...]]:
    """The cores of this process, shared among the jobs; empty shares where they cannot be assigned."""
    if not hasattr(os, "sched_setaffinity"):
        return [()] * jobs
    own = sorted(os.sched_getaffinity(0))
    each = min(each or max(1, len(own) // jobs), len(own))
    return [tuple(own[(i * each + n) % len(own)] for n in range(each)) for i in range(jobs)]
