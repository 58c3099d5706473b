"""Critics: networks that value a state and an action, several at once and unlike each other.

Each says how much the soft return is above the middle of what is possible, in units of `ValueScale`; hidden layers are
normalised (Ba et al. 2016), without which an off-policy critic that leans on itself may run away.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from metrpo.types import Array

Critic = tuple[tuple[Array, Array], ...]
"""One (weights [in, out], biases [out]) a layer."""
Critics = tuple[Critic, ...]
_VARIES = 0.25
"""By how much values differ from state to state, in parts of what a reward's std would add up to if it lasted."""


class ValueScale(NamedTuple):
    """Units of the critics' outputs: a value is middle + width * output."""

    middle: Array
    """[]"""
    width: Array
    """[], above 0."""
    lowest: Array
    """[], no return is below it."""
    highest: Array
    """[], no return is above it."""


def init(key: Array, count: int, input_size: int, hidden: tuple[int, ...]) -> Critics:
    """Fresh critics: He-normal weights and a last layer of zeros, so that all say the middle."""
    sizes = (input_size, *hidden)
    he = jax.nn.initializers.he_normal()

    def one(key: Array) -> Critic:
        keys = jax.random.split(key, len(sizes))
        layers = [(he(k, pair), jnp.zeros(pair[1])) for k, pair in zip(keys, pairwise(sizes), strict=False)]
        return (*layers, (jnp.zeros((sizes[-1], 1)), jnp.zeros(1)))

    return tuple(one(k) for k in jax.random.split(key, count))


def outputs(critics: Critics, states: Array, actions: Array) -> Array:
    """What every critic says: [..., S], [..., A] -> [C, ...]."""
    x = jnp.concatenate([states, actions], axis=-1)
    return jnp.stack([_output(critic, x) for critic in critics])


def _output(critic: Critic, x: Array) -> Array:
    *inner, (weights, biases) = critic
    for w, b in inner:
        x = jax.nn.silu(_normalised(x @ w + b))
    return (x @ weights + biases)[..., 0]


def _normalised(x: Array) -> Array:
    centred = x - jnp.mean(x, axis=-1, keepdims=True)
    return centred * jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=-1, keepdims=True) + 1e-5)


def valued(scale: ValueScale, outputs: Array) -> Array:
    """Outputs as soft returns."""
    return scale.middle + scale.width * outputs


def scale_of(rewards: np.ndarray, discount: float, ends: bool) -> ValueScale:
    """The units for `rewards` [n] of real steps; where episodes may end, nothing follows, which is worth 0.

    The middle is what their mean adds up to, or that 0: critics begin there, and a value is long in coming from afar.
    """
    reach, mean, std = 1.0 / (1.0 - discount), float(np.mean(rewards)), float(np.std(rewards))
    lowest, highest = float(np.min(rewards)), float(np.max(rewards))
    if ends:
        lowest, highest, std, mean = min(lowest, 0.0), max(highest, 0.0), max(std, abs(mean)), 0.0
    # Rewards that have not varied yet say nothing of those to come.
    width = std if std > 1e-6 * abs(mean) else max(abs(mean), 1.0)
    slack = max(highest - lowest, width)
    numbers = (mean, _VARIES * width, lowest - slack, highest + slack)
    return ValueScale(*(np.float32(reach * number) for number in numbers))


def reward_spread(scale: ValueScale, discount: float) -> float:
    """The std of the rewards that this scale is of; where episodes may end, at least the size of their mean."""
    return float(scale.width) * (1.0 - discount) / _VARIES


def rescaled(critics: Critics, old: ValueScale, new: ValueScale) -> Critics:
    """Critics that say in the `new` units what they said in the `old` ones (van Hasselt et al. 2016)."""
    ratio, shift = old.width / new.width, (old.middle - new.middle) / new.width

    def one(critic: Critic) -> Critic:
        *inner, (weights, biases) = critic
        return (*inner, (weights * ratio, biases * ratio + shift))

    return tuple(one(critic) for critic in critics)


def averaged(targets: Critics, critics: Critics, rate: float) -> Critics:
    """The moving average of the critics, one step on."""
    return jax.tree.map(lambda slow, fast: slow + rate * (fast - slow), targets, critics)
