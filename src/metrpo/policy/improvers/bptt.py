"""Backpropagation through time: the gradient of the imagined return through the models (paper, section 4.2, eq. 3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from metrpo.config import GradientConfig
from metrpo.devices import across
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.adam import ascend
from metrpo.policy.improvers.batch import ImproveInfo, by_gradient, mean_kl
from metrpo.types import Array, SampleActions, Simulate


def deterministic(policy: Policy) -> SampleActions:
    """Acts by the mean: a = mu(s)."""
    return lambda states, key: gaussian.mean(policy, states)


def stochastic(policy: Policy) -> SampleActions:
    """Acts by reparametrised samples, a = mu(s) + sigma x noise: gradients reach mu and sigma (Heess et al. 2015)."""
    return lambda states, key: gaussian.sample(policy, states, key)


def improve(
    policy: Policy,
    moments: Any,
    act: Callable[[Policy], SampleActions],
    simulate: Simulate,
    starts: Float[Array, "N S"],
    config: GradientConfig,
    key: Key[Array, ""],
) -> tuple[Policy, Any, tuple[ImproveInfo, Any]]:
    """One gradient step on the mean return of rollouts from `starts` under `act` (one of the two above).

    Rollouts that diverge count nothing; one that meets NaN makes the gradient NaN, and the update is refused.
    """

    def total_return(policy: Policy) -> tuple[Float[Array, ""], Any]:
        rollouts, info = simulate(act(policy), starts, key)
        return jnp.sum(rollouts.rewards * rollouts.mask), (rollouts, info)

    gradient, (rollouts, info) = jax.grad(total_return, has_aux=True)(policy)
    count = across(jnp.float32(starts.shape[0]))
    gradient = jax.tree.map(lambda g: g / count, across(gradient))
    new, moments, accepted = ascend(policy, moments, gradient, config)
    kl = mean_kl(policy, new, rollouts.states, rollouts.mask)
    return new, moments, (by_gradient(kl, jnp.float32(0), accepted), info)
