"""Numbers of things in words."""

from __future__ import annotations


def counted(n: int, what: str) -> str:
    """So many of something: "1 step", "2,000 steps"."""
    return f"{n:,} {what}{'' if n == 1 else 's'}"
