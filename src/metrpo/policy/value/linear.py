"""Linear features, fitted afresh to every batch: the value function of the paper (authors' settings)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from metrpo.devices import across
from metrpo.policy.advantage import discounted_returns, gae, standardise
from metrpo.types import Array, Trajectories


def features(states: Array, timeless: bool = False) -> Array:
    """The baseline's features [o, o^2, t/100, (t/100)^2, (t/100)^3, 1], |o| <= 10: [T, N, S] -> [T, N, 2S + 4].

    `timeless` leaves t at 0.
    """
    observed = jnp.clip(states, -10.0, 10.0)
    steps, count, _ = states.shape
    time = jnp.zeros(steps) if timeless else jnp.arange(steps, dtype=states.dtype) / 100.0
    t = jnp.broadcast_to(time[:, None, None], (steps, count, 1))
    return jnp.concatenate([observed, jnp.square(observed), t, t**2, t**3, jnp.ones_like(t)], axis=-1)


def init(state_size: int) -> Array:
    """A baseline that predicts 0 everywhere: [2S + 4]."""
    return jnp.zeros(2 * state_size + 4)


def fit(feature: Array, targets: Array, mask: Array, ridge: float, axis: str | None = None) -> Array:
    """Ridge regression of `targets` [T, N] on `feature` [T, N, F] where `mask` [T, N] is 1: weights [F].

    Solved by the normal equations in the columns' own scale, which float32 needs: squares reach 100 and counts 50,000.
    """
    x = (feature * mask[..., None]).reshape(-1, feature.shape[-1])
    gram = across(x.T @ x, axis) + ridge * jnp.eye(x.shape[1])
    scale = jax.lax.rsqrt(jnp.diag(gram))
    # Constant or repeated columns are exactly collinear; the jitter is float32's resolution, below any real signal.
    scaled = gram * scale * scale[:, None] + 1e-6 * jnp.eye(x.shape[1])
    target = across(x.T @ (targets * mask).reshape(-1), axis)
    weights = scale * jax.scipy.linalg.solve(scaled, scale * target, assume_a="pos")
    return jnp.where(jnp.all(jnp.isfinite(weights)), weights, 0.0)


def advantages_and_value(
    trajectories: Trajectories,
    baseline: Array,
    discount: float,
    gae_lambda: float,
    ridge: float,
    axis: str | None = None,
    cut: bool = False,
) -> tuple[Array, Array]:
    """Standardised advantages [T, N] under `baseline`, and the baseline refitted to this batch for the next one.

    Trajectories that were `cut` off before their end go on with the baseline's value, which then knows no time. With
    `axis`, the trajectories are this device's share of the batch (see `metrpo.devices`).
    """
    rewards, mask = trajectories.rewards, trajectories.mask
    feature = features(trajectories.states, timeless=cut)
    values = feature @ baseline
    if cut:
        after = trajectories.going_on * (features(trajectories.last[None], timeless=True)[0] @ baseline)
        advantages = gae(rewards, values, mask, discount, gae_lambda, after)
        rewards = rewards.at[-1].add(discount * after)
    else:
        advantages = gae(rewards, values, mask, discount, gae_lambda)
    returns = discounted_returns(rewards, mask, discount)
    refitted = fit(feature, returns, trajectories.mask, ridge, axis)
    return standardise(advantages, trajectories.mask, axis), refitted
