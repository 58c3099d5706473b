"""`metrpo plot` draws learning curves."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from metrpo.commands.options import require_directories
from metrpo.commands.output import warn_of_skipped


@dataclass(frozen=True)
class Plot:
    """Draw learning curves: a line with a band over the seeds for each group of runs with the same settings.

    For example:
        metrpo plot runs/sweep
        metrpo plot runs/sweep --out sweep.pdf --x wall_seconds
        metrpo plot runs --y gap --x iteration
        metrpo plot runs --title "Five seeds" --y-limits 0 400 --x-scale log
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN_OR_FOLDER...")]
    """Run directories, or folders with runs inside."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("curves.png")
    """File to write, .png, .svg or .pdf; missing folders are created."""
    x: Literal["real_steps", "wall_seconds", "iteration"] = "real_steps"
    """Column on the x axis."""
    y: Annotated[str, arg(metavar="COLUMN")] = "return_real"
    """Column of metrics.csv or diagnostics.csv to draw, such as gap, outside, error_T, error_10_3 or improved_0."""

    title: Annotated[str | None, arg(metavar="TEXT")] = None
    """Title above the panels."""
    x_label: Annotated[str | None, arg(metavar="TEXT")] = None
    """Label of the x axis."""
    y_label: Annotated[str | None, arg(metavar="TEXT")] = None
    """Label of the y axis."""
    x_limits: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Ends of the x axis."""
    y_limits: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Ends of the y axis."""
    x_scale: Literal["auto", "linear", "log"] = "auto"
    """Scale of the x axis; auto: logarithmic if some runs are many times longer than others."""
    y_scale: Literal["auto", "linear", "log"] = "auto"
    """Scale of the y axis; auto: logarithmic for model errors. A logarithmic axis leaves out points at or below 0."""
    legend: Literal["below", "inside", "none"] = "below"
    """Where to put the legend."""

    def __post_init__(self) -> None:
        require_directories("plot", self.dirs)


def run(command: Plot) -> int:
    """Returns the exit code."""
    from metrpo.plots.learning_curves import Look, plot
    from metrpo.run.find import find

    found = find(command.dirs)
    warn_of_skipped([{"path": path, "why": why} for path, why in found.skipped])
    look = Look(**{f.name: getattr(command, f.name) for f in dataclasses.fields(Look)})
    print(plot(found.runs, command.out, command.x, command.y, look))
    return 0
