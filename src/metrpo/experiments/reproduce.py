"""Runs what a figure of the paper needs and is missing, several runs at a time, each a `metrpo train` of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from metrpo.config import difference, from_json
from metrpo.errors import MetrpoError
from metrpo.experiments.figures import FIGURES, Run, run_of
from metrpo.run.metrics import Row, read_metrics
from metrpo.run.progress import duration

Tell = Callable[[str], None]
_POLL = 0.5
"""Seconds between two looks at the processes."""
_REPORT = 60.0
"""Seconds between two lines on what goes on."""
_TAIL = 5
"""Lines of a failed run's log that are shown."""


@dataclass(frozen=True)
class _Child:
    run: Run
    process: subprocess.Popen[bytes]
    cores: tuple[int, ...]
    began: float


def rows_of(run: Run, out: Path) -> list[Row]:
    """What the run has measured so far; nothing when it has not begun."""
    metrics = out / run.name / "metrics.csv"
    return read_metrics(metrics) if metrics.exists() else []


def is_finished(run: Run, out: Path) -> bool:
    """Whether the run has spent its budget: its metrics alone say so, checkpoints need not be there."""
    rows, config = rows_of(run, out), run.config
    if not rows:
        return False
    if config.real_steps is not None:
        return int(rows[-1]["real_steps"] or 0) >= config.real_steps
    return int(rows[-1]["iteration"] or 0) >= config.iterations


def differences(run: Run, out: Path) -> dict[str, tuple[object, object]]:
    """Settings with which the run on disk was made, and others that it would have today."""
    path = out / run.name / "config.json"
    if not path.exists():
        return {}
    return difference(from_json(path.read_text()), run.config)


def runs_there(figure: str, scale: str, tasks: tuple[str, ...], out: Path) -> list[Run]:
    """The runs of a figure that lie under `out`, of any seed; of all its tasks unless `tasks` names some."""
    found = []
    for task in tasks or FIGURES[figure].tasks:
        for system in FIGURES[figure].systems.values():
            numbers = [d.name.removeprefix("seed-") for d in (out / task / system).glob("seed-*/")]
            found += [run_of(scale, task, system, seed) for seed in sorted(int(n) for n in numbers if n.isdecimal())]
    return [run for run in found if rows_of(run, out)]


def reproduce(runs: list[Run], out: Path, jobs: int, tell: Tell) -> list[Run]:
    """Runs all that is not finished, `jobs` at a time on cores of their own, and returns those that failed.

    Started anew it goes on where it was stopped. Ctrl-C or SIGTERM stops the runs too, each with its iteration
    saved; once more stops them at once.

    Raises `MetrpoError` when `out` cannot be written.
    """
    missing = [run for run in runs if not is_finished(run, out)]
    tell(f"{len(runs) - len(missing)} of {len(runs)} runs are finished; {len(missing)} to go, {jobs} at a time")
    free, failed = _shares_of_cores(jobs), list[Run]()
    children: list[_Child] = []
    reported = time.monotonic()
    waiting = list(missing)
    try:
        while waiting or children:
            while waiting and free:
                children.append(_start(waiting.pop(0), out, free.pop(0)))
            time.sleep(_POLL)
            for child in [c for c in children if c.process.poll() is not None]:
                children.remove(child)
                free.append(child.cores)
                done = len(missing) - len(waiting) - len(children)
                if _finish(child, out, f"{done}/{len(missing)}", tell):
                    failed.append(child.run)
            if time.monotonic() - reported > _REPORT:
                reported = time.monotonic()
                for child in children:
                    tell(f"  {child.run.name}: {_standing(child.run, out)}")
    finally:
        _stop(children, tell)
    return failed


def _stop(children: list[_Child], tell: Tell) -> None:
    """Ends the runs: asked once, each finishes its iteration; when this is interrupted, it asks them once more."""
    if children:
        tell(f"stopping {len(children)} runs after their iteration; once more stops them at once")
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


def _start(run: Run, out: Path, cores: tuple[int, ...]) -> _Child:
    directory = out / run.name
    try:
        directory.mkdir(parents=True, exist_ok=True)
        log = os.open(out / f"{run.name}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        raise MetrpoError(f"cannot write {directory}: {error.strerror or error}; choose another --out") from error
    # A session of its own: Ctrl-C is for this process, which then ends its children one by one.
    process = subprocess.Popen(_command(run, directory), stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
    os.close(log)  # the process has its own
    if cores:
        with contextlib.suppress(OSError):  # it may have ended already
            os.sched_setaffinity(process.pid, cores)
    return _Child(run, process, cores, time.monotonic())


def _command(run: Run, directory: Path) -> list[str]:
    return [sys.executable, "-m", "metrpo", "train", *run.arguments, "--run-dir", str(directory), "--no-video"]


def _finish(child: _Child, out: Path, count: str, tell: Tell) -> bool:
    """Tells how a run ended; whether it failed."""
    failed = child.process.returncode != 0 or not is_finished(child.run, out)
    took = duration(time.monotonic() - child.began)
    if not failed:
        tell(f"[{count}] {child.run.name}: {_standing(child.run, out)}, in {took}")
        return False
    log = out / f"{child.run.name}.log"
    tail = log.read_text(errors="replace").splitlines()[-_TAIL:]
    tell(f"[{count}] {child.run.name}: FAILED after {took} (exit code {child.process.returncode}); the end of {log}:")
    for line in tail:
        tell(f"      {line}")
    return True


def _standing(run: Run, out: Path) -> str:
    rows = rows_of(run, out)
    if not rows:
        return "in its first iteration"
    last, of = rows[-1], run.config.iterations
    return f"iteration {last['iteration']}/{of}, {last['real_steps']:,} real steps, return {last['return_real']:.1f}"


def _shares_of_cores(jobs: int) -> list[tuple[int, ...]]:
    """The cores of this process, shared among the jobs; empty shares where they cannot be assigned."""
    if not hasattr(os, "sched_setaffinity"):
        return [()] * jobs
    mine = sorted(os.sched_getaffinity(0))
    each = max(1, len(mine) // jobs)
    return [tuple(mine[(i * each + n) % len(mine)] for n in range(each)) for i in range(jobs)]
