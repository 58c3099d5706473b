"""Pictures of charts: what is drawn is what is stored, in few bytes."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from metrpo.chart_style import COLOURS, png_of, tidy


def chart():
    """Every colour of the charts, lines, bands and text."""
    figure = Figure(figsize=(5, 4), dpi=120, layout="constrained")
    axes, x = figure.subplots(), np.linspace(0, 6, 200)
    for number, colour in enumerate(COLOURS):
        axes.plot(x, np.sin(x + number), color=colour, label=f"line {number}")
        axes.fill_between(x, np.sin(x + number) - 0.1, np.sin(x + number) + 0.1, color=colour, alpha=0.2)
    axes.legend()
    tidy(axes)
    return figure


def pixels(content):
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def test_a_picture_is_the_figure_in_a_third_of_the_bytes():
    plain = io.BytesIO()
    chart().savefig(plain, format="png")
    ours = png_of(chart())
    assert ours == png_of(chart()), "the same figure, the same bytes"
    assert len(ours) < len(plain.getvalue()) / 2.5
    drawn, stored = pixels(plain.getvalue()), pixels(ours)
    assert drawn.shape == stored.shape == (480, 600, 3)
    assert np.abs(drawn - stored).max() < 20
    assert round(Image.open(io.BytesIO(ours)).info["dpi"][0]) == 120
