"""What a figure's runs say in numbers: returns over seeds with their intervals, and how the systems compare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import rows_of
from metrpo.paper.figures import FIGURES
from metrpo.report.tables import markdown
from metrpo.run.metrics import Row, column
from metrpo.statistics import (
    at_steps,
    common_grid,
    iqm,
    mean_band,
    probability_of_improvement,
    steps_to_reach,
    stratified_bootstrap,
)

GRID = 60
"""Points of a mean curve."""


class Curves(NamedTuple):
    """One system on one task: all seeds that have run."""

    task: str
    label: str
    runs: list[RunSpec]
    rows: list[list[Row]]
    """Of every seed."""

    def column(self, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """(real steps, values) of every seed."""
        return [(column(rows, "real_steps"), column(rows, name)) for rows in self.rows]


def curves_of(figure: str, runs: Sequence[RunSpec], out: Path) -> list[Curves]:
    """What has been measured for a figure, by task and in the order of its legend; systems not begun are absent."""
    found = []
    for task in FIGURES[figure].tasks:
        for label, system in FIGURES[figure].systems.items():
            measured = {r: rows_of(r, out) for r in runs if (r.task, r.system) == (task, system)}
            begun = {r: rows for r, rows in measured.items() if rows}
            if begun:
                found.append(Curves(task, label, list(begun), list(begun.values())))
    return found


def mean_curve(curves: Curves, column: str, log: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Real steps [G], mean over seeds [G], and its 95 % bootstrap interval [G], [G] (of two seeds: their range).

    Where all seeds have been measured; with `log` as lines between the points are drawn on a logarithmic axis.
    """
    seeds = curves.column(column)
    grid = common_grid(seeds, GRID, log)
    return grid, *mean_band(seeds, grid, log)


def summarise(figure: str, runs: Sequence[RunSpec], out: Path) -> list[dict[str, Any]]:
    """One record for each task and system of a figure; returns are real ones.

    `last`, `best`: of every seed. `common_steps`: real steps that every seed of every system of this task has reached.
    `at_common`: the return there, `average`: the mean return up to there (how soon it learns), both of every seed and
    with the interquartile mean and its 95 % interval. `first_better`: the probability that a seed of the figure's first
    system has the higher return (average) there. `level`: 95 % of the way from the first system's first measurement to
    its last, means over its seeds; `steps`: real steps after which the mean over the seeds reaches that level (NaN:
    never); `ratio`: how many times the first system's own. What had not been measured by the common steps is NaN.
    """
    records = []
    everything = curves_of(figure, runs, out)
    for task in FIGURES[figure].tasks:
        here = [c for c in everything if c.task == task]
        records += [_record(c, here, next(iter(FIGURES[figure].systems))) for c in here]
    return records


def _record(curves: Curves, here: list[Curves], first_label: str) -> dict[str, Any]:
    returns = curves.column("return_real")
    common = min(steps[-1] for c in here for steps, _ in c.column("return_real"))
    at, average = _at(curves, common), _average(curves, common)
    record = {
        "task": curves.task,
        "system": curves.label,
        "seeds": len(curves.runs),
        "real_steps": int(min(steps[-1] for steps, _ in returns)),
        "last": [float(r[-1]) for _, r in returns],
        "best": [float(np.nanmax(r)) for _, r in returns],
        "common_steps": int(common),
        "at_common": at.tolist(),
        "at_common_iqm": _iqm(at),
        "average": average.tolist(),
        "average_iqm": _iqm(average),
        "minutes": [float(rows[-1].get("wall_seconds") or np.nan) / 60 for rows in curves.rows],
    }
    first = next((c for c in here if c.label == first_label), None)
    if first is not None:
        level = _level(first)
        steps = _steps_to(curves, level)
        record["first_better"] = [
            float(probability_of_improvement(_at(first, common), at)),
            float(probability_of_improvement(_average(first, common), average)),
        ]
        record |= {"level": level, "steps": steps, "ratio": steps / _steps_to(first, level)}
    return record


def as_markdown(records: Sequence[dict[str, Any]]) -> str:
    """The records as a Markdown table."""
    heads = (
        "task",
        "system",
        "real steps",
        "last return",
        "at common steps",
        "average up to there",
        "P(first better) at, average",
        "steps to 95 % of the first's gain",
    )
    return markdown(heads, [_cells(r) for r in records])


def _cells(r: dict[str, Any]) -> tuple[str, ...]:
    steps = r.get("steps", np.nan)
    reached = f"{steps:,.0f} ({r.get('ratio', np.nan):.2g}x)" if np.isfinite(steps) else "not reached"
    reached = reached if "level" in r else "-"  # the first system has not been run
    return (
        r["task"],
        r["system"],
        f"{r['real_steps']:,}",
        f"{np.mean(r['last']):.1f} ({', '.join(f'{x:.1f}' for x in r['last'])})",
        f"{_interval(r['at_common_iqm'])} ({r['common_steps']:,})",
        _interval(r["average_iqm"] if np.isfinite(r["at_common_iqm"][0]) else r["at_common_iqm"]),
        ", ".join("-" if np.isnan(p) else f"{p:.2f}" for p in r.get("first_better", [np.nan] * 2)),
        reached,
    )


def _interval(iqm_low_high: Sequence[float]) -> str:
    return "{:.1f} [{:.1f}, {:.1f}]".format(*iqm_low_high) if np.isfinite(iqm_low_high[0]) else "not measured yet"


def _iqm(scores: np.ndarray) -> list[float]:
    """Interquartile mean and its 95 % interval; with fewer than three seeds the range of what resampling gives."""
    return [float(x) for x in (iqm(scores), *stratified_bootstrap(iqm, scores))]


def _average(curves: Curves, common: float) -> np.ndarray:
    """Mean return from a seed's first measurement to the common steps, for every seed; NaN when that comes later."""
    # Of a grid that runs backwards, the points before the first measurement are NaN.
    return np.array([at_steps([s], np.linspace(s[0][0], common, GRID)).mean() for s in curves.column("return_real")])


def _level(curves: Curves) -> float:
    start, end = (np.mean([returns[i] for _, returns in curves.column("return_real")]) for i in (0, -1))
    return float(start + 0.95 * (end - start))


def _at(curves: Curves, steps: float) -> np.ndarray:
    return at_steps(curves.column("return_real"), np.array([steps]))[:, 0]


def _steps_to(curves: Curves, level: float) -> float:
    """When the mean over the seeds reaches the level; NaN if never."""
    seeds = curves.column("return_real")
    first, last = max(steps[0] for steps, _ in seeds), min(steps[-1] for steps, _ in seeds)
    grid = np.unique(np.concatenate([steps for steps, _ in seeds]))
    grid = grid[(grid >= first) & (grid <= last)]
    return steps_to_reach(grid, at_steps(seeds, grid).mean(axis=0), level)
