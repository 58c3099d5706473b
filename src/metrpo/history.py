"""States that hold the last observations and the actions between them, as one vector.

The newest observation [O] comes first, then the N-1 older ones, then the N-1 actions [A] taken between them, of each
the newest first. At an episode's start the older observations repeat the first one, and the actions are 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class History:
    """How states [S] are put together out of observations [O] and actions [A], both as NumPy arrays."""

    length: int
    """N, the observations that a state holds; 1: it is the observation."""
    observation_size: int
    """O"""
    action_size: int
    """A"""

    @classmethod
    def of_state(cls, length: int, state_size: int, action_size: int) -> History:
        """The history of so many observations in a state of that size. Raises `ValueError` where there is none."""
        observed, rest = divmod(state_size - (length - 1) * action_size, length)
        if rest or observed < 1:
            parts = f"{length} observations and {length - 1} actions of {action_size}"
            raise ValueError(f"expected a state of {parts}, got {state_size} numbers")
        return cls(length, observed, action_size)

    @property
    def state_size(self) -> int:
        """S"""
        return self.length * self.observation_size + (self.length - 1) * self.action_size

    @property
    def carried(self) -> tuple[int, ...]:
        """[S - O], where the rest of the next state, behind its observation, stands in state and action, [S + A]."""
        if self.length == 1:
            return ()
        older, actions = (self.length - 1) * self.observation_size, self.length * self.observation_size
        now = self.state_size
        return (*range(older), *range(now, now + self.action_size), *range(actions, now - self.action_size))

    @property
    def parts(self) -> tuple[tuple[int, str], ...]:
        """The parts of a state in order: how many numbers, and what they are."""
        observed = [(self.observation_size, f"the observation {_ago(k)}") for k in range(self.length)]
        actions = [(self.action_size, f"the action {_ago(k)}, in [-1, 1]") for k in range(1, self.length)]
        return (*observed, *actions)

    def copies(self, dimensions: Iterable[int]) -> tuple[int, ...]:
        """These dimensions of the observation, in each of a state's observations."""
        return tuple(k * self.observation_size + d for k in range(self.length) for d in dimensions)

    def begin(self, observation: np.ndarray) -> np.ndarray:
        """The state [..., S] of an episode's first observation [..., O]."""
        none = np.zeros((*observation.shape[:-1], (self.length - 1) * self.action_size), observation.dtype)
        return np.concatenate([observation] * self.length + [none], axis=-1)

    def follow(self, state: np.ndarray, action: np.ndarray, observation: np.ndarray) -> np.ndarray:
        """The state [..., S] in which an action [..., A], taken in `state`, has led to an observation [..., O]."""
        before = np.concatenate([state, action], axis=-1, dtype=observation.dtype)
        return np.concatenate([observation, before[..., list(self.carried)]], axis=-1)

    def along(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The states [L + 1, S] of an episode of observations [L + 1, O] and actions [L, A]."""
        steps = np.arange(len(observations))
        seen = [observations[np.maximum(steps - k, 0)] for k in range(self.length)]
        padded = [np.concatenate([np.zeros((k, self.action_size)), actions]) for k in range(1, self.length)]
        return np.concatenate([*seen, *(rows[: len(steps)] for rows in padded)], axis=-1, dtype=observations.dtype)

    def newest(self, states: np.ndarray) -> np.ndarray:
        """The observations [..., O] in which states [..., S] were reached."""
        return states[..., : self.observation_size]


def tied(first: np.ndarray, carried: tuple[int, ...]) -> np.ndarray:
    """A number for each dimension of an observation [O] given to their copies in a state too, and 0 to actions: [S]."""
    size = len(first) + len(carried)
    whole = np.zeros(size, first.dtype)
    whole[: len(first)] = first
    for dimension, source in enumerate(carried, len(first)):
        whole[dimension] = whole[source] if source < size else 0.0
    return whole


def runs(indices: tuple[int, ...]) -> Iterator[slice]:
    """The indices as slices of neighbours, which arrays are cut by faster than by numbers."""
    first = 0
    for i in range(1, len(indices) + 1):
        if i == len(indices) or indices[i] != indices[i - 1] + 1:
            yield slice(indices[first], indices[i - 1] + 1)
            first = i


def _ago(steps: int) -> str:
    return "now" if steps == 0 else f"{steps} step{'s' * (steps > 1)} before"
