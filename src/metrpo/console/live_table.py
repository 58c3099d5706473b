"""Many runs at a glance in the terminal: progress, returns, warnings, running or stopped."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from metrpo.console.result_lines import duration, rounded
from metrpo.console.run_status import RunStatus, statuses_of
from metrpo.run.find import FoundRuns, find
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


def table(found: FoundRuns, console: Console) -> Group:
    """One line per run, running ones first, with as many columns as fit; below, the runs that cannot be read."""
    order = ("running", "stopped", "finished")
    statuses = sorted(statuses_of(found.runs), key=lambda s: order.index(s.state))
    columns = [name for name in _COLUMNS if name != "changed" or any(s.changed for s in statuses)]
    grid = _grid(columns, statuses)
    for spare in _SPARE:
        if Measurement.get(console, console.options.update(max_width=9999), grid).maximum <= console.width:
            break
        columns = [name for name in columns if name != spare]
        grid = _grid(columns, statuses)
    below = [Text(f"skipped: {skipped.why}", style="yellow", overflow="fold") for skipped in found.skipped]
    return Group(grid, *below)


def _grid(columns: Sequence[str], statuses: Sequence[RunStatus]) -> Table:
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for name in columns:
        left = name in ("run", "task", "system", "preset", "changed", "so far", "state")
        grid.add_column(name, justify="left" if left else "right", no_wrap=name != "task", overflow="fold")
    names = _names([s.path for s in statuses])
    for s in statuses:
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


def _cells(s: RunStatus) -> dict[str, tuple[str, str]]:
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
        "return": (f"{rounded(s.return_collected)} collected" if is_robots else rounded(s.return_real), "bold"),
        "best": (rounded(s.return_best), ""),
        "gap": (rounded(s.gap), ""),
        "so far": (sparkline(s.returns_collected if is_robots else s.returns), "cyan"),
        "warnings": (str(s.warnings) if s.warnings else "-", "bold red" if s.warnings else ""),
        "s/iteration": ("-" if s.seconds_per_iteration is None else f"{s.seconds_per_iteration:.1f}", ""),
        "left": ("-" if s.seconds_left is None else duration(s.seconds_left), ""),
        "state": (s.state + since, colour),
    }
