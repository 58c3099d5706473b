"""`metrpo compare` compares groups of runs in a table."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.options import Switch, require_directories
from metrpo.commands.output import warn_of_skipped
from metrpo.errors import ConfigError


@dataclass(frozen=True)
class Compare:
    """Compare runs, seeds grouped by task and settings: returns, intervals, real steps needed, and which is better.

    For example:
        metrpo compare runs/sweep
        metrpo compare runs/mine runs/theirs --level 100 --out table.tex
        metrpo compare runs --level Swimmer=100 Hopper=300 --against me-trpo --json
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN_OR_FOLDER...")]
    """Run directories, or folders with runs inside."""
    level: Annotated[tuple[str, ...], arg(metavar="RETURN...")] = ()
    """Count the real steps to this return: a number, or TASK=NUMBER for each task; default: the highest mean return
    that all groups reach."""
    against: Annotated[str | None, arg(metavar="SYSTEM")] = None
    """The group to compare the others with, as the table names it; default: me-trpo, or each task's first."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the table to this file: .md, .csv, .tex or .html."""
    json: Switch = False
    """Print JSON."""

    def __post_init__(self) -> None:
        require_directories("compare", self.dirs)


def run(command: Compare) -> int:
    """Returns the exit code."""
    from metrpo.comparison import HEADER, cells, compare, notes, whole
    from metrpo.report.tables import markdown, written
    from metrpo.run.files import atomic_write
    from metrpo.run.find import find

    levels = levels_of(command.level)
    found = find(command.dirs)
    warn_of_skipped([{"path": path, "why": why} for path, why in found.skipped])
    compared = compare(found.runs, levels, command.against)
    table = (HEADER, [cells(one) for one in compared], notes(compared))
    if command.out is not None:
        kind = command.out.suffix.removeprefix(".").lower()
        if kind == "csv":
            rows = [whole(one) for one in compared]
            text = written(kind, tuple(rows[0]), [tuple(row.values()) for row in rows], [])
        else:
            text = written(kind, *table)
        atomic_write(command.out, text)
    if command.json:
        print(json.dumps([one.plain() for one in compared], indent=1))
    else:
        print(command.out if command.out is not None else markdown(*table).rstrip())
    return 0


def levels_of(texts: tuple[str, ...]) -> dict[str, float] | float | None:
    """The levels as typed. Raises `ConfigError` for what is no number or TASK=NUMBER."""
    by_task: dict[str, float] = {}
    for text in texts:
        task, equals, number = text.rpartition("=")
        try:
            by_task[task if equals else ""] = float(number)
        except ValueError:
            raise ConfigError(f"level: expected a number or TASK=NUMBER, got {text!r}") from None
    if "" in by_task and len(texts) > 1:
        raise ConfigError(f"level: expected one number, or TASK=NUMBER for each task, got {' '.join(texts)}")
    return by_task.get("", by_task or None)
