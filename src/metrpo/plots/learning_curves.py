"""Learning curves as a picture: a panel for each task, a line with a band over the seeds for each group of runs."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from metrpo.chart_style import COLOURS, make_logarithmic, png_of, tidy
from metrpo.counting import counted
from metrpo.errors import ConfigError
from metrpo.plots.bands import RATIOS, curve, is_far
from metrpo.run.files import atomic_write
from metrpo.run.find import SeenRun, group

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

X = Literal["real_steps", "wall_seconds", "iteration"]
AxisScale = Literal["auto", "linear", "log"]
Legend = Literal["below", "inside", "none"]
FORMATS = ("png", "svg", "pdf")
_DOTS = 25
"""Most points of a line that are marked each."""
_LETTERS = 48
"""In a line of a legend: as many as a panel is wide."""

_NAMES = {
    "real_steps": "real steps",
    "wall_seconds": "wall-clock time (s)",
    "return_real": "real return",
    "return_imagined": "imagined return",
    "return_collected": "collected return",
    "gap": "gap: imagined minus real return",
    "fraction_improved": "share of the models in which the policy improved",
    "error_1": "model error after 1 step\n(1: as predicting no change)",
    "error_T": "model error after an imagined episode\n(1: as predicting no change)",
    "disagreement_real": "disagreement on real states (std)",
    "disagreement_imagined": "disagreement on imagined states (std)",
    "outside": "imagined states outside the data",
    "saturated": "mean actions beyond the limits",
}


@dataclass(frozen=True)
class Look:
    """How a picture of learning curves looks, where it is not to be as usual."""

    title: str | None = None
    """Above all panels."""
    x_label: str | None = None
    y_label: str | None = None
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    x_scale: AxisScale = "auto"
    """Logarithmic by itself where some runs are many times longer than others."""
    y_scale: AxisScale = "auto"
    """Logarithmic by itself for errors of models."""
    legend: Legend = "below"

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            limits, scale = getattr(self, f"{name}_limits"), getattr(self, f"{name}_scale")
            if limits is not None and not limits[0] < limits[1]:
                raise ConfigError(f"{name}_limits: expected the lower one first, got {limits[0]:g} {limits[1]:g}")
            if limits is not None and scale == "log" and limits[0] <= 0:
                raise ConfigError(f"{name}_limits: expected limits above 0 on a logarithmic axis, got {limits[0]:g}")


USUAL = Look()


def plot(runs: Sequence[SeenRun], path: Path, x: X = "real_steps", y: str = "return_real", look: Look = USUAL) -> Path:
    """Draws the column `y` against `x` to `path` (.png, .svg or .pdf), atomically, and returns it.

    `y` is one of metrics.csv or of diagnostics.csv. Raises `ConfigError` when the file has another ending or no run has
    both columns, `RunDirectoryError` when it cannot be written.
    """
    kind = path.suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise ConfigError(f"out: expected a file name that ends in .png, .svg or .pdf, got {path}")
    _require_column(runs, "y", y)
    _require_column(runs, "x", x)
    _require_positive(runs, "x_scale", look.x_scale, x)
    _require_positive(runs, "y_scale", look.y_scale, y)
    from matplotlib.figure import Figure  # slow to import
    from matplotlib.ticker import EngFormatter, MaxNLocator

    groups = [g for g in group(runs) if curve(g, x, y).seeds]
    log_y = look.y_scale == "log"
    if look.y_scale == "auto" and y.startswith(RATIOS):
        log_y = all((seed[1] > 0).all() for g in groups for seed in curve(g, x, y).seeds)
    if not groups:
        raise ConfigError(f"y: expected a column that some run has together with {x}, got {y}; choose another --x")
    tasks = list(dict.fromkeys(g.task for g in groups))
    columns = min(len(tasks), 3)
    lines = -(-len(tasks) // columns)
    figure = Figure(figsize=(max(3.8 * columns, 5.2), 3.1 * lines + 0.5), dpi=130, layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, task in zip(panels, tasks, strict=False):
        of_task = [g for g in groups if g.task == task]
        far = is_far(x, [seed[0][-1] for g in of_task for seed in curve(g, x, y).seeds])
        log = far if look.x_scale == "auto" else look.x_scale == "log"
        for i, g in enumerate(of_task):
            c = curve(g, x, y, log, log_y)
            style = {"color": COLOURS[i % len(COLOURS)], "linestyle": ("-", "--", ":")[i // len(COLOURS) % 3]}
            if len(c.seeds) > 1:
                for seed in c.seeds:
                    axes.plot(*seed, **style, linewidth=0.7, alpha=0.4, marker="." if len(seed[0]) == 1 else "")
                axes.fill_between(c.x, c.low, c.high, color=style["color"], alpha=0.15, linewidth=0)
            name = f"{g.label} ({counted(len(c.seeds), 'seed')})" if len(c.seeds) > 1 else g.label
            few = len(c.seeds) == 1 and len(c.x) <= _DOTS
            marker = "o" if few or (len(c.x) and c.x[0] == c.x[-1]) else ""  # a point has no line
            label = textwrap.fill(name, _LETTERS, break_on_hyphens=False)
            axes.plot(c.x, c.mean, **style, linewidth=2, marker=marker, markersize=3.5, label=label)
        axes.set_title(task, fontsize=11, parse_math=False)
        axes.set_xlabel(look.x_label or _NAMES.get(x, x), parse_math=False)
        axes.set_ylabel(look.y_label or _NAMES.get(y, y), parse_math=False)
        tidy(axes)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if x == "iteration":
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if look.x_limits is not None:
            axes.set_xlim(*look.x_limits)
        if look.y_limits is not None:
            axes.set_ylim(*look.y_limits)
        if log_y:
            make_logarithmic(axes.yaxis)
        if log:
            make_logarithmic(axes.xaxis, EngFormatter(sep=""))
        _add_legend(axes, look.legend, figure.bbox.width / columns)
    if look.title is not None:
        figure.suptitle(look.title, fontsize=13, parse_math=False)
    for axes in panels[len(tasks) :]:
        axes.set_axis_off()
    atomic_write(path, png_of(figure) if kind == "png" else _vectors(figure, kind))
    return path


def _vectors(figure: Figure, kind: str) -> bytes:
    """As an SVG or PDF; the same figure gives the same bytes: no date, and no random names inside of an SVG."""
    import matplotlib

    content = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "metrpo"}):
        figure.savefig(content, format=kind, metadata={"svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind])
    return content.getvalue()


def _add_legend(axes: Axes, where: Legend, room: float) -> None:
    """`room` is the width in pixels that a panel has: a legend below it has as many columns as fit."""
    if where == "none":
        return
    below = [{"loc": "upper center", "bbox_to_anchor": (0.5, -0.14), "ncols": columns} for columns in (3, 2, 1)]
    places: list[dict[str, Any]] = below if where == "below" else [{"loc": "best"}]
    for place in places:
        legend = axes.legend(frameon=False, fontsize=8, handlelength=3, **place)
        for text in legend.get_texts():
            text.set_parse_math(False)
        if legend.get_window_extent().width <= room:
            return


def _require_positive(runs: Sequence[SeenRun], option: str, scale: AxisScale, name: str) -> None:
    if scale == "log" and not any((run.column(name) > 0).any() for run in runs):
        raise ConfigError(f"{option}: expected some {name} above 0 on a logarithmic axis, got none")


def _require_column(runs: Sequence[SeenRun], option: str, name: str) -> None:
    columns = dict.fromkeys(n for run in runs for n in (run.rows[0] if run.rows else ()))
    if not any(np.isfinite(run.column(name)).any() for run in runs):
        have = [n for n in columns if any(np.isfinite(run.column(n)).any() for run in runs)]
        more = ", or one of diagnostics.csv" if any(run.details for run in runs) else ""
        said = "one without a number in any run" if name in columns else repr(name)
        raise ConfigError(
            f"{option}: expected a column with numbers ({', '.join(have) or 'there is none'}{more}), got {said}"
        )
