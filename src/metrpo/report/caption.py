"""What surrounds a chart: its title, what it shows in a line, and the names of its colours."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape


def figure(title: str, note: str, drawn: str, legend: Sequence[tuple[str, str]] = (), below: str = "") -> str:
    """A chart with its title, what it is (`note`) above it, names of colours (style, name) and how to read it below."""
    said = f" <small>{escape(note)}</small>" if note else ""
    read = f'<p class="small">{escape(below)}</p>' if below else ""
    return f"<figure><figcaption><b>{escape(title)}</b>{said}</figcaption>{drawn}{swatches(legend)}{read}</figure>"


def swatches(given: Sequence[tuple[str, str]]) -> str:
    """The legend of some (style, name); nothing for none."""
    if not given:
        return ""
    items = "".join(f'<li><i class="swatch {style}"></i>{escape(name)}</li>' for style, name in given)
    return f'<ul class="legend">{items}</ul>'
