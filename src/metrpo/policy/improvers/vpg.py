"""The vanilla policy gradient: one step of Adam along the score-function gradient (Williams 1992)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from metrpo.config import GradientConfig
from metrpo.devices import across
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.adam import ascend
from metrpo.policy.improvers.batch import Batch, ImproveInfo, by_gradient, mean_kl
from metrpo.types import Array, Number


def objective(policy: Policy, batch: Batch, count: Number, penalty: float = 0.0) -> Float[Array, ""]:
    """sum of advantage x log pi(a | s), over `count`: its gradient at the policy that acted is the policy gradient.

    Less `penalty` times what saturated mean actions cost (`gaussian.saturation`).
    """
    means = gaussian.mean(policy, batch.states)
    gain = batch.advantages * gaussian.log_probability(means, policy.log_std, batch.actions)
    cost = penalty * jnp.sum(gaussian.saturation(means, policy.log_std), axis=-1) if penalty else 0.0
    return jnp.sum(batch.mask * (gain - cost)) / count


def improve(
    policy: Policy,
    moments: Any,
    batch: Batch,
    config: GradientConfig,
    penalty: float = 0.0,
) -> tuple[Policy, Any, ImproveInfo]:
    """One gradient step on `batch`; `moments` are Adam's."""
    count = jnp.maximum(across(jnp.sum(batch.mask)), 1.0)
    gradient = across(jax.grad(objective)(policy, batch, count, penalty))
    new, moments, accepted = ascend(policy, moments, gradient, config)
    kl = mean_kl(policy, new, batch.states, batch.mask)
    return new, moments, by_gradient(kl, jnp.float32(0), accepted)
