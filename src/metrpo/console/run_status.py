"""The status of a run, read off its directory: how far it is, what it earns, and whether a process is at it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from metrpo import budget
from metrpo.checks.health import examine
from metrpo.run.episodes import waiting_steps
from metrpo.run.find import SeenRun, is_finished, told_apart


@dataclass(frozen=True)
class RunStatus:
    """The status of a run, for the table and for scripts; None is unknown."""

    path: str
    task: str
    system: str
    preset: str
    seed: int
    changed: dict[str, str]
    """Settings that other runs of its task, system and preset have otherwise."""
    state: str
    """running, finished or stopped."""
    iteration: int
    iterations: int | None
    """Expected number of iterations."""
    real_steps: int
    """Real steps that it has learned from."""
    waiting_steps: int
    """Collected real steps that it has not learned from yet."""
    return_real: float | None
    return_best: float | None
    gap: float | None
    returns: list[float | None]
    return_collected: float | None
    """Return of the last iteration's episodes, with exploration noise."""
    returns_collected: list[float | None]
    warnings: int
    notes: int
    seconds_per_iteration: float | None
    seconds_left: float | None
    seconds_since: float | None
    """Seconds since a file was last written."""


def status_of(run: SeenRun, now: float | None = None, changed: Mapping[str, str] | None = None) -> RunStatus:
    """The status of a run; `now` is the time in seconds, `changed` what tells it from other runs (`told_apart`)."""
    config, rows = run.config, run.rows
    real, collected = run.column("return_real"), run.column("return_collected")
    concerns = examine(rows, config, run.yardsticks)
    seconds = _seconds(run)
    total, iteration = _total(run), int(rows[-1]["iteration"] or 0) if rows else 0
    state = "finished" if is_finished(run) else "running" if is_running(run.path) else "stopped"
    left = seconds * (total - iteration) if seconds is not None and total is not None and state == "running" else None
    finite = real[np.isfinite(real)]
    written = _written(run.path)
    return RunStatus(
        path=str(run.path),
        task=config.task,
        system=config.system,
        preset=config.preset,
        seed=config.seed,
        changed=dict(changed or {}),
        state=state,
        iteration=iteration,
        iterations=total,
        real_steps=int(rows[-1]["real_steps"] or 0) if rows else 0,
        waiting_steps=waiting_steps(run.path) if state != "finished" else 0,
        return_real=_plain(real[-1]) if rows else None,
        return_best=float(finite.max()) if len(finite) else None,
        gap=_plain(run.column("gap")[-1]) if rows else None,
        returns=[_plain(value) for value in real],
        return_collected=_plain(collected[-1]) if rows else None,
        returns_collected=[_plain(value) for value in collected],
        warnings=sum(c.level == "warning" for c in concerns),
        notes=sum(c.level == "note" for c in concerns),
        seconds_per_iteration=seconds,
        seconds_left=left,
        seconds_since=None if written is None else max(0.0, (time.time() if now is None else now) - written),
    )


def is_running(run_dir: Path) -> bool:
    """Whether a process holds the run's lock (see `metrpo.run.lock`), without touching that lock.

    This sees only the processes of this machine: a run on another one that shares the disk looks stopped.
    """
    lock = run_dir / ".lock"
    try:
        file, holder = lock.stat(), lock.read_text().strip()
        held = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
    except (OSError, UnicodeDecodeError):
        return _is_alive(lock)
    for words in held:
        # 1: FLOCK ADVISORY WRITE 4711 fe:00:123456 0 EOF; a waiting one has "->" and no file of its own.
        if len(words) < 6 or words[5].count(":") != 2 or words[1] == "->":
            continue
        major, minor, inode = words[5].split(":")
        here = (int(major, 16), int(minor, 16)) == (os.major(file.st_dev), os.minor(file.st_dev))
        # Layered file systems show another device here than stat does.
        if int(inode) == file.st_ino and (here or words[4] == holder):
            return True
    return False


def _is_alive(lock: Path) -> bool:
    """Where the system does not list its locks: whether the process that wrote the file is alive."""
    try:
        os.kill(int(lock.read_text()), 0)
    except (OSError, ValueError):
        return False
    return True


def statuses_of(runs: Sequence[SeenRun]) -> list[RunStatus]:
    """The status of each run, and the settings that tell it from the others."""
    return [status_of(run, changed=changed) for run, changed in zip(runs, told_apart(runs), strict=True)]


def _total(run: SeenRun) -> int | None:
    """Number of iterations when the budget is spent."""
    done, steps = (int(run.rows[-1][name] or 0) if run.rows else 0 for name in ("iteration", "real_steps"))
    left = budget.iterations_left(run.config, done, steps)
    return None if left is None else done + left


def _seconds(run: SeenRun) -> float | None:
    """Seconds of the next iteration, predicted from the last ones; None without a clock."""
    return budget.seconds_of_next(np.diff(run.column("wall_seconds"), prepend=0.0).tolist())


def _written(folder: Path) -> float | None:
    """When a file was last written: an episode, or a whole iteration."""
    times = []
    for path in (folder / "metrics.csv", folder / "episodes", folder / "run.json"):
        try:
            times.append(path.stat().st_mtime)
        except OSError:
            continue
    return max(times, default=None)


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
