"""Rewards and ends of the paper's six tasks, as formulas that NumPy and JAX compute alike."""

from __future__ import annotations

from metrpo.types import Array, RewardFormula


def _squared_norm(action: Array) -> Array:
    return (action * action).sum(axis=-1)


def velocity_reward(index: int, control: float, bonus: float = 0.0) -> RewardFormula:
    """r = v_x - control ||a||^2 + bonus, with v_x = s'[index]."""

    def reward(state: Array, action: Array, next_state: Array) -> Array:
        return next_state[..., index] - control * _squared_norm(action) + bonus

    return reward


_hopper_speed = velocity_reward(5, 0.005)


def hopper_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = v_x - 0.005 ||a||^2 - 10 max(0.45 - COM z, 0) - 10 sum(max(s' - 100, 0)).

    `state` and `next_state` [..., 11], `action` [..., 3]; returns [...]. Source: the paper, "Environment details".
    """
    xp = next_state.__array_namespace__()
    too_low = xp.maximum(0.45 - next_state[..., 0], 0.0)
    too_large = xp.maximum(next_state - 100.0, 0.0).sum(axis=-1)
    return _hopper_speed(state, action, next_state) - 10.0 * too_low - 10.0 * too_large


def hopper_upright_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = v_x - 0.005 ||a||^2 - 10 max(0.45 - COM z, 0) - 10 max(|pitch| - 0.2, 0) - sum(max(|s'[2:]| - 100, 0)).

    `state` and `next_state` [..., 11], `action` [..., 3]; returns [...]. Source: the authors' code.
    """
    xp = next_state.__array_namespace__()
    too_low = xp.maximum(0.45 - next_state[..., 0], 0.0)
    too_tilted = xp.maximum(abs(next_state[..., 1]) - 0.2, 0.0)
    too_large = xp.maximum(abs(next_state[..., 2:]) - 100.0, 0.0).sum(axis=-1)
    return _hopper_speed(state, action, next_state) - 10.0 * (too_low + too_tilted) - too_large


def humanoid_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = -(head z - 1.5)^2 - 1e-5 ||a||^2.

    `state` and `next_state` [..., 47], `action` [..., 17]; returns [...]. Source: the authors' code; the paper prints
    both terms with a plus, which would reward lying down and wasting effort.
    """
    return -((next_state[..., -1] - 1.5) ** 2) - 1e-5 * _squared_norm(action)


def ant_terminated(next_state: Array) -> Array:
    """True where the COM height has left [0.2, 1.0], or is not a number.

    `next_state` [..., 29]; returns [...] of bool. Source: the paper, "Environment details".
    """
    height = next_state[..., 2]
    return ~((height >= 0.2) & (height <= 1.0))
