"""The squashed Gaussian actor: the tanh of a Gaussian whose mean and spread a network gives (Haarnoja et al. 2018).

Its mean action, tanh of the network's first outputs, is a tanh network with an identity for its last layer. As such it
is stored, played and exported like every other policy (`mean_policy`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.inputs import Inputs, folded, normalised
from metrpo.types import Array

LOG_STD = (-5.0, 2.0)
"""Bounds of the Gaussian's log standard deviation, before the tanh."""


class Actor(NamedTuple):
    """Parameters of the actor; a pytree."""

    layers: tuple[tuple[Array, Array], ...]
    """One (weights [in, out], biases [out]) a layer; the last gives 2 A numbers: means, then log stds."""


def init(key: Array, state_size: int, action_size: int, hidden: tuple[int, ...]) -> Actor:
    """A fresh actor: Xavier-uniform weights, zero biases."""
    return Actor(gaussian.init(key, state_size, 2 * action_size, hidden, 1.0).layers)


def moments(actor: Actor, states: Array) -> tuple[Array, Array]:
    """Mean and log std of the Gaussian before the tanh: [..., S] -> [..., A] twice; NumPy or JAX arrays alike."""
    outputs = gaussian.mean(Policy(actor.layers, None), states)
    size = outputs.shape[-1] // 2
    return outputs[..., :size], outputs[..., size:].clip(*LOG_STD)


def sample(actor: Actor, states: Array, key: Array) -> tuple[Array, Array]:
    """Actions within [-1, 1] and their log-probabilities: [..., S] -> [..., A], [...]. Gradients pass through both."""
    means, log_std = moments(actor, states)
    noise = jax.random.normal(key, means.shape)
    drawn = means + jnp.exp(log_std) * noise
    gauss = -0.5 * jnp.square(noise) - log_std - 0.5 * math.log(2 * math.pi)
    return jnp.tanh(drawn), jnp.sum(gauss - log_slope(drawn), axis=-1)


def log_slope(x: Array) -> Array:
    """log of the derivative of tanh, exact also where it is tiny."""
    return 2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x))


def draw(actor: Actor, states: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Actions in real states [..., S], with NumPy alone, out of `noise` N(0, I) [..., A]."""
    means, log_std = moments(actor, states)
    return np.tanh(means + np.exp(log_std) * noise)


def mean_policy(actor: Actor, inputs: Inputs | None, states: np.ndarray) -> Policy:
    """What the actor does without noise, as a policy of raw states; host arrays.

    Its `log_std`, for the record alone, is the mean over `states` [n, S], which are raw.
    """
    *inner, (weights, biases) = jax.tree.map(np.asarray, actor.layers)
    size = len(biases) // 2
    identity = np.eye(size, dtype=np.float32), np.zeros(size, np.float32)
    policy = Policy((*inner, (weights[:, :size], biases[:size]), identity), np.zeros(size, np.float32))
    if len(states):
        log_std = moments(on_host(actor), normalised(inputs, states))[1]
        policy = policy._replace(log_std=log_std.mean(axis=0, dtype=np.float32))
    return policy if inputs is None else folded(policy, inputs)


def on_host(actor: Actor) -> Actor:
    """The actor as NumPy arrays."""
    return jax.tree.map(np.asarray, actor)


def kl(old: Actor, new: Actor, states: np.ndarray) -> np.ndarray:
    """KL(old || new) in every state, [..., S] -> [...], with NumPy alone; the tanh changes nothing of it."""
    (before, old_log_std), (after, log_std) = (moments(actor, states) for actor in (old, new))
    change = old_log_std - log_std
    distance = np.square((before - after) * np.exp(-log_std))
    return np.sum(0.5 * (np.exp(2 * change) + distance - 1.0) - change, axis=-1)
