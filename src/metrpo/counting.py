"""Numbers of things in words, and values as names have them."""

from __future__ import annotations

from typing import Any


def counted(n: int, what: str) -> str:
    """So many of something: "1 step", "2,000 steps"."""
    return f"{n:,} {what}{'' if n == 1 else 's'}"


def named_value(value: Any) -> str:
    """A setting's value in a name: "5", "1024x1024", "gain=2.0+mode=fast"."""
    if not isinstance(value, tuple):
        return str(value)
    return ("+" if any(isinstance(part, str) for part in value) else "x").join(map(str, value))
