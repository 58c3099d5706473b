"""Learning curves over seeds: every seed's own, their mean and a band around it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from metrpo.run.find import Group, SeenRun
from metrpo.statistics import common_grid, mean_band

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


def curve(group: Group, x: str, y: str, log: bool = False, log_y: bool = False) -> Curve:
    """The column `y` of a group's runs against their column `x`; points without either are left out.

    `log` and `log_y` say which axes are logarithmic: a seed's line is straight between its points as it is drawn, so
    that the band has to be taken from lines that are straight there. Points at or below zero have no place on such an
    axis and are left out.
    """
    seeds = [s for run in group.runs if len((s := _points(run, x, y, log, log_y))[0])]
    nothing = np.empty(0)
    if not seeds:
        return Curve([], nothing, nothing, nothing, nothing)
    if len(seeds) == 1:
        return Curve(seeds, *seeds[0], seeds[0][1], seeds[0][1])
    first, last = max(s[0][0] for s in seeds), min(s[0][-1] for s in seeds)
    if first > last:
        return Curve(seeds, nothing, nothing, nothing, nothing)
    grid = common_grid(seeds, POINTS, log)
    return Curve(seeds, grid, *mean_band(seeds, grid, log, log_y))


def x_axis(runs: Sequence[SeenRun]) -> tuple[str, str]:
    """The column against which these runs are drawn, and its name: real steps, where they grow at all."""
    if all((np.diff(run.column("real_steps"), prepend=0) > 0).all() for run in runs):
        return "real_steps", "real steps"
    return "iteration", "iteration"


def is_far(x: str, ends: Sequence[float]) -> bool:
    """Whether runs that end at these x are drawn on a logarithmic axis: those with and without models."""
    return x == "real_steps" and min(ends) > 0 and max(ends) > FAR * min(ends)


def _points(run: SeenRun, x: str, y: str, log: bool, log_y: bool) -> tuple[np.ndarray, np.ndarray]:
    xs, ys = run.column(x), run.column(y)
    there = np.isfinite(xs) & np.isfinite(ys)
    there &= ((xs > 0) | (not log)) & ((ys > 0) | (not log_y))
    xs, ys = xs[there], ys[there]
    # A clock may stand still between two rows, and curves are read along x.
    grows = np.append(True, np.diff(np.maximum.accumulate(xs)) > 0)[: len(xs)]
    return xs[grows], ys[grows]
