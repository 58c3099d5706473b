"""Finds runs on disk and reads their files; damaged runs are named and skipped."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from metrpo import budget
from metrpo.config import Config, difference, from_json
from metrpo.counting import named_value
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.run import yardstick_record
from metrpo.run.metrics import Row, column, read_metrics

_INSIDE = {"checkpoints", "episodes", "events", ".git", ".venv", "node_modules", "__pycache__"}
"""Folders that hold no runs."""


@dataclass(frozen=True)
class SeenRun:
    """A run on disk."""

    path: Path
    config: Config
    rows: list[Row]
    """Its finished iterations; none during the first."""
    details: list[Row] = field(default_factory=list)
    """The rows of diagnostics.csv, each with its iteration; none for runs from before that file."""
    yardsticks: dict[str, float] = field(default_factory=dict)
    """Returns without skill, by name; empty where they were not measured."""

    def column(self, name: str) -> np.ndarray:
        """One number an iteration, of metrics.csv or else of diagnostics.csv; NaN where there is none."""
        if not self.details or any(name in row for row in self.rows):
            return column(self.rows, name)
        by_iteration = {row["iteration"]: row for row in self.details}
        return column([by_iteration.get(row["iteration"], {}) for row in self.rows], name)


class Skipped(NamedTuple):
    """A folder that looks like a run and cannot be read."""

    path: Path
    why: str


class FoundRuns(NamedTuple):
    """The runs under some folders, in the order of their paths."""

    runs: list[SeenRun]
    skipped: list[Skipped]


def find(paths: Sequence[Path]) -> FoundRuns:
    """The runs at or below `paths`, each once.

    A run is a folder with a config.json and, once an iteration is finished, a metrics.csv. Raises `RunDirectoryError`
    when a path does not exist, when there is no run at all, or when none can be read.
    """
    for path in paths:
        if not path.is_dir():
            what = "a file" if path.exists() else "nothing"
            raise RunDirectoryError(f"{path}: expected a run directory or a folder with runs inside, got {what}")
    runs, skipped = list[SeenRun](), list[Skipped]()
    for folder in {folder.resolve(): folder for path in paths for folder in _folders(path)}.values():
        file = folder
        try:
            runs.append(read(folder))
            file = folder / "diagnostics.csv"  # without which the run is whole
            runs[-1] = replace(runs[-1], details=_details(file))
        except RunDirectoryError as error:
            skipped.append(Skipped(file, str(error)))
    if not runs:
        where = ", ".join(map(str, paths))
        if skipped:
            why = "\n".join(f"  {s.why}" for s in skipped)
            raise RunDirectoryError(f"{where}: expected at least one run that can be read, got none:\n{why}")
        raise RunDirectoryError(
            f"{where}: expected a run (config.json and metrics.csv), got none; start one with: metrpo train TASK"
        )
    return FoundRuns(runs, skipped)


def read(folder: Path) -> SeenRun:
    """The run in `folder`. Raises `RunDirectoryError`, naming the file, when it cannot be read or makes no sense."""
    file, metrics = folder / "config.json", folder / "metrics.csv"
    try:
        config = from_json(file.read_text())
    except (OSError, ConfigError, UnicodeDecodeError) as error:
        raise RunDirectoryError(f"{file} cannot be read: {error}; put it back, or leave this run out") from None
    try:
        _require_whole(metrics)
        rows = read_metrics(metrics)
        _require_sense(rows, ("iteration", "real_steps", "return_real"))
    except FileNotFoundError:
        rows = []  # in its first iteration
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise RunDirectoryError(f"{metrics} cannot be read: {error}; put it back, or leave this run out") from None
    return SeenRun(folder, config, rows, yardsticks=yardstick_record.kept(folder))


def _details(file: Path) -> list[Row]:
    """The rows of a diagnostics.csv, none where there is no such file. Raises `RunDirectoryError` for a damaged one."""
    try:
        _require_whole(file)
        rows = read_metrics(file)
        _require_sense(rows, ("iteration", "real_steps"))
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise RunDirectoryError(f"{file} cannot be read: {error}; its charts are left out") from None
    return rows


def is_finished(run: SeenRun) -> bool:
    """Whether the budget is spent, according to the metrics."""
    return budget.spent(run.config, run.rows)


@dataclass(frozen=True)
class Group:
    """Runs of one task that differ only in seed and budget: the seeds of one learning curve."""

    task: str
    label: str
    runs: list[SeenRun]


def group(runs: Sequence[SeenRun]) -> list[Group]:
    """The runs by task and settings, tasks in order of their first run; labels tell a task's groups apart."""
    alike: list[list[SeenRun]] = []
    for run in runs:
        own = next((g for g in alike if not settings(g[0].config, run.config)), None)
        if own is None:
            alike.append([run])
        else:
            own.append(run)
    groups = []
    for task in dict.fromkeys(run.config.task for run in runs):
        here = [g for g in alike if g[0].config.task == task]
        labels = _labels([g[0].config for g in here])
        groups += [Group(task, label, runs) for label, runs in zip(labels, here, strict=True)]
    return groups


