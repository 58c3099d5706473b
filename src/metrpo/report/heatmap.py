"""A heat map as inline SVG, drawn by hand as the charts are: cells with their numbers, coloured by the style sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

import numpy as np

WIDTH = 380
_LEFT, _TOP, _BOTTOM = 62, 34, 6
_ROW = 16
_NUMBER = 27
"""Least width of a cell that shows its number."""
_LABEL = 24
"""Least room for the name of a column."""


def heat(
    summary: str,
    rows: Sequence[str],
    columns: Sequence[str],
    values: np.ndarray,
    heading: str,
    shade: Callable[[float], tuple[str, float]],
    text: Callable[[float], str],
) -> str:
    """`values` [rows, columns] as coloured cells (`shade`: CSS class and opacity), with their numbers (`text`) where
    there is room. `heading` names the columns; `summary` says it all in words, for readers who cannot see it.

    Cells that are not finite stay empty.
    """
    wide = (WIDTH - _LEFT) / max(len(columns), 1)
    numbers, every = wide >= _NUMBER, int(np.ceil(_LABEL / wide))
    parts = [f'<text class="mid" x="{(WIDTH + _LEFT) / 2:.0f}" y="11">{escape(heading)}</text>']
    for c, name in enumerate(columns):
        if c % every == 0:
            parts.append(f'<text class="mid" x="{_LEFT + (c + 0.5) * wide:.1f}" y="{_TOP - 6}">{escape(name)}</text>')
    for r, name in enumerate(rows):
        y = _TOP + r * _ROW
        parts.append(f'<text class="end" x="{_LEFT - 6}" y="{y + 12}">{escape(name)}</text>')
        for c, value in enumerate(values[r]):
            x = _LEFT + c * wide
            if not np.isfinite(value):
                parts.append(f'<text class="mid" x="{x + wide / 2:.1f}" y="{y + 12}">-</text>' * numbers)
                continue
            style, strength = shade(float(value))
            parts.append(
                f'<rect class="{style} fill" fill-opacity="{min(max(strength, 0.0), 1.0):.2g}" x="{x:.1f}" y="{y}" '
                f'width="{wide - 1:.1f}" height="{_ROW - 1}"/>'
            )
            if numbers:
                parts.append(f'<text class="mid in" x="{x + wide / 2:.1f}" y="{y + 12}">{text(float(value))}</text>')
    height = _TOP + len(rows) * _ROW + _BOTTOM
    label = escape(summary, quote=True)
    return f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
