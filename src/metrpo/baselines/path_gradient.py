"""The gradient of a real path's return with respect to the policy, through a model (Heess et al. 2015).

The noise of the policy and of the environment is inferred from what happened, so that the model is asked for its
derivatives only, never for rollouts of its own. SVG(inf) differentiates the return of the whole path, SVG(1) one step
of it followed by a learned value.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from metrpo.model.ensemble import Ensemble, predict
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.types import Array, Normaliser
from metrpo.world.task import Task


class RealPath(NamedTuple):
    """One real episode, padded to the horizon T."""

    states: Array
    """[T + 1, S]"""
    drawn: Array
    """[T, A], actions before clipping."""
    rewards: Array
    """[T]"""
    mask: Array
    """[T], 1 within the episode."""


def padded(states: np.ndarray, drawn: np.ndarray, rewards: np.ndarray, horizon: int) -> RealPath:
    """An episode's states [t + 1, S], actions before clipping [t, A] and rewards [t], filled up to the horizon."""
    missing = horizon - len(rewards)
    return RealPath(
        np.concatenate([states, np.repeat(states[-1:], missing, axis=0)]).astype(np.float32),
        np.concatenate([drawn, np.zeros((missing, drawn.shape[1]), np.float32)]),
        np.append(rewards, np.zeros(missing, np.float32)),
        (np.arange(horizon) < len(rewards)).astype(np.float32),
    )


def value_gradient(
    task: Task, ensemble: Ensemble, policy: Policy, path: RealPath, discount: float, value: Policy | None = None
) -> Policy:
    """The gradient of the path's discounted return with respect to the policy's parameters, the noise held fixed.

    Without `value` through the whole path (SVG(inf)); with it, the sum over the path's steps of the gradient of
    r + discount x value of the next state, the states visited being given (SVG(1)).
    """
    time = jnp.arange(path.mask.size)
    residuals, noise = _inferred(ensemble, policy, path)

    reward_of: Any = task.reward

    def one(policy: Policy, state: Array, noise: Array, residual: Array) -> tuple[Array, Array]:
        action = jnp.clip(gaussian.mean(policy, state) + jnp.exp(policy.log_std) * noise, -1.0, 1.0)
        following = _predict(ensemble, state, action) + residual
        return following, reward_of(state, action, following)

    def whole(policy: Policy) -> Array:
        def step(state: Array, given: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
            noise, residual, mask, weight = given
            following, reward = one(policy, state, noise, residual)
            return jnp.where(mask > 0, following, state), mask * weight * reward

        return jnp.sum(jax.lax.scan(step, path.states[0], (noise, residuals, path.mask, discount**time))[1])

    def by_steps(policy: Policy) -> Array:
        following, rewards = jax.vmap(partial(one, policy))(path.states[:-1], noise, residuals)
        # The last step of the horizon has nothing after it.
        going_on = jnp.append(path.mask[1:], 0.0)
        after = state_value(value, ensemble.normaliser, following, time + 1) if value is not None else 0.0
        return jnp.sum(path.mask * (rewards + discount * going_on * after))

    return jax.grad(whole if value is None else by_steps)(policy)


def _inferred(ensemble: Ensemble, policy: Policy, path: RealPath) -> tuple[Array, Array]:
    """What the model missed [T, S] and the policy's noise [T, A], such that both replay the path exactly."""
    states = path.states[:-1]
    predicted = jax.vmap(partial(_predict, ensemble))(states, jnp.clip(path.drawn, -1.0, 1.0))
    noise = (path.drawn - gaussian.mean(policy, states)) * jnp.exp(-policy.log_std)
    return path.states[1:] - predicted, noise


def _predict(ensemble: Ensemble, state: Array, action: Array) -> Array:
    return predict(ensemble, state[None, None], action[None, None])[0, 0]


def state_value(value: Policy, normaliser: Normaliser, states: Array, time: Array) -> Array:
    """[n], of states [n, S] after `time` [n] steps."""
    seen = (states - normaliser.state_mean) * normaliser.state_scale
    return gaussian.mean(value, jnp.concatenate([seen, time[:, None] / 100.0], axis=-1))[:, 0]
