"""A search as a picture: return against trial, and against each setting that was searched."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from metrpo.chart_style import BLUE, GREEN, ORANGE, RED, make_logarithmic, png_of, tidy
from metrpo.counting import counted
from metrpo.run.files import atomic_write
from metrpo.tune.results import Record, Tuned
from metrpo.tune.space import Choices, Span

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COMPLETE, _PRUNED, _FAILED, _BEST = BLUE, ORANGE, RED, GREEN
_COLUMNS = 3


def draw(tuned: Tuned, path: Path) -> bool:
    """Draws the trials to `path`, PNG, atomic; False, and no file, when none is worth anything yet.

    Raises `RunDirectoryError` when it cannot be written.
    """
    from matplotlib.figure import Figure  # slow to import

    worth = [r for r in tuned.records if r.value is not None and np.isfinite(r.value)]
    if not worth:
        return False
    names = list(tuned.search.space)
    columns = 2 if len(names) == 3 else min(1 + len(names), _COLUMNS)
    rows = -(-(1 + len(names)) // columns)
    figure = Figure(figsize=(max(4.4 * columns, 6.5), 3.6 * rows + 0.7), dpi=130, layout="constrained")
    first, *panels = figure.subplots(rows, columns, squeeze=False).flat
    _draw_trials(first, worth, tuned)
    for axes, name in zip(panels, names, strict=False):
        _draw_setting(axes, worth, tuned, name)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    for axes in (first, *panels[: len(names)]):
        axes.set_ylabel("return")
        tidy(axes)
    figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    title = f"{tuned.search.task}: {counted(len(tuned.records), 'trial')} of {counted(len(tuned.search.seeds), 'seed')}"
    figure.suptitle(title, fontsize=12, fontweight="bold", parse_math=False)
    atomic_write(path, png_of(figure))
    return True


def _draw_trials(axes: Axes, worth: Sequence[Record], tuned: Tuned) -> None:
    from matplotlib.ticker import MaxNLocator

    _points(axes, worth, [r.number for r in worth], tuned.best, labels=True)
    complete = [r for r in worth if r.state == "complete"]
    if complete:
        best = np.maximum.accumulate([r.value or 0.0 for r in complete])
        axes.step([r.number for r in complete], best, where="post", color=_COMPLETE, linewidth=1, label="best so far")
    for i, r in enumerate(tuned.failed):
        axes.axvline(r.number, color=_FAILED, linewidth=1, linestyle=":", label=None if i else "failed")
    axes.set_xlabel("trial")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_setting(axes: Axes, worth: Sequence[Record], tuned: Tuned, name: str) -> None:
    span = tuned.search.space[name]
    _points(axes, worth, [_place(span, r.settings[name], r.number) for r in worth], tuned.best)
    axes.set_xlabel(name)
    if isinstance(span, Choices):
        axes.set_xticks(range(len(span.values)), [str(span.label(value)) for value in span.values], parse_math=False)
        axes.set_xlim(-0.5, len(span.values) - 0.5)
    elif span.log:
        axes.set_xlim(span.low / 1.2, span.high * 1.2)
        make_logarithmic(axes.xaxis)


def _place(span: Span, value: Any, number: int) -> float:
    """On the horizontal axis; trials with the same choice stand side by side."""
    return span.values.index(value) + 0.04 * (number % 7 - 3) if isinstance(span, Choices) else float(value)


def _points(axes: Axes, worth: Sequence[Record], x: Sequence[float], best: Record | None, labels: bool = False) -> None:
    """Complete trials with their seeds above and below, pruned ones with what they were worth then."""
    shown = set[str]()

    def label(text: str) -> str | None:
        if not labels or text in shown:
            return None
        shown.add(text)
        return text

    for r, at in zip(worth, x, strict=True):
        if r.state != "complete":
            axes.plot(at, r.value or 0.0, "x", color=_PRUNED, markersize=6, label=label("pruned, return then"))
            continue
        axes.plot([at] * len(r.returns), r.returns, "-", color=_COMPLETE, linewidth=1, alpha=0.4)
        colour, name = (_BEST, "best") if r is best else (_COMPLETE, "complete, and its seeds")
        axes.plot(
            at,
            r.value or 0.0,
            "*" if r is best else "o",
            color=colour,
            markersize=11 if r is best else 5,
            label=label(name),
        )
        if r.usual:
            axes.plot(
                at, r.value or 0.0, "o", color="none", markeredgecolor="#444444", markersize=11, label=label("preset")
            )
