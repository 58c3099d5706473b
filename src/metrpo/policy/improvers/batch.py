"""What a policy update learns from, and what it reports."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from metrpo.devices import across
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.types import Array


class Batch(NamedTuple):
    """n steps to learn from."""

    states: Float[Array, "n S"]
    actions: Float[Array, "n A"]
    """As drawn."""
    advantages: Float[Array, "n"]
    """Standardised."""
    mask: Float[Array, "n"]
    """1 where the step counts."""


class ImproveInfo(NamedTuple):
    """What one policy update did."""

    kl: Float[Array, ""]
    """Mean KL(old || new); 0 when rejected."""
    improvement: Float[Array, ""]
    """Gain of the surrogate objective; 0 for improvers without one."""
    accepted: Bool[Array, ""]
    """TRPO: the line search found a step; the others: every gradient was finite."""
    backtracks: Int[Array, ""]
    """TRPO: tries before the accepted one."""
    cg_residual: Float[Array, ""]
    """TRPO: |F x - g| / |g| after the last conjugate-gradient iteration."""


def by_gradient(kl: Float[Array, ""], improvement: Float[Array, ""], accepted: Bool[Array, ""]) -> ImproveInfo:
    """What an improver without line search and conjugate gradients reports."""
    return ImproveInfo(kl, improvement, accepted, jnp.int32(0), jnp.float32(0))


def mean_kl(
    old: Policy, new: Policy, states: Float[Array, "*batch S"], mask: Float[Array, "*batch"]
) -> Float[Array, ""]:
    """KL(old || new), mean over the `states` where `mask` is 1."""
    means = gaussian.mean(old, states), gaussian.mean(new, states)
    kl = gaussian.kl(means[0], old.log_std, means[1], new.log_std)
    total, count = across((jnp.sum(mask * kl), jnp.sum(mask)))
    return total / jnp.maximum(count, 1.0)
