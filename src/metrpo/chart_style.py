"""The one look of all charts: colours, axes and files."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import XAxis, YAxis
    from matplotlib.figure import Figure
    from matplotlib.ticker import Formatter

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


def make_logarithmic(axis: XAxis | YAxis, formatter: str | Formatter = "{x:g}") -> None:
    """A logarithmic axis with numbers in one notation, as many as its length in decades has room for.

    Call it when the lines are drawn and the limits set.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 2 else (1, 3) if decades < 4 else (1,)))
    axis.set_major_formatter(formatter)
    axis.set_minor_locator(LogLocator(subs="all"))
    axis.set_minor_formatter(NullFormatter())


def png_of(figure: Figure) -> bytes:
    """The figure as a PNG of at most 256 colours: the same to the eye, in a third of the bytes.

    The same figure gives the same bytes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image  # comes with matplotlib

    canvas, content = FigureCanvasAgg(figure), io.BytesIO()
    canvas.draw()
    drawn = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba()).convert("RGB")
    few = drawn.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(content, "PNG", optimize=True, dpi=(figure.dpi, figure.dpi))
    return content.getvalue()
