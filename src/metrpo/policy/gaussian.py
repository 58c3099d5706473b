"""The Gaussian policy: a tanh network for the mean, one log standard deviation per action (paper, appendix A.1.3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from metrpo.types import Array

Layers = tuple[tuple[Float[Array, "_in _out"], Float[Array, "_out"]], ...]
"""One (weights, biases) a layer."""


class Policy(NamedTuple):
    """Parameters of the policy; a pytree."""

    layers: Layers
    log_std: Float[Array, "A"]
    """The same in every state."""


def init(key: Key[Array, ""], state_size: int, action_size: int, hidden: tuple[int, ...], initial_std: float) -> Policy:
    """A fresh policy: Xavier-uniform weights, zero biases."""
    sizes = (state_size, *hidden, action_size)
    keys = jax.random.split(key, len(sizes) - 1)
    xavier = jax.nn.initializers.glorot_uniform()
    layers = tuple(
        (xavier(k, (fan_in, fan_out)), jnp.zeros(fan_out))
        for k, fan_in, fan_out in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )
    return Policy(layers, jnp.full(action_size, math.log(initial_std), jnp.float32))


def mean(policy: Policy, states: Float[Array, "*batch S"]) -> Float[Array, "*batch A"]:
    """The mean action. NumPy in, NumPy out (when the parameters are NumPy), likewise JAX."""
    xp = states.__array_namespace__()
    *inner, (last_weights, last_biases) = policy.layers
    hidden = states
    for weights, biases in inner:
        hidden = xp.tanh(hidden @ weights + biases)
    return hidden @ last_weights + last_biases


def sample(policy: Policy, states: Float[Array, "*batch S"], key: Key[Array, ""]) -> Float[Array, "*batch A"]:
    """Actions drawn from the policy."""
    means = mean(policy, states)
    return means + jnp.exp(policy.log_std) * jax.random.normal(key, means.shape)


def log_probability(
    means: Float[Array, "*steps"], log_std: Float[Array, "*std"], actions: Float[Array, "*steps"], axis: int = -1
) -> Float[Array, "..."]:
    """log pi(a | s) of `actions` under N(means, exp(log_std)^2); the actions lie along `axis`, and are summed over."""
    z = (actions - means) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(jnp.square(z) + 2 * log_std + math.log(2 * math.pi), axis=axis)


def kl(
    old_means: Float[Array, "*steps"],
    old_log_std: Float[Array, "*std"],
    means: Float[Array, "*steps"],
    log_std: Float[Array, "*std"],
    axis: int = -1,
) -> Float[Array, "..."]:
    """KL(old || new) in every state; the actions lie along `axis`, and are summed over."""
    ratio = jnp.exp(2 * (old_log_std - log_std))
    distance = jnp.square((old_means - means) * jnp.exp(-log_std))
    return 0.5 * jnp.sum(ratio + distance - 1.0 + 2 * (log_std - old_log_std), axis=axis)


LIMIT = 0.9
"""Mean actions beyond this are said to saturate: their noise is clipped, so they have little gradient."""


def excess(means: Float[Array, "*steps"]) -> Float[Array, "*steps"]:
    """How far mean actions lie beyond `LIMIT`; signed."""
    return means - jnp.clip(means, -LIMIT, LIMIT)


def saturation(means: Float[Array, "*steps"], log_std: Float[Array, "*std"]) -> Float[Array, "*steps"]:
    """What saturated mean actions cost, each of them: the squared excess beyond `LIMIT`, over the standard deviation.

    The surrogate's slope in the mean grows as 1 / std, too: else what a narrow policy gains would outweigh any cost.
    The cost has no slope in the standard deviation.
    """
    return jnp.square(excess(means)) * jnp.exp(-jax.lax.stop_gradient(log_std))


def reset_std(policy: Policy, initial_std: float) -> Policy:
    """The policy with its standard deviation set back, as at the start of every policy phase."""
    return policy._replace(log_std=jnp.full(policy.log_std.shape, math.log(initial_std), jnp.float32))
