"""The records that pass between the real side (`world`) and the learned side (`model`, `policy`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Array = Any
"""A NumPy or a JAX array."""


class Episode(NamedTuple):
    """One real episode of L steps."""

    states: np.ndarray
    """[L + 1, S], float64 (float32 in old files): as the environment gave them; the last one is after the last step."""
    actions: np.ndarray
    """[L, A], float32, as executed: within [-1, 1]."""
    rewards: np.ndarray
    """[L], float32."""
    terminated: bool
    """The task ended it, not the clock."""


class Transitions(NamedTuple):
    """n real transitions; on the device the arrays have a fixed capacity C >= n, so that growth never recompiles."""

    states: Array
    """[C, S], counted from the dataset's origin."""
    actions: Array
    """[C, A]"""
    deltas: Array
    """[C, D], what the models predict: the change of state [S]; then, where they are learned, the reward, and 1 where
    the task ended the episode, else 0."""
    size: Array
    """n, an integer (scalar array on the device)."""


class Normaliser(NamedTuple):
    """Shift and scale of the networks' inputs and outputs, from training data only."""

    state_mean: Array
    """[S]"""
    state_scale: Array
    """[S], 1 / std; 0 where the task keeps a dimension from the network (a global position)."""
    action_mean: Array
    """[A]"""
    action_scale: Array
    """[A], 1 / std."""
    delta_mean: Array
    """[D], of what the models predict."""
    delta_std: Array
    """[D]"""


class Trajectories(NamedTuple):
    """N imagined episodes of T steps."""

    states: Array
    """[T, N, S], the states acted in."""
    actions: Array
    """[T, N, A], as the policy drew them, before clipping."""
    rewards: Array
    """[T, N]"""
    mask: Array
    """[T, N], 1 where the step counts: 0 after termination and in rollouts that diverged."""
    last: Array = None
    """[N, S], the states after the last step."""
    going_on: Array = None
    """[N], 1 where the episode has neither ended nor diverged by then."""


Act = Callable[[Array, Array], Array]
"""(states [N, S], key) -> actions [N, A]."""
Simulate = Callable[[Act, Array, Array], tuple[Trajectories, Any]]
"""(act, start states [N, S], key) -> imagined episodes, and what they looked like."""
