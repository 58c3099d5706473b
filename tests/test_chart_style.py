"""Pictures of charts: what is drawn is what is stored, in few bytes."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from PIL import Image

from metrpo.chart_style import COLOURS, make_logarithmic, png_of, tidy


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


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (400, 2000, ["500", "1k", "2k"]),
        (1000, 300_000, ["1k", "3k", "10k", "30k", "100k", "300k"]),
        (1000, 1e8, ["1k", "10k", "100k", "1M", "10M", "100M"]),
    ],
)
def test_a_logarithmic_axis_has_numbers_in_one_notation_and_not_too_many(low, high, labels):
    figure = Figure()
    axes = figure.subplots()
    axes.plot([low, high], [1, 2])
    axes.set_xlim(low * 0.95, high * 1.05)
    make_logarithmic(axes.xaxis, EngFormatter(sep=""))
    figure.draw_without_rendering()
    shown = [t for t in axes.get_xticklabels() if low <= t.get_position()[0] <= high and t.get_text()]
    assert [t.get_text() for t in shown] == labels
    assert not any(t.get_text() for t in axes.get_xticklabels(minor=True))
