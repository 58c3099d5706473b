"""A probe: a linear system with quadratic reward, whose optimal return is known in closed form.

s' = A s + B a slowly spirals outwards on its own; r = -|s'|^2 - |a|^2. The optimal actions stay within [-1, 1] from
every start, so that the Riccati recursion gives the optimum of the clipped system too.
"""

from __future__ import annotations

import contextlib

import gymnasium
import jax
import numpy as np
import pytest

from helpers import slow_mean
from metrpo.world import registry
from metrpo.world.task import Task

A = np.array([[1.0, 0.2], [-0.2, 1.0]])
B = 0.3 * np.eye(2)
HORIZON = 20
START = 0.7
"""Starts are uniform in [-START, START]^2."""


def reward(state, action, next_state):
    return -(next_state**2).sum(-1) - (action**2).sum(-1)


def beyond(next_state):
    """The end of an episode of the ending probe: it starts within and drifts out."""
    return abs(next_state[..., 0]) > 0.75


class ProbeEnv(gymnasium.Env):
    """Ends where `ends` says; `open_count` counts the environments not yet closed."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    open_count = 0

    def __init__(self, ends=None):
        self.ends = ends
        type(self).open_count += 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-START, START, 2)
        return self.state.copy(), {}

    def step(self, action):
        assert action.dtype == np.float32
        assert np.abs(action).max() <= 1, "the loop clips before it steps"
        state, self.state = self.state, A @ self.state + B @ action.astype(float)
        ended = self.ends is not None and bool(self.ends(self.state))
        return self.state.copy(), reward(state, action.astype(float), self.state), ended, False, {}

    def close(self):
        type(self).open_count -= 1


def _task(name, horizon=HORIZON, ends=None):
    env_id = f"tests/{name}-v0"
    gymnasium.register(
        env_id, entry_point=ProbeEnv, max_episode_steps=horizon, disable_env_checker=True, kwargs={"ends": ends}
    )
    return Task(name, env_id, 2, 2, horizon, reward, ends, description="a linear system with a known optimum")


PROBE = _task("Probe")
LONG_PROBE = _task("LongProbe", horizon=200)
ENDING_PROBE = _task("EndingProbe", ends=beyond)


def riccati():
    """(P, gains [T]): the optimal return from s is -s' P s, reached by a_t = -gains[t] s_t."""
    p, gains = np.zeros((2, 2)), []
    for _ in range(HORIZON):
        m = np.eye(2) + p
        gain = np.linalg.solve(np.eye(2) + B.T @ m @ B, B.T @ m @ A)
        p = A.T @ m @ A - A.T @ m @ B @ gain
        gains.append(gain)
    return p, np.array(gains[::-1])


def starts(count):
    """Start states of the resets with seeds 0, 1, ... [count, 2]."""
    env = PROBE.make_env()
    states = np.array([env.reset(seed=seed)[0] for seed in range(count)])
    env.close()
    return states


def rollout(task, seed, act):
    """One real episode of `act(t, state)` from `env.reset(seed=seed)`: states, clipped actions, rewards."""
    env = task.make_env()
    state, _ = env.reset(seed=seed)
    states, actions, rewards, over = [state], [], [], False
    while not over:
        action = np.clip(act(len(actions), state), -1, 1).astype(np.float32)
        state, r, terminated, truncated, _ = env.step(action)
        states.append(state)
        actions.append(action)
        rewards.append(r)
        over = terminated or truncated
    env.close()
    return np.array(states), np.array(actions), np.array(rewards)


def optimum():
    """The optimal return, mean over 30 starts."""
    p, _ = riccati()
    return np.mean([-s @ p @ s for s in starts(30)])


def real_return(policy):
    """Real return of the mean action, from the starts of `optimum`."""
    host = jax.tree.map(np.asarray, policy)
    episodes = [rollout(PROBE, n, lambda _, s: slow_mean(host, s)) for n in range(30)]
    return np.mean([rewards.sum() for _, _, rewards in episodes])


@contextlib.contextmanager
def registered():
    """The probes as tasks that are known by name."""
    with pytest.MonkeyPatch.context() as patch:
        for task in (PROBE, ENDING_PROBE):
            patch.setitem(registry._TASKS, task.name, task)
        yield


BRIEF = {
    "collect.steps": 60,
    "collect.max_train": 200,
    "collect.max_validation": 100,
    "ensemble.members": 2,
    "ensemble.hidden": (8,),
    "fit.max_steps": 20,
    "imagine.steps": 400,
    "policy.hidden": (8,),
    "validate.max_updates": 5,
    "validate.starts": 5,
    "evaluation_episodes": 2,
    "deterministic": True,
    "trust_reward": True,
}
"""Settings with which an iteration takes no time; the run in tests/guarantees/format-1 was made with them."""

LEARN = {
    "collect.max_train": 1000,
    "collect.max_validation": 500,
    "ensemble.members": 3,
    "ensemble.hidden": (16,),
    "fit.batch_size": 50,
    "fit.learning_rate": 0.01,
    "fit.max_passes": 100,
    "imagine.steps": 2000,
    "policy.hidden": (8,),
    "policy.initial_std": 0.5,
    "trpo.max_kl": 0.03,
    "validate.max_updates": 60,
    "validate.starts": 50,
}
"""Settings with which the whole loop learns the probe within seconds."""
