"""Figures out of finished and unfinished runs: pictures, their numbers, and what to know about them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
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
    for run in dict.fromkeys([*asked, *(run for runs in shown.values() for run in runs)]):
        _tell_about(run, out, tell)
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


def _tell_about(run: RunSpec, out: Path, tell: Callable[[str], None]) -> None:
    if not rows_of(run, out):
        tell(f"{run.name}: not begun")
        return
    if not is_finished(run, out):
        tell(f"{run.name}: not finished, {counted(int(rows_of(run, out)[-1]['real_steps'] or 0), 'real step')} so far")
    if other := differences(run, out):
        told = ", ".join(f"{name} {was} (today {now})" for name, (was, now) in other.items())
        tell(f"{run.name}: made with other settings: {told}")
