"""The frame of a chart: its title, a note and the names of its colours."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape


def figure(title: str, note: str, drawn: str, legend: Sequence[tuple[str, str]] = (), below: str = "") -> str:
    """A chart with its title and `note` above it, and its legend (style, name) and reading aid (`below`) below it."""
    small = f" <small>{escape(note)}</small>" if note else ""
    aid = f'<p class="small">{escape(below)}</p>' if below else ""
    return f"<figure><figcaption><b>{escape(title)}</b>{small}</figcaption>{drawn}{swatches(legend)}{aid}</figure>"


def swatches(colours: Sequence[tuple[str, str]]) -> str:
    """The legend of colours (style, name); empty for none."""
    if not colours:
        return ""
    items = "".join(f'<li><i class="swatch {style}"></i>{escape(name)}</li>' for style, name in colours)
    return f'<ul class="legend">{items}</ul>'
