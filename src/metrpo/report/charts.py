"""Charts as inline SVG, drawn by hand: small, without a script, and coloured by the page's style sheet.

A chart is as wide as its place and keeps its shape. Colours are CSS classes (c0 to c5, band, real, imagined), so that
light and dark need one picture only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np

COLOURS = 6
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 10, 34
_APART = 80
"""Least distance between two values written beside arrows."""
_FAR = 1e-6, 1e9
"""Ends of a logarithmic y axis; points beyond are arrows."""


@dataclass(frozen=True)
class Line:
    """One line of a chart; points that are not finite are gaps."""

    x: np.ndarray
    y: np.ndarray
    name: str
    style: str
    """CSS classes, such as "c0 thin"."""
    dots: bool = True
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    """A band around it, [points] each."""


@dataclass(frozen=True)
class Axes:
    """The axes of a line chart."""

    frame: tuple[float, float] | None = None
    """Limits of y; points beyond them are arrows at the edge."""
    say_beyond: bool = True
    """Write the values of such points beside them."""
    zero: bool = False
    """Include y = 0, and draw its line."""
    mark: float | None = None
    """Draw the line y = mark."""
    log: bool = False
    """Logarithmic x, above zero."""
    log_y: bool = False
    """Logarithmic y, without a frame; points not above zero are gaps."""


def chart(
    title: str,
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    size: tuple[int, int] = (380, 230),
    axes: Axes = Axes(),
) -> str:
    """A line chart."""
    if axes.log_y:
        lines = [replace(line, y=np.where(line.y > 0, line.y, np.nan)) for line in lines]
    x_limits = _span([line.x for line in lines], floor=None if axes.log else 0.0)
    place = _Place(size, x_limits, _y_limits(lines, axes), axes.log, axes.log_y)
    parts = [_axes(place, x_label, y_label, 0.0 if axes.zero else axes.mark)]
    parts += [_band(line, place) for line in lines]
    parts += [_line(line, place, axes.say_beyond) for line in lines]
    width, height = size
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title, quote=True)}">'
        f"{''.join(parts)}</svg>"
    )


def _y_limits(lines: Sequence[Line], axes: Axes) -> tuple[float, float]:
    ys = [v for line in lines for v in (line.y, line.low, line.high) if v is not None]
    ys += [] if axes.mark is None else [np.array([axes.mark])]
    low, high = _span(ys if axes.frame is None else [np.array(axes.frame)])
    if axes.log_y:
        return np.clip(low, *_FAR) / 1.2, np.clip(high, *_FAR) * 1.2
    if axes.zero and axes.frame is None:
        low, high = min(low, 0.0), max(high, 0.0)
    pad = 0.05 * (high - low)
    return low - pad * (low != 0), high + pad


def bars(title: str, names: Sequence[str], columns: np.ndarray, x: Sequence[int], x_label: str, y_label: str) -> str:
    """Stacked bars: `columns` [names, bars] of numbers >= 0, at the whole numbers `x`."""
    size = (380, 230)
    stack = np.cumsum(np.nan_to_num(columns), axis=0)
    top = float(stack[-1].max()) if stack.size else 1.0
    place = _Place(size, (min(x) - 0.5, max(x) + 0.5), (0.0, 1.05 * top or 1.0))
    width = 0.8 * (place.x(1.0) - place.x(0.0))
    parts = [_axes(place, x_label, y_label, None)]
    for i, name in enumerate(names):
        below = stack[i - 1] if i else np.zeros(len(x))
        for at, low, high in zip(x, below, stack[i], strict=True):
            if high > low:
                parts.append(
                    f'<rect class="c{i % COLOURS} fill" x="{place.x(at) - width / 2:.1f}" y="{place.y(high):.1f}" '
                    f'width="{width:.1f}" height="{place.y(low) - place.y(high):.1f}">'
                    f"<title>{escape(name)}, {at}: {number(high - low)}</title></rect>"
                )
    return (
        f'<svg viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{escape(title, quote=True)}">'
        f"{''.join(parts)}</svg>"
    )


def real_frame(real: np.ndarray, others: np.ndarray) -> tuple[float, float] | None:
    """Limits for real returns beside imagined ones: early models may promise a hundred times the return, which must not
    flatten the real curve."""
    real, others = real[np.isfinite(real)], others[np.isfinite(others)]
    if not len(real) or not len(others):
        return None
    low, high = float(real.min()), float(real.max())
    span = max(high - low, 0.1 * abs(high), 1e-9)
    # But show a promise that lasts.
    lasting = min(float(np.quantile(others, 0.75, method="lower")), high + 6 * span)
    most = max(high + 1.5 * span, lasting)
    return max(min(low, float(others.min())), low - span), min(max(high, float(others.max())), most)


def number(value: float) -> str:
    """A number for a label: three digits, or as many as it has before the point; millions as M."""
    if not math.isfinite(value):
        return "-"
    for unit, name in ((1e9, "G"), (1e6, "M")):
        if abs(value) >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{value:,.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.3g}"


class _Place:
    """Where a value lies in the picture."""

    def __init__(
        self,
        size: tuple[int, int],
        x: tuple[float, float],
        y: tuple[float, float],
        log: bool = False,
        log_y: bool = False,
    ) -> None:
        self.size, self.xs, self.ys, self.log, self.log_y = size, x, y, log, log_y
        self.left, self.right, self.top, self.bottom = _LEFT, size[0] - _RIGHT, _TOP, size[1] - _BOTTOM

    def x(self, value: float) -> float:
        return self.left + _part(value, self.xs, self.log) * (self.right - self.left)

    def y(self, value: float) -> float:
        return self.bottom - _part(value, self.ys, self.log_y) * (self.bottom - self.top)

    def point(self, x: float, y: float) -> str:
        return f"{self.x(x):.1f},{min(max(self.y(y), self.top), self.bottom):.1f}"


def _part(value: float, limits: tuple[float, float], log: bool) -> float:
    at, low, high = (math.log(v) if log else v for v in (value, *limits))
    return (at - low) / (high - low)


def _axes(place: _Place, x_label: str, y_label: str, mark: float | None) -> str:
    parts = []
    for value, text in _decades(*place.ys) if place.log_y else _ticks(*place.ys, 5):
        y = f"{place.y(value):.1f}"
        style = "zero" if value == mark else "grid"
        parts.append(f'<line class="{style}" x1="{place.left}" x2="{place.right}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text class="end" x="{place.left - 5}" y="{place.y(value) + 3.5:.1f}">{text}</text>')
    for value, text in _decades(*place.xs) if place.log else _ticks(*place.xs, 5):
        x = f"{place.x(value):.1f}"
        parts.append(f'<text class="mid" x="{x}" y="{place.bottom + 14}">{text}</text>')
    middle = (place.left + place.right) / 2
    parts.append(f'<line class="axis" x1="{place.left}" x2="{place.right}" y1="{place.bottom}" y2="{place.bottom}"/>')
    parts.append(f'<text class="mid label" x="{middle:.0f}" y="{place.bottom + 29}">{escape(x_label)}</text>')
    parts.append(f'<text class="label" x="{place.left + 2}" y="{place.top + 2}">{escape(y_label)}</text>')
    return "".join(parts)


def _band(line: Line, place: _Place) -> str:
    if line.low is None or line.high is None:
        return ""
    there = np.isfinite(line.low) & np.isfinite(line.high) & np.isfinite(line.x)
    if there.sum() < 2:
        return ""
    x, low, high = line.x[there], line.low[there], line.high[there]
    points = [place.point(a, b) for a, b in zip(x, high, strict=True)]
    points += [place.point(a, b) for a, b in zip(x[::-1], low[::-1], strict=True)]
    return f'<polygon class="{line.style} band" points="{" ".join(points)}"/>'


def _line(line: Line, place: _Place, say_beyond: bool) -> str:
    parts, piece, last_said = [], list[str](), -math.inf
    for x, y in zip(line.x, line.y, strict=True):
        if np.isfinite(x) and np.isfinite(y):
            piece.append(place.point(x, y))
            # The values of neighbours beyond the frame would overlap.
            beyond = not place.ys[0] <= y <= place.ys[1]
            say = bool(say_beyond and beyond and place.x(x) - last_said > _APART)
            last_said = place.x(x) if say else last_said
            parts.append(_dot(line, place, x, y, say))
        elif piece:
            parts.append(_path(line, piece))
            piece = []
    return "".join([*parts, _path(line, piece)] if piece else parts)


def _path(line: Line, points: list[str]) -> str:
    return f'<polyline class="{line.style}" points="{" ".join(points)}"/>'


def _dot(line: Line, place: _Place, x: float, y: float, say_beyond: bool) -> str:
    value = f"<title>{escape(line.name)}: {number(y)} at {number(x)}</title>"
    at = place.x(x)
    if place.ys[0] <= y <= place.ys[1]:
        return f'<circle class="{line.style}" cx="{at:.1f}" cy="{place.y(y):.1f}" r="2.6">{value}</circle>' * line.dots
    up = y > place.ys[1]
    edge, tip = (place.top, -6) if up else (place.bottom, 6)
    side = "end" if at > (place.left + place.right) / 2 else ""
    text = f'<text class="{side}" x="{at + (-7 if side else 7):.1f}" y="{edge + (13 if up else -6)}">{number(y)}</text>'
    return (
        f'<polygon class="{line.style} fill" points="{at - 4:.1f},{edge} {at + 4:.1f},{edge} {at:.1f},{edge + tip}">'
        f"{value}</polygon>{text * say_beyond}"
    )


def _span(values: Sequence[np.ndarray], floor: float | None = None) -> tuple[float, float]:
    """Least (or `floor`, if given) and largest finite value, with at least a small distance."""
    finite = np.concatenate([*(v[np.isfinite(v)] for v in values), []])
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()) if floor is None else floor, float(finite.max())
    if high - low < 1e-9 * max(abs(high), abs(low), 1e-3):
        apart = 0.1 * abs(high) or 1.0
        return (low, low + apart) if floor is not None else (low - apart, high + apart)
    return low, high


def _ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """About `count` round numbers within the limits, each with its text, in one unit."""
    rough = (high - low) / count
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= 0.99 * rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return _in_one_unit([float(f"{n * step:.12g}") for n in range(first, last + 1)])


def _decades(low: float, high: float) -> list[tuple[float, str]]:
    """Round numbers on a logarithmic axis, 1 included where it lies within."""
    parts = (1, 2, 5) if high / low < 100 else (1,)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    every = math.ceil((last - first) / 8)
    powers = [n for n in range(first, last + 1) if n % every == 0]
    values = [v for n in powers for m in parts if low <= (v := m * 10.0**n) <= high]
    return [_in_one_unit([v])[0] for v in values] if len(values) > 1 else _ticks(low, high, 4)


def _in_one_unit(values: list[float]) -> list[tuple[float, str]]:
    largest = max(map(abs, values), default=0.0)
    size, name = next((u for u in ((1e9, "G"), (1e6, "M"), (1e3, "k")) if largest >= u[0]), (1.0, ""))
    return [(v, f"{v / size:.6g}{name if v else ''}") for v in values]
