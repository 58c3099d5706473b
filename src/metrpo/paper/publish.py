"""Figures out of finished and unfinished runs: pictures, their numbers, and what to know about them."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from metrpo.counting import counted
from metrpo.launch.dispatch import differences
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import is_finished, rows_of
from metrpo.paper.figures import FIGURES, runs_there
from metrpo.paper.pictures import draw
from metrpo.paper.summary import as_markdown, summarise
from metrpo.run.files import atomic_write

_SHOWN = 4
"""Names of runs in a line."""


def publish(
    names: Sequence[str],
    scale: str,
    tasks: tuple[str, ...],
    asked: Sequence[RunSpec],
    out: Path,
    tell: Callable[[str], None],
) -> dict[str, list[dict[str, Any]]]:
    """Draws the named figures into `out`/figures, writes their numbers beside them and returns these.

    A figure shows all that has been run under `out`, of any seed, and of any of its tasks unless `tasks` names some.
    Tells what of the runs `asked` for is missing and what was made with other settings than today's. Raises
    `RunDirectoryError` when a file cannot be written.
    """
    shown = {name: runs_there(name, scale, tasks, out) for name in names}
    _tell_about(dict.fromkeys([*asked, *(run for runs in shown.values() for run in runs)]), out, tell)
    numbers: dict[str, list[dict[str, Any]]] = {}
    for name, runs in shown.items():
        path = out / "figures" / f"{name}.png"
        if not draw(name, runs, out, path):
            tell(f"{name}: nothing to draw yet")
            continue
        numbers[name] = summarise(name, runs, out)
        table = as_markdown(numbers[name])
        # A level that was not reached is NaN, which is no JSON.
        text = json.dumps(numbers[name], indent=1).replace("NaN", "null")
        atomic_write(path.with_suffix(".json"), text + "\n")
        atomic_write(path.with_suffix(".md"), table)
        tell(f"\n{FIGURES[name].title}: {path}\n{table.rstrip()}")
    return numbers


def _tell_about(runs: Iterable[RunSpec], out: Path, tell: Callable[[str], None]) -> None:
    """What is missing, and what was made with other settings than today's: runs of a kind together."""
    not_begun, otherwise = list[RunSpec](), defaultdict[str, list[RunSpec]](list)
    for run in runs:
        if not (rows := rows_of(run, out)):
            not_begun.append(run)
        elif not is_finished(run, out):
            tell(f"{run.name}: not finished, {counted(int(rows[-1]['real_steps'] or 0), 'real step')} so far")
        if other := differences(run, out):
            otherwise[", ".join(f"{name} {was} (today {now})" for name, (was, now) in other.items())].append(run)
    if not_begun:
        tell(f"not begun: {_names(not_begun)}")
    for told, those in otherwise.items():
        tell(f"made with other settings: {_names(those)}: {told}")


def _names(runs: Sequence[RunSpec]) -> str:
    """The first few, and how many more there are."""
    shown = runs if len(runs) <= _SHOWN else runs[: _SHOWN - 1]
    more = [f"{len(runs) - len(shown)} more"] if len(shown) < len(runs) else []
    return ", ".join([*(run.name for run in shown), *more])
