"""The records that pass between the real side (`world`) and the learned side (`model`, `policy`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Key

Array = Any
"""A NumPy or a JAX array. jaxtyping says its kind and its shape: `Float[Array, "N S"]`."""
Number = float | Float[Array, ""]
"""A number of the settings, or a traced one."""


class Episode(NamedTuple):
    """One real episode of L steps."""

    states: Float[np.ndarray, "L+1 S"]
    """float64 (float32 in old files): as the environment gave them; the last one is after the last step."""
    actions: Float[np.ndarray, "L A"]
    """float32, as executed: within [-1, 1]."""
    rewards: Float[np.ndarray, "L"]
    """float32."""
    terminated: bool
    """The task ended it, not the clock."""


class Transitions(NamedTuple):
    """n real transitions; on the device the arrays have a fixed capacity C >= n, so that growth never recompiles."""

    states: Float[Array, "C S"]
    """Counted from the dataset's origin."""
    actions: Float[Array, "C A"]
    deltas: Float[Array, "C D"]
    """What the models predict: the change of state, without what is carried over of a history (`metrpo.history`);
    then, where they are learned, the reward, and 1 where the task ended the episode, else 0."""
    size: Int[Array, ""] | int
    """n (a scalar array on the device)."""


class Normaliser(NamedTuple):
    """Shift and scale of the networks' inputs and outputs, from training data only."""

    state_mean: Float[Array, "S"]
    state_scale: Float[Array, "S"]
    """1 / std; 0 where the task keeps a dimension from the network (a global position)."""
    action_mean: Float[Array, "A"]
    action_scale: Float[Array, "A"]
    """1 / std."""
    delta_mean: Float[Array, "D"]
    """Of what the models predict."""
    delta_std: Float[Array, "D"]


class Trajectories(NamedTuple):
    """N imagined episodes of T steps."""

    states: Float[Array, "T N S"]
    """The states acted in."""
    actions: Float[Array, "T N A"]
    """As the policy drew them, before clipping."""
    rewards: Float[Array, "T N"]
    mask: Float[Array, "T N"]
    """1 where the step counts: 0 after termination and in rollouts that diverged."""
    last: Float[Array, "N S"] = None
    """The states after the last step."""
    going_on: Float[Array, "N"] = None
    """1 where the episode has neither ended nor diverged by then."""
    noted: Any = None
    """[T, N, ...], a pytree: what the policy said besides its actions."""
    trusted: Float[Array, "T N"] = None
    """0 from the first step on with which the models are not trusted, and the episode stands still. None: they always
    are trusted."""


RewardFormula = Callable[[Array, Array, Array], Array]
"""r(s, a, s'): [..., S], [..., A], [..., S] -> [...]; `a` within [-1, 1]; NumPy or JAX arrays alike."""
EndFormula = Callable[[Array], Array]
"""Whether an episode ends in s': [..., S] -> [...] of bool."""
SampleActions = Callable[[Float[Array, "N S"], Key[Array, ""]], Any]
"""(states [N, S], key) -> actions [N, A], or a pair of these and what is to be noted with them (a pytree, [N, ...])."""
Simulate = Callable[[SampleActions, Float[Array, "N S"], Key[Array, ""]], tuple[Trajectories, Any]]
"""(act, start states, key) -> imagined episodes, and what they looked like."""
