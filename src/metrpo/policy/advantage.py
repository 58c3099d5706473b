"""Advantages: generalised advantage estimation against a value function."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from metrpo.devices import across
from metrpo.types import Array, Number


def discounted_returns(
    rewards: Float[Array, "T N"], mask: Float[Array, "T N"], discount: Number
) -> Float[Array, "T N"]:
    """Return from every step on; steps with mask 0 give and pass on nothing."""

    def step(
        following: Float[Array, "N"], at: tuple[Float[Array, "N"], Float[Array, "N"]]
    ) -> tuple[Float[Array, "N"], Float[Array, "N"]]:
        reward, counts = at
        value = counts * (reward + discount * following)
        return value, value

    return jax.lax.scan(step, jnp.zeros(rewards.shape[1]), (rewards, mask), reverse=True)[1]


def gae(
    rewards: Float[Array, "T N"],
    values: Float[Array, "T N"],
    mask: Float[Array, "T N"],
    discount: Number,
    gae_lambda: Number,
    after: Float[Array, "N"] | None = None,
) -> Float[Array, "T N"]:
    """Generalised advantage estimates (Schulman et al. 2016); the value after the last step that counts is 0.

    The episode ends there, by termination or by the horizon, which belongs to the task: the return is that of T steps.
    Episodes that were cut off bring the value `after` their last step.
    """
    after = jnp.zeros_like(values[:1]) if after is None else after[None]
    following = jnp.concatenate([(values * mask)[1:], after])
    errors = mask * (rewards + discount * following - values)
    return discounted_returns(errors, mask, discount * gae_lambda)


def standardise(advantages: Float[Array, "T N"], mask: Float[Array, "T N"]) -> Float[Array, "T N"]:
    """Advantages with mean 0 and standard deviation 1 where `mask` is 1, and 0 elsewhere."""
    count = jnp.maximum(across(jnp.sum(mask)), 1.0)
    mean = across(jnp.sum(advantages * mask)) / count
    variance = across(jnp.sum(jnp.square(advantages - mean) * mask)) / count
    return mask * (advantages - mean) / (jnp.sqrt(variance) + 1e-8)
