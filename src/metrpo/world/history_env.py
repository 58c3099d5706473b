"""A task whose states hold a history, and the environment that gives such states (`metrpo.history`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from metrpo.counting import counted
from metrpo.errors import ConfigError, EpisodeError
from metrpo.history import History
from metrpo.types import Array
from metrpo.world import env_returns
from metrpo.world.size_limits import MOST_NUMBERS
from metrpo.world.task import Task


class HistoryEnv(gymnasium.Wrapper):
    """An environment with states [S] of its last observations and of the actions between them, as they were executed.

    Raises `TaskError` where the environment breaks its promise, `EpisodeError` for an observation of another size.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], name: str, history: History) -> None:
        super().__init__(env)
        self._name, self._history = name, history
        self.observation_space = Box(-np.inf, np.inf, (history.state_size,), np.float64)
        self._state = np.zeros(history.state_size)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """A new episode: a state in which nothing has been done yet, and the environment's info."""
        given, info = env_returns.after_reset(self._name, lambda: self.env.reset(seed=seed, options=options))
        self._state = self._history.begin(self._observed(given, "reset()"))
        return self._state.copy(), info

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """One step with an action in [-1, 1]: state [S], reward, terminated, truncated, info."""
        given, reward, terminated, truncated, info = env_returns.after_step(self._name, lambda: self.env.step(action))
        executed = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        self._state = self._history.follow(self._state, executed, self._observed(given, "step()"))
        return self._state.copy(), reward, terminated, truncated, info

    def _observed(self, given: Any, call: str) -> NDArray[np.float64]:
        found = env_returns.array_of(given)
        if found is None or found.shape != (self._history.observation_size,):
            expected = f"an observation of {counted(self._history.observation_size, 'number')}"
            got = given if found is None else f"shape {list(found.shape)}"
            advice = "return an array of so many numbers, or make the task by metrpo.task_of, which flattens others"
            raise env_returns.broken(self._name, call, expected, got, advice, EpisodeError)
        return found.astype(np.float64)


@cache
def with_history(task: Task, length: int) -> Task:
    """The task whose states hold the last `length` observations and the actions between them; with 1 as it is.

    Its formulas, and what the models do not see, are those of the observation. The same object every time. Raises
    `ConfigError` where such a state would be too large.
    """
    if length == task.history:
        return task
    if task.history != 1:
        raise ValueError(f"{task.name}: expected a task without a history, got one of {task.history}")
    history = History(length, task.state_size, task.action_size)
    if history.state_size > MOST_NUMBERS:
        most = (MOST_NUMBERS + task.action_size) // (task.state_size + task.action_size)
        raise ConfigError(
            f"history: expected at most {most} for {task.name}, got {length}: {length} observations of "
            f"{counted(task.state_size, 'number')} and the actions between them are {history.state_size:,}, and a "
            f"state may hold {MOST_NUMBERS:,}"
        )
    return dataclasses.replace(
        task,
        state_size=history.state_size,
        reward=None if task.reward is None else partial(_reward, task.reward, task.state_size),
        terminated=partial(_ended, task.terminated, task.state_size) if callable(task.terminated) else task.terminated,
        unseen=history.copies(task.unseen),
        make=partial(_make, task, history) if task.playable else None,
        history=length,
    )


def _make(task: Task, history: History, **kwargs: Any) -> HistoryEnv:
    return HistoryEnv(task.make_env(**kwargs), task.name, history)


def _reward(
    reward: Callable[[Array, Array, Array], Array], size: int, states: Array, actions: Array, following: Array
) -> Array:
    return reward(states[..., :size], actions, following[..., :size])


def _ended(terminated: Callable[[Array], Array], size: int, following: Array) -> Array:
    return terminated(following[..., :size])
