"""Bounds of imagination: models say nothing of what lies far beyond their data, and may not be asked there.

Without bounds a network's straight lines lead to states and rewards that no real step has, and an actor that follows
the gradient through the models finds them first.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from metrpo.types import Array, Transitions


class Bounds(NamedTuple):
    """What imagined steps stay within; a pytree."""

    lowest: Array
    """[S], of a state."""
    highest: Array
    """[S]"""
    least: Array
    """[D], of a change of the state; then of what else is learned."""
    most: Array
    """[D]"""


def bounds_of(data: Transitions, margin: float, unseen: tuple[int, ...] = (), carried: tuple[int, ...] = ()) -> Bounds:
    """The range of `data` (host arrays) and `margin` times its width beyond; `unseen` states have no bounds.

    Nor have the changes of what is `carried` over (`Task.carried`). The data do not hold them; they lie behind those of
    the rest of the state.
    """
    states, changes = (_range(np.asarray(x), margin) for x in (data.states, data.deltas))
    size = data.states.shape[1] - len(carried)
    for bound, limit in zip(states, (-np.inf, np.inf), strict=True):
        bound[list(unseen)] = limit
    least, most = (
        np.concatenate([x[:size], np.full(len(carried), limit, x.dtype), x[size:]])
        for x, limit in zip(changes, (-np.inf, np.inf), strict=True)
    )
    return Bounds(*states, least, most)


def _range(rows: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    low, high = rows.min(axis=0), rows.max(axis=0)
    return low - margin * (high - low), high + margin * (high - low)


def bounded(bounds: Bounds, states: Array, predicted: Array) -> Array:
    """Predictions [..., D], the next states first, brought within the bounds; of NaN they stay NaN."""
    size = states.shape[-1]
    change = jnp.clip(predicted[..., :size] - states, bounds.least[:size], bounds.most[:size])
    following = jnp.clip(states + change, bounds.lowest, bounds.highest)
    rest = jnp.clip(predicted[..., size:], bounds.least[size:], bounds.most[size:])
    return jnp.concatenate([following, rest], axis=-1)
