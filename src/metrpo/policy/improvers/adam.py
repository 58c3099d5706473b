"""Gradient ascent by Adam on a policy's parameters, with clipped gradients: what all improvers but TRPO share."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Bool, Shaped

from metrpo.config import GradientConfig
from metrpo.policy.gaussian import Policy
from metrpo.types import Array


def _optimizer(config: GradientConfig) -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(config.max_norm), optax.adam(config.learning_rate))


def init_moments(policy: Policy, config: GradientConfig) -> Any:
    """Adam's moments, all zero: a pytree."""
    return _optimizer(config).init(policy)


def ascend(
    policy: Policy, moments: Any, gradient: Policy, config: GradientConfig
) -> tuple[Policy, Any, Bool[Array, ""]]:
    """One step uphill: (policy, moments, whether it was made); a gradient that is not finite moves nothing."""
    downhill = jax.tree.map(jnp.negative, gradient)
    change, next_moments = _optimizer(config).update(downhill, moments, policy)
    finite = jnp.isfinite(optax.tree.norm(gradient))

    def kept(new: Shaped[Array, "*shape"], old: Shaped[Array, "*shape"]) -> Shaped[Array, "*shape"]:
        return jnp.where(finite, new, old)

    new = jax.tree.map(kept, optax.apply_updates(policy, change), policy)
    return new, jax.tree.map(kept, next_moments, moments), finite
