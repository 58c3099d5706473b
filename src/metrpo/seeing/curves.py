"""Learning curves over seeds: every seed's own, their mean and a band around it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from metrpo.experiments.statistics import mean_band
from metrpo.seeing.runs import Group, SeenRun

POINTS = 60
"""Of a mean curve."""
FAR = 8
"""The longest run over the shortest one, beyond which real steps stand on a logarithmic axis."""
RATIOS = ("error_", "disagreement_")
"""Columns that begin so stand on a logarithmic axis; an error of 1 is that of predicting no change."""


class Curve(NamedTuple):
    """A quantity of one group against x."""

    seeds: list[tuple[np.ndarray, np.ndarray]]
    """(x, y) of every run that has any."""
    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    """Where all seeds have been measured: their mean, and its 95 % bootstrap interval (of two seeds, their range; of
    one, itself). Empty where the seeds have no x in common."""


def curve(group: Group, x: str, y: str) -> Curve:
    """The column `y` of a group's runs against their column `x`; points without either are left out."""
    seeds = [s for run in group.runs if len((s := _points(run, x, y))[0])]
    nothing = np.empty(0)
    if not seeds:
        return Curve([], nothing, nothing, nothing, nothing)
    if len(seeds) == 1:
        return Curve(seeds, *seeds[0], seeds[0][1], seeds[0][1])
    first, last = max(s[0][0] for s in seeds), min(s[0][-1] for s in seeds)
    if first > last:
        return Curve(seeds, nothing, nothing, nothing, nothing)
    grid = np.linspace(first, last, POINTS) if last > first else np.array([first])
    return Curve(seeds, grid, *mean_band(seeds, grid))


def x_axis(runs: Sequence[SeenRun]) -> tuple[str, str]:
    """The column against which these runs are drawn, and its name: real steps, where they grow at all."""
    if all((np.diff(run.column("real_steps"), prepend=0) > 0).all() for run in runs):
        return "real_steps", "real steps"
    return "iteration", "iteration"


def _points(run: SeenRun, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    xs, ys = run.column(x), run.column(y)
    there = np.isfinite(xs) & np.isfinite(ys)
    xs, ys = xs[there], ys[there]
    # A clock may stand still between two rows, and curves are read along x.
    grows = np.append(True, np.diff(np.maximum.accumulate(xs)) > 0)[: len(xs)]
    return xs[grows], ys[grows]
