"""Linear features, fitted afresh to every batch: the value function of the paper (authors' settings)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from metrpo.config import AdvantageConfig
from metrpo.devices import across
from metrpo.policy.advantage import discounted_returns, gae, standardise
from metrpo.types import Array, Number, Trajectories


def features(states: Float[Array, "T N S"], timeless: bool = False) -> Float[Array, "T N 2*S+4"]:
    """The baseline's features [o, o^2, t/100, (t/100)^2, (t/100)^3, 1], |o| <= 10.

    `timeless` leaves t at 0.
    """
    observed = jnp.clip(states, -10.0, 10.0)
    steps, count, _ = states.shape
    time = jnp.zeros(steps) if timeless else jnp.arange(steps, dtype=states.dtype) / 100.0
    t = jnp.broadcast_to(time[:, None, None], (steps, count, 1))
    return jnp.concatenate([observed, jnp.square(observed), t, t**2, t**3, jnp.ones_like(t)], axis=-1)


def init(state_size: int) -> Float[Array, "2*{state_size}+4"]:
    """A baseline that predicts 0 everywhere."""
    return jnp.zeros(2 * state_size + 4)


def fit(
    feature: Float[Array, "T N F"], targets: Float[Array, "T N"], mask: Float[Array, "T N"], ridge: Number
) -> Float[Array, "F"]:
    """The weights of a ridge regression of `targets` on `feature` where `mask` is 1.

    Solved by the normal equations in the columns' own scale, which float32 needs: squares reach 100 and counts 50,000.
    """
    x = (feature * mask[..., None]).reshape(-1, feature.shape[-1])
    gram = across(x.T @ x) + ridge * jnp.eye(x.shape[1])
    scale = jax.lax.rsqrt(jnp.diag(gram))
    # Constant or repeated columns are exactly collinear; the jitter is float32's resolution, below any real signal.
    scaled = gram * scale * scale[:, None] + 1e-6 * jnp.eye(x.shape[1])
    target = across(x.T @ (targets * mask).reshape(-1))
    weights = scale * jax.scipy.linalg.solve(scaled, scale * target, assume_a="pos")
    return jnp.where(jnp.all(jnp.isfinite(weights)), weights, 0.0)


def advantages_and_value(
    trajectories: Trajectories,
    baseline: Float[Array, "F"],
    config: AdvantageConfig,
    key: Key[Array, ""] | None = None,
    cut: bool = False,
) -> tuple[Float[Array, "T N"], Float[Array, "F"]]:
    """Standardised advantages under `baseline`, and the baseline refitted to this batch for the next one.

    Trajectories that were `cut` off before their end go on with the baseline's value, which then knows no time. Nothing
    here is drawn: `key` is for the other value functions.
    """
    rewards, mask, discount = trajectories.rewards, trajectories.mask, config.discount
    feature = features(trajectories.states, timeless=cut)
    values = feature @ baseline
    if cut:
        after = trajectories.going_on * at_cut(baseline, trajectories.last)
        advantages = gae(rewards, values, mask, discount, config.gae_lambda, after)
        rewards = rewards.at[-1].add(discount * after)
    else:
        advantages = gae(rewards, values, mask, discount, config.gae_lambda)
    returns = discounted_returns(rewards, mask, discount)
    refitted = fit(feature, returns, trajectories.mask, config.ridge)
    return standardise(advantages, trajectories.mask), refitted


def at_cut(baseline: Float[Array, "F"], states: Float[Array, "N S"]) -> Float[Array, "N"]:
    """The values of the states in which episodes are cut off, whatever the time."""
    return features(states[None], timeless=True)[0] @ baseline
