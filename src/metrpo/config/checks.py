"""Checks of the settings when a config is created."""

from __future__ import annotations

import math

from metrpo.errors import ConfigError


def require(condition: bool, name: str, value: object, expected: str) -> None:
    """Raises `ConfigError` unless the condition holds."""
    if not condition:
        raise ConfigError(f"{name}: expected {expected}, got {value!r}")


def positive(value: float) -> bool:
    """Whether a number is finite and above 0."""
    return math.isfinite(value) and value > 0


def nonnegative(value: float) -> bool:
    """Whether a number is finite and at least 0."""
    return math.isfinite(value) and value >= 0
