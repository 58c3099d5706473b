"""The figures as pictures: mean over seeds with a band, in the paper's names; drawn from whatever has been run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from metrpo.chart_style import COLOURS, GREY, IMAGINED, REAL, make_logarithmic, png_of, tidy
from metrpo.launch.run_spec import RunSpec
from metrpo.paper.figures import FIGURES, PAPER_REAL_STEPS, PAPER_SECONDS, Figure
from metrpo.paper.summary import Curves, curves_of, mean_curve
from metrpo.run.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

_COLUMNS = 3
"""Panels side by side, so that a page's width still shows them."""


def draw(name: str, runs: Sequence[RunSpec], out: Path, path: Path) -> bool:
    """Draws a figure from the runs that have begun, PNG, atomic; False, and no file, when none has.

    Raises `RunDirectoryError` when it cannot be written.
    """
    from matplotlib.figure import Figure as Picture  # slow to import

    curves = curves_of(name, runs, out)
    if not curves:
        return False
    picture = Picture(dpi=130, layout="constrained")
    _KINDS[FIGURES[name].kind](picture, FIGURES[name], curves)
    picture.suptitle(FIGURES[name].title, fontsize=13, fontweight="bold")
    atomic_write(path, png_of(picture))
    return True


def _draw_curves(picture: Picture, figure: Figure, curves: list[Curves]) -> None:
    from matplotlib.ticker import EngFormatter

    tasks = list(dict.fromkeys(c.task for c in curves))
    columns = min(len(tasks), _COLUMNS)
    picture.set_size_inches(max(3.8 * columns, 5.2), 0.5 + 3.2 * -(-len(tasks) // _COLUMNS))
    labels = list(figure.systems)
    for axes, task in zip(_panels(picture, len(tasks)), tasks, strict=True):
        for c in (c for c in curves if c.task == task):
            _draw_band(axes, c, COLOURS[labels.index(c.label)], figure.log_steps)
        axes.set_title(task, fontsize=11)
        axes.set_xlabel("real steps" if figure.log_steps else "real steps (thousands)")
        axes.set_ylabel("return")
        if figure.log_steps:
            make_logarithmic(axes.xaxis, EngFormatter(sep=""))
    handles: dict[str, Any] = {}
    for axes in picture.axes:
        lines, names = axes.get_legend_handles_labels()
        handles |= dict(zip(names, lines, strict=True))
    shown = [label for label in labels if label in handles]
    picture.legend([handles[s] for s in shown], shown, loc="outside lower center", ncols=6, frameon=False, fontsize=9)


def _draw_band(
    axes: Axes, curves: Curves, colour: str, log: bool = False, column: str = "return_real", label: str = ""
) -> None:
    unit = 1 if log else 1000
    for steps, returns in curves.column(column):
        axes.plot(steps / unit, returns, color=colour, linewidth=0.7, alpha=0.35)
    steps, mean, low, high = mean_curve(curves, column, log)
    axes.fill_between(steps / unit, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(steps / unit, mean, color=colour, linewidth=2, label=label or curves.label)


def _draw_overfitting(picture: Picture, figure: Figure, curves: list[Curves]) -> None:
    """Imagined and real return after every policy phase: a row for each task, a column for each system."""
    tasks, labels = list(dict.fromkeys(c.task for c in curves)), list(figure.systems)
    picture.set_size_inches(4.6 * len(labels), 0.5 + 2.6 * len(tasks))
    grid = picture.subplots(len(tasks), len(labels), squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for c in curves:
        axes = grid[tasks.index(c.task)][labels.index(c.label)]
        axes.set_axis_on()
        tidy(axes)
        _draw_band(axes, c, IMAGINED, column="return_imagined", label="imagined")
        _draw_band(axes, c, REAL, label="real")
        _leave_out_first_promises(axes, c)
        axes.set_title(f"{c.task}, {c.label}", fontsize=10)
        axes.set_ylabel("return")
        axes.set_xlabel("real steps (thousands)")
    handles, names = axes.get_legend_handles_labels()
    picture.legend(handles, names, loc="outside lower center", ncols=2, frameon=False, fontsize=9)


def _leave_out_first_promises(axes: Axes, curves: Curves) -> None:
    """Limits for all real returns and the imagined ones from the second phase on, and what lies outside in words.

    What the first models promise would else flatten all that follows.
    """
    real = [returns for _, returns in curves.column("return_real")]
    imagined = [returns for _, returns in curves.column("return_imagined")]
    first = np.array([returns[0] for returns in imagined])
    shown = np.concatenate(real + [returns[1:] for returns in imagined])
    low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
    margin = 0.05 * (high - low)
    outside = first[(first < low - margin) | (first > high + margin)]
    if outside.size and margin:
        axes.set_ylim(low - margin, high + margin)
        values = ", ".join(f"{value:,.0f}" for value in np.sort(outside))
        note = f"outside, after the first phase: {values}"
        axes.text(0.98, 0.04, note, transform=axes.transAxes, ha="right", fontsize=7.5, color=IMAGINED)


def _draw_wall_clock(picture: Picture, figure: Figure, curves: list[Curves]) -> None:
    """Seconds per 1,000 real steps, ours and the paper's: the runs differ in length."""
    picture.set_size_inches(8, 4.2)
    axes = _panels(picture, 1)[0]
    for i, c in enumerate(curves):
        ours = [seconds[-1] / steps[-1] * 1000 for steps, seconds in c.column("wall_seconds")]
        theirs = PAPER_SECONDS[c.task] / PAPER_REAL_STEPS[c.task] * 1000
        for values, colour, label in (
            (ours, REAL, "these runs"),
            ([theirs], GREY, "paper (1 K80, 4 virtual CPUs)"),
        ):
            axes.plot([i] * len(values), values, "o", color=colour, label=None if i else label)
            note = f"{float(np.mean(values)):.3g}"
            axes.annotate(note, (i, values[0]), xytext=(8, -3), textcoords="offset points", fontsize=9)
    axes.set_xticks(range(len(curves)), [c.task for c in curves])
    make_logarithmic(axes.yaxis)
    axes.set_ylabel("seconds per 1,000 real steps")
    axes.legend(frameon=False, fontsize=9)


_KINDS: dict[str, Callable[[Picture, Figure, list[Curves]], None]] = {
    "curves": _draw_curves,
    "overfitting": _draw_overfitting,
    "wall-clock": _draw_wall_clock,
}


def _panels(picture: Picture, count: int) -> list[Axes]:
    columns = min(count, _COLUMNS)
    panels = list(picture.subplots(-(-count // columns), columns, squeeze=False).flat)
    for axes in panels:
        tidy(axes)
    for axes in panels[count:]:
        axes.set_axis_off()
    return panels[:count]
