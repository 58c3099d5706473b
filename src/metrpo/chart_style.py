"""The one look of all charts: colours and axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE, GREEN, RED, VIOLET, BROWN = COLOURS = ("#1f5fa8", "#d9772b", "#3f8f5f", "#b0413e", "#7a5aa6", "#8a6d3b")
"""Of groups of runs, in this order."""
GREY = "#8a8f98"
REAL, IMAGINED = BLUE, ORANGE
"""Of returns."""


def tidy(axes: Axes) -> None:
    """A light grid behind the lines, and no frame at the top and on the right."""
    axes.grid(True, color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
