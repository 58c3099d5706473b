"""Figures out of finished and unfinished runs: pictures, their numbers, and what to know about them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from metrpo.experiments.draw import draw
from metrpo.experiments.figures import FIGURES, Run
from metrpo.experiments.reproduce import differences, is_finished, rows_of, with_other_seeds
from metrpo.experiments.summary import as_markdown, summarise
from metrpo.run.files import atomic_write


def publish(
    names: Sequence[str], runs: Sequence[Run], out: Path, tell: Callable[[str], None]
) -> dict[str, list[dict[str, Any]]]:
    """Draws the named figures into `out`/figures, writes their numbers beside them and returns these.

    Shows all seeds that have been run, also beyond those of `runs`.

    Tells what is unfinished and which runs were made with other settings than today's. Raises `RunDirectoryError` when
    a file cannot be written.
    """
    numbers: dict[str, list[dict[str, Any]]] = {}
    runs = with_other_seeds(list(runs), out)
    for run in runs:
        _tell_about(run, out, tell)
    for name in names:
        path = out / "figures" / f"{name}.png"
        shown = [r for r in runs if r.task in FIGURES[name].tasks]
        if not draw(name, shown, out, path):
            tell(f"{name}: nothing to draw yet")
            continue
        numbers[name] = summarise(name, shown, out)
        # A level that was not reached is NaN, which is no JSON.
        text = json.dumps(numbers[name], indent=1).replace("NaN", "null")
        atomic_write(path.with_suffix(".json"), text + "\n")
        atomic_write(path.with_suffix(".md"), as_markdown(numbers[name]) + "\n")
        tell(f"\n{FIGURES[name].title}: {path}\n{as_markdown(numbers[name])}")
    return numbers


def _tell_about(run: Run, out: Path, tell: Callable[[str], None]) -> None:
    if not rows_of(run, out):
        tell(f"{run.name}: not begun")
        return
    if not is_finished(run, out):
        tell(f"{run.name}: not finished, {rows_of(run, out)[-1]['real_steps']:,} real steps so far")
    if other := differences(run, out):
        told = ", ".join(f"{name} {was} (today {now})" for name, (was, now) in other.items())
        tell(f"{run.name}: made with other settings: {told}")
