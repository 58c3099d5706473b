"""Proximal policy optimization: several epochs of minibatches on the clipped surrogate (Schulman et al. 2017)."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Key

from metrpo.config import GradientConfig, PPOConfig
from metrpo.devices import across, share_of
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.adam import ascend
from metrpo.policy.improvers.batch import Batch, ImproveInfo, by_gradient, mean_kl
from metrpo.types import Array, Number

_Climb = tuple[Policy, Any, Bool[Array, ""]]
"""The policy, Adam's moments, and whether every step was made so far."""


def clipped_surrogate(
    policy: Policy, batch: Batch, old_log_probability: Float[Array, "n"], clip: Number, penalty: float = 0.0
) -> Float[Array, ""]:
    """sum of min(ratio A, clip(ratio, 1 - clip, 1 + clip) A) over the steps of `batch` (their equation 7).

    Less `penalty` times what saturated mean actions cost (`gaussian.saturation`).
    """
    means = gaussian.mean(policy, batch.states)
    log_probability = gaussian.log_probability(means, policy.log_std, batch.actions)
    cost = penalty * jnp.sum(gaussian.saturation(means, policy.log_std), axis=-1) if penalty else 0.0
    ratio = jnp.exp(log_probability - old_log_probability)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return jnp.sum(batch.mask * (jnp.minimum(ratio * batch.advantages, clipped * batch.advantages) - cost))


def improve(
    policy: Policy,
    moments: Any,
    batch: Batch,
    ppo: PPOConfig,
    config: GradientConfig,
    key: Key[Array, ""],
    penalty: float = 0.0,
) -> tuple[Policy, Any, ImproveInfo]:
    """`ppo.epochs` passes over `batch`, shuffled anew in each by `key`; `moments` are Adam's.

    Steps that `ppo.minibatches` does not divide are left out of a pass, others each time.
    """
    old_log_probability = gaussian.log_probability(gaussian.mean(policy, batch.states), policy.log_std, batch.actions)
    steps = batch.mask.shape[0]
    minibatches = min(ppo.minibatches, steps)
    size = steps // minibatches

    def step(carry: _Climb, index: Int[Array, "n"]) -> tuple[_Climb, None]:
        policy, moments, sound = carry
        rows = jax.tree.map(partial(jnp.take, indices=index, axis=0), (batch, old_log_probability))
        count = jnp.maximum(across(jnp.sum(rows[0].mask)), 1.0)
        gradient = across(jax.grad(clipped_surrogate)(policy, *rows, ppo.clip, penalty))
        gradient = jax.tree.map(lambda g: g / count, gradient)
        policy, moments, made = ascend(policy, moments, gradient, config)
        return (policy, moments, sound & made), None

    def epoch(carry: _Climb, key: Key[Array, ""]) -> tuple[_Climb, None]:
        order = jax.random.permutation(key, steps)[: minibatches * size].reshape(minibatches, size)
        return jax.lax.scan(step, carry, order)[0], None

    keys = jax.random.split(share_of(key), ppo.epochs)
    (new, moments, sound), _ = jax.lax.scan(epoch, (policy, moments, jnp.bool_(True)), keys)
    count = jnp.maximum(across(jnp.sum(batch.mask)), 1.0)
    gain, start = (
        across(clipped_surrogate(p, batch, old_log_probability, ppo.clip, penalty)) / count for p in (new, policy)
    )
    kl = mean_kl(policy, new, batch.states, batch.mask)
    return new, moments, by_gradient(kl, gain - start, sound)
