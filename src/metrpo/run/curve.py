"""The learning curve as a picture: what the policy earns for real, what the models promise, and how far they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from metrpo.chart_style import GREEN, GREY, IMAGINED, REAL, png_of, tidy
from metrpo.counting import counted
from metrpo.run.files import atomic_write
from metrpo.run.metrics import Row, column

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOTHING: Mapping[str, float] = MappingProxyType({})
_COLLECTED, _SHARE = GREY, GREEN


def draw_curve(rows: Sequence[Row], path: Path, title: str, yardsticks: Mapping[str, float] = NOTHING) -> None:
    """Draws returns against real steps, and below them how far the models are off: PNG, 1350 x 1050 pixels, atomic.

    `yardsticks` are returns by name, such as that of doing nothing: level lines. Columns that a row lacks are left out
    of the picture. Raises `RunDirectoryError` when it cannot be written.
    """
    from matplotlib.figure import (
        Figure,
    )  # slow to import; without pyplot there is no global state and no display needed

    figure = Figure(figsize=(9, 7), dpi=150, layout="constrained")
    steps = column(rows, "real_steps") / 1000
    if any(np.isfinite(column(rows, name)).any() for name in ("gap", "fraction_improved")):
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1])
        _draw_gap(below, steps, rows)
    else:  # a method without models
        above = below = figure.subplots()
    _draw_returns(above, steps, rows, yardsticks)
    figure.suptitle(title, fontsize=14, fontweight="bold", parse_math=False)  # a task's name is no formula
    best = column(rows, "return_real")
    if np.isfinite(best).any():
        above.set_title(
            f"last {best[-1]:.1f}, best {np.nanmax(best):.1f} after {counted(len(rows), 'iteration')}",
            fontsize=10,
            color="#555555",
        )
    for axes in {above, below}:
        tidy(axes)
    below.set_xlabel("real steps (thousands)")
    below.set_xlim(left=0)
    atomic_write(path, png_of(figure))


def _draw_returns(axes: Axes, steps: np.ndarray, rows: Sequence[Row], yardsticks: Mapping[str, float]) -> None:
    real, std, collected, imagined = (
        column(rows, name) for name in ("return_real", "return_real_std", "return_collected", "return_imagined")
    )
    played = bool(np.isfinite(real).any())  # not where another program does
    if played:
        axes.fill_between(
            steps, real - std, real + std, color=REAL, alpha=0.15, linewidth=0, label="± 1 std over episodes"
        )
    axes.plot(
        steps,
        collected,
        ".--",
        color=_COLLECTED,
        linewidth=1,
        label="collected (with exploration noise)",
    )
    if np.isfinite(imagined).any():
        axes.plot(steps, imagined, "s-", color=IMAGINED, linewidth=1.3, markersize=4, label="imagined (models)")
    if played:
        axes.plot(steps, real, "o-", color=REAL, linewidth=2.2, markersize=5, label="real (deterministic policy)")
    for (name, level), style in zip(yardsticks.items(), ("--", ":"), strict=False):
        axes.axhline(level, color="#333333", linewidth=1.1, linestyle=style, label=f"{name} ({level:.4g})")
    axes.set_ylabel("return of an episode")
    levels = np.array(list(yardsticks.values()))
    axes.set_ylim(_frame(np.concatenate([real - std, real + std, collected, levels]), imagined, played))
    # Opaque: a yardstick's line may run through the best place that there is.
    axes.legend(loc="best", fontsize=9, framealpha=0.9, edgecolor="none")


def _frame(real: np.ndarray, others: np.ndarray, flattens: bool = True) -> tuple[float, float] | None:
    """Limits of the return axis: early models may promise a hundredfold, which must not flatten the real curve.

    Where there is no such curve (`flattens` is false) nothing is left outside.
    """
    if not flattens:
        real = np.concatenate([real, others])
    if not np.isfinite(real).any():
        return None
    low, high = np.nanmin(real), np.nanmax(real)
    span = max(high - low, 0.1 * abs(high), 1e-9)
    everything = np.concatenate([real, others])
    low, high = max(np.nanmin(everything), low - span), min(np.nanmax(everything), high + span)
    return float(low - 0.06 * (high - low + 1e-9)), float(high + 0.06 * (high - low + 1e-9))


def _draw_gap(axes: Axes, steps: np.ndarray, rows: Sequence[Row]) -> None:
    gap, share = column(rows, "gap"), axes
    if np.isfinite(gap).any():
        axes.axhline(0, color="#333333", linewidth=0.8)
        axes.fill_between(steps, 0, gap, color=IMAGINED, alpha=0.2, linewidth=0)
        axes.plot(steps, gap, "s-", color=IMAGINED, linewidth=1.3, markersize=4, label="gap: imagined - real")
        axes.set_ylabel("gap")
        share = axes.twinx()
    share.plot(
        steps,
        100 * column(rows, "fraction_improved"),
        "^:",
        color=_SHARE,
        markersize=4,
        label="models in which the policy improved",
    )
    share.set_ylim(-5, 105)
    share.set_ylabel("models improved (%)", color=_SHARE)
    share.spines["top"].set_visible(False)
    handles = {name: line for a in (axes, share) for line, name in zip(*a.get_legend_handles_labels(), strict=True)}
    axes.legend(
        list(handles.values()),
        list(handles),
        ncols=2,
        frameon=False,
        fontsize=9,
        loc="lower left",
        bbox_to_anchor=(0, 1),
        borderaxespad=0.2,
    )
