"""Limits of actions that keep hardware safe: how large an action may be, and how far from the one before it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from metrpo.types import Array


class Limited(Protocol):
    """What says the limits: a run's settings, or what its policy's file says of it."""

    @property
    def max_action(self) -> float:
        """As in `Limits`."""

    @property
    def max_change(self) -> float | None:
        """As in `Limits`."""


@dataclass(frozen=True)
class Limits:
    """Both in the policy's own units, in which the environment's whole range of actions is [-1, 1]."""

    max_action: float = 1.0
    """Actions lie in [-max_action, max_action]."""
    max_change: float | None = None
    """Most that an action differs from the one before it; from 0, the middle of the range, in an episode's first step.
    None: any."""

    @classmethod
    def of(cls, limited: Limited) -> Limits:
        """Those of a run or a policy."""
        return cls(limited.max_action, limited.max_change)

    def within(self, actions: Array, before: Array | None = None) -> Array:
        """The actions [..., A] within the limits, given the executed ones `before` them, [..., A]; None: 0."""
        xp = actions.__array_namespace__()
        if self.max_change is not None:
            before = xp.zeros_like(actions) if before is None else before
            actions = xp.clip(actions, before - self.max_change, before + self.max_change)
        return xp.clip(actions, -self.max_action, self.max_action)


NONE = Limits()
"""No limits but the range itself."""