def no_skill(runs: Sequence[SeenRun]) -> dict[str, float]:
    """Returns without skill on the runs' task, by name: means over the runs that measured them, empty for none."""
    measured = [run.yardsticks for run in runs if run.yardsticks]
    return {name: float(np.mean([one[name] for one in measured])) for name in (measured[0] if measured else {})}


def settings(old: Config, new: Config) -> dict[str, tuple[object, object]]:
    """Settings that differ, seed and budget aside: `{"ensemble.members": (1, 5)}`."""
    return {name: values for name, values in difference(old, new).items() if name != "seed"}


def told_apart(runs: Sequence[SeenRun]) -> list[dict[str, str]]:
    """For each run, its values of the settings in which the runs of its task, system and preset differ."""
    alike: dict[tuple[str, ...], list[Config]] = {}
    for run in runs:
        alike.setdefault(_kind(run.config), []).append(run.config)
    names = {kind: dict.fromkeys(n for c in cs for n in settings(cs[0], c)) for kind, cs in alike.items()}
    return [{name: _value(run.config, name) for name in names[_kind(run.config)]} for run in runs]


def _kind(config: Config) -> tuple[str, ...]:
    return config.task, config.system, config.preset


def _labels(configs: list[Config]) -> list[str]:
    """A name for each config of one task: the system and, where that is not enough, the settings."""
    systems = [str(c.system) for c in configs]
    names: list[str] = []
    for config in configs:
        alike = [c for c in configs if c.system == config.system]
        differing = list(dict.fromkeys(n for c in alike for n in settings(alike[0], c)))
        words = [f"{n}={_value(config, n)}" for n in differing[:3]] + (["..."] if len(differing) > 3 else [])
        names.append(
            ", ".join([str(config.system), *words]) if systems.count(str(config.system)) > 1 else config.system
        )
    return [n if names.count(n) == 1 else f"{n} ({names[:i].count(n) + 1})" for i, n in enumerate(names)]


def _value(config: Config, name: str) -> str:
    value: object = config
    for part in name.split("."):
        value = getattr(value, part)
    return named_value(value)


def _folders(path: Path) -> list[Path]:
    found = []
    for folder, inside, files in os.walk(path):
        if "metrics.csv" in files or {"config.json", "run.json"} <= set(files):
            found.append(Path(folder))
        inside[:] = sorted(name for name in inside if name not in _INSIDE)
    return found


def _require_whole(metrics: Path) -> None:
    """Raises `ValueError` for a truncated copy: the reader would mistake missing cells for empty ones."""
    lines = metrics.read_text().split("\n")
    if lines.pop() or any(line.count(",") != lines[0].count(",") for line in lines):
        raise ValueError("it was cut within a row")


def _require_sense(rows: list[Row], needed: Sequence[str]) -> None:
    """Raises `ValueError` for rows that no run writes: the file was truncated or edited."""
    if not rows:
        raise ValueError("expected a row for each iteration, got none")
    columns = list(rows[0])
    if missing := [name for name in needed if name not in columns]:
        raise ValueError(f"expected the column {missing[0]}, got {', '.join(map(str, columns))[:80]}")
    for number, row in enumerate(rows, 1):
        if None in row or not isinstance(row["iteration"], int) or not isinstance(row["real_steps"], int):
            raise ValueError(f"row {number}: expected {len(columns)} cells beginning with two counts")
    counts = [int(row["iteration"] or 0) for row in rows]
    if counts != sorted(set(counts)):
        raise ValueError(f"expected iterations that go up, got {counts[:20]}")
