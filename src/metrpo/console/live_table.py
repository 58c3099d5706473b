"""Many runs at a glance in the terminal: progress, returns, warnings, running or stopped."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from metrpo import budget
from metrpo.checks.health import examine
from metrpo.console.result_lines import duration
from metrpo.run.episodes import waiting_steps
from metrpo.run.find import FoundRuns, SeenRun, find, is_finished, told_apart
from metrpo.run.metrics import numbers

SPARKS = "▁▂▃▄▅▆▇█"
_WIDE = 170
"""Width of a table that is not printed on a terminal, in characters."""
_COLUMNS = (
    "run", "task", "system", "preset", "seed", "changed", "iteration", "real steps", "return", "best", "gap", "so far",
    "warnings", "s/iteration", "left", "state",
)  # fmt: skip
_SPARE = ("s/iteration", "best", "preset", "real steps", "gap", "left", "so far", "system", "changed", "seed", "run")
"""Columns that a narrow terminal drops, first ones first."""
_RECENT = 3
"""Number of last iterations whose median duration predicts the next ones (durations grow with the data)."""


@dataclass(frozen=True)
class Standing:
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


def standing(run: SeenRun, now: float | None = None, changed: Mapping[str, str] | None = None) -> Standing:
    """The status of a run; `now` is the time in seconds, `changed` what tells it from other runs (`told_apart`)."""
    config, rows = run.config, run.rows
    real, collected, concerns = (
        run.column("return_real"),
        run.column("return_collected"),
        examine(rows, config, run.yardsticks),
    )
    seconds = _seconds(run)
    total, iteration = _total(run), int(rows[-1]["iteration"] or 0) if rows else 0
    state = "finished" if is_finished(run) else "running" if is_running(run.path) else "stopped"
    left = seconds * (total - iteration) if seconds is not None and total is not None and state == "running" else None
    finite = real[np.isfinite(real)]
    written = _written(run.path)
    return Standing(
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


def sparkline(values: Sequence[float | None], width: int = 12) -> str:
    """A history as at most `width` small bars, from its least to its largest value; missing values are gaps."""
    whole = numbers(values)
    parts = np.array_split(whole, min(width, len(whole)) or 1)
    shown = [float(np.mean(f)) if len(f := part[np.isfinite(part)]) else math.nan for part in parts]
    finite = [v for v in shown if math.isfinite(v)]
    if not finite:
        return ""
    low, way = min(finite), max(finite) - min(finite)
    top = len(SPARKS) - 1
    return "".join(SPARKS[round((v - low) / way * top) if way else 0] if math.isfinite(v) else " " for v in shown)


def standings_of(runs: Sequence[SeenRun]) -> list[Standing]:
    """The status of each run, and the settings that tell it from the others."""
    return [standing(run, changed=changed) for run, changed in zip(runs, told_apart(runs), strict=True)]


def table(found: FoundRuns, console: Console) -> Group:
    """One line per run, running ones first, with as many columns as fit; below, the runs that cannot be read."""
    order = ("running", "stopped", "finished")
    standings = sorted(standings_of(found.runs), key=lambda s: order.index(s.state))
    columns = [name for name in _COLUMNS if name != "changed" or any(s.changed for s in standings)]
    grid = _grid(columns, standings)
    for spare in _SPARE:
        if Measurement.get(console, console.options.update(max_width=9999), grid).maximum <= console.width:
            break
        columns = [name for name in columns if name != spare]
        grid = _grid(columns, standings)
    below = [Text(f"skipped: {skipped.why}", style="yellow", overflow="fold") for skipped in found.skipped]
    return Group(grid, *below)


def _grid(columns: Sequence[str], standings: Sequence[Standing]) -> Table:
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for name in columns:
        left = name in ("run", "task", "system", "preset", "changed", "so far", "state")
        grid.add_column(name, justify="left" if left else "right", no_wrap=name != "task", overflow="fold")
    names = _names([s.path for s in standings])
    for s in standings:
        cells = _cells(s) | {"run": (names[s.path], "")}
        # Text from a run directory must not be read as markup.
        grid.add_row(*(Text(*cells[name]) for name in columns))
    return grid


def watch(paths: Sequence[Path], every: float, once: bool, console: Console | None = None) -> None:
    """Shows the table, and updates it until Ctrl-C unless `once`; new runs are added.

    Raises `RunDirectoryError` when there is nothing to watch at first.
    """
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, _WIDE)
    shown = table(find(paths), console)
    if once:
        console.print(shown)
        return
    if not console.is_terminal:
        while True:
            console.print(shown)
            time.sleep(every)
            shown = table(find(paths), console)
    with Live(shown, console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while True:
            time.sleep(every)
            live.update(table(find(paths), console), refresh=True)


def _names(paths: Sequence[str]) -> dict[str, str]:
    """The paths without the folder that all share."""
    if len(paths) == 1:
        return {paths[0]: Path(paths[0]).name or paths[0]}
    try:
        shared = os.path.commonpath(paths)
    except ValueError:  # some are absolute and others are not
        return {path: path for path in paths}
    return {path: os.path.relpath(path, shared) if shared else path for path in paths}


def _cells(s: Standing) -> dict[str, tuple[str, str]]:
    """Text and style by column."""
    colour = {"running": "green", "stopped": "red", "finished": "dim"}[s.state]
    # Only another program plays, on a robot, say.
    is_robots = all(r is None for r in s.returns) and s.return_collected is not None
    since = f" {duration(s.seconds_since)} ago" if s.state == "stopped" and s.seconds_since is not None else ""
    return {
        "task": (s.task, ""),
        "system": (s.system, ""),
        "preset": (s.preset, ""),
        "seed": (str(s.seed), ""),
        "changed": (", ".join(f"{name}={value}" for name, value in s.changed.items()), ""),
        "iteration": (f"{s.iteration}/{'?' if s.iterations is None else s.iterations}", ""),
        "real steps": (f"{s.real_steps:,}" + (f" +{s.waiting_steps:,}" if s.waiting_steps else ""), ""),
        "return": (f"{_number(s.return_collected)} collected" if is_robots else _number(s.return_real), "bold"),
        "best": (_number(s.return_best), ""),
        "gap": (_number(s.gap), ""),
        "so far": (sparkline(s.returns_collected if is_robots else s.returns), "cyan"),
        "warnings": (str(s.warnings) if s.warnings else "-", "bold red" if s.warnings else ""),
        "s/iteration": ("-" if s.seconds_per_iteration is None else f"{s.seconds_per_iteration:.1f}", ""),
        "left": ("-" if s.seconds_left is None else duration(s.seconds_left), ""),
        "state": (s.state + since, colour),
    }


def _total(run: SeenRun) -> int | None:
    """Number of iterations when the budget is spent."""
    done, steps = (int(run.rows[-1][name] or 0) if run.rows else 0 for name in ("iteration", "real_steps"))
    left = budget.iterations_left(run.config, done, steps)
    return None if left is None else done + left


def _seconds(run: SeenRun) -> float | None:
    """Seconds of the next iteration, predicted from the last ones; None without a clock."""
    wall = np.append(0.0, run.column("wall_seconds"))[-_RECENT - 1 :]
    steps = np.diff(wall)
    if len(steps) == len(run.rows) > 1:
        steps = steps[1:]  # the first one compiled
    return float(np.median(steps)) if len(steps) and np.isfinite(steps).all() else None


def _written(folder: Path) -> float | None:
    """When a file was last written: an episode, or a whole iteration."""
    times = []
    for path in (folder / "metrics.csv", folder / "episodes", folder / "run.json"):
        try:
            times.append(path.stat().st_mtime)
        except OSError:
            continue
    return max(times, default=None)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
