"""Any environment as the loop wants it: flat states, actions in [-1, 1], promises checked at every call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from metrpo.errors import MetrpoError, TaskError

_MOST = float(np.finfo(np.float32).max) / 2
"""Beyond this the difference of two numbers may be infinite in float32, in which everything is learned."""


def representable(numbers: Any) -> bool:
    """Whether all are finite, and stay so in float32 when one is taken from another."""
    return bool(np.all(np.abs(numbers) <= _MOST))  # false for NaN


class Guarded(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """`env` with observations flattened to [S] float64 and actions in [-1, 1], rescaled to its own range.

    With `horizon` every episode is cut off (truncated) after so many steps. Every call is checked, for a broken
    environment poisons the dataset in silence. Raises `TaskError`, naming the environment, the call, what was expected
    and what was got, when it breaks its promise; and at once when its spaces are of a kind that cannot be learned.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], name: str, horizon: int | None = None) -> None:
        self._env, self._name, self._horizon, self._steps = env, name, horizon, 0
        self.metadata, self.render_mode = env.metadata, env.render_mode
        actions = env.action_space
        if not (isinstance(actions, Box) and np.issubdtype(actions.dtype, np.floating)):
            advice = "metrpo learns continuous control; discretised actions can be made continuous by a wrapper"
            raise self._broken("action_space", "a Box of floats", actions, advice)
        if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
            raise self._broken(
                "action_space",
                "finite bounds, to which actions in [-1, 1] are rescaled",
                actions,
                "wrap it in gymnasium.wrappers.ClipAction or give the Box finite low and high",
            )
        self._low, self._span = actions.low.astype(np.float64), (actions.high - actions.low).astype(np.float64)
        self._action_shape, self._action_dtype = actions.shape, actions.dtype
        space = env.observation_space
        if not _is_numeric(space):
            advice = "encode it as numbers, for example with a gymnasium.ObservationWrapper"
            raise self._broken("observation_space", "a Box, or a Dict or Tuple of them", space, advice)
        self._size = int(gymnasium.spaces.flatdim(space))
        self.action_size = int(np.prod(actions.shape))
        self.observation_space = Box(-np.inf, np.inf, (self._size,), np.float64)
        self.action_space = Box(-1.0, 1.0, (self.action_size,), np.float32)
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """A new episode: state [S] and the environment's info."""
        super().reset(seed=seed)
        result = self._call("reset", lambda: self._env.reset(seed=seed, options=options))
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._broken("reset()", "(observation, info)", result, "return both, as Gymnasium does since 0.26")
        self._over, self._steps = False, 0
        return self._state(result[0], "reset()"), dict(result[1] or {})

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """One step with an action in [-1, 1]: state [S], reward, terminated, truncated, info."""
        if self._over:
            raise TaskError(f"{self._name}: step() was called after the end of an episode: call reset() first")
        scaled = self._low.ravel() + 0.5 * (np.clip(np.asarray(action, np.float64), -1, 1) + 1) * self._span.ravel()
        given = scaled.reshape(self._action_shape).astype(self._action_dtype)
        result = self._call("step", lambda: self._env.step(given))
        if not (isinstance(result, tuple) and len(result) == 5):
            expected = "(observation, reward, terminated, truncated, info)"
            raise self._broken("step()", expected, result, "return all five, as Gymnasium does since 0.26")
        observation, reward, terminated, truncated, info = result
        state = self._state(observation, "step()")
        if np.size(reward) != 1 or not representable(np.asarray(reward, np.float64)):
            raise self._broken("step()", "one finite number as reward", reward, "return float(reward)")
        for flag, value in (("terminated", terminated), ("truncated", truncated)):
            if not isinstance(value, bool | np.bool_):
                raise self._broken("step()", f"a bool as {flag}", value, f"return bool({flag})")
        self._steps += 1
        truncated = bool(truncated) or self._steps == self._horizon
        self._over = bool(terminated) or truncated
        return state, float(np.asarray(reward).item()), bool(terminated), truncated, dict(info or {})

    @property
    def time_limit(self) -> int | None:
        """Steps after which an episode is cut off, by us, by a wrapper or by its registration; None: unknown."""
        if self._horizon is not None:
            return self._horizon
        env: Any = self._env
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, gymnasium.wrappers.TimeLimit):
                return int(env._max_episode_steps)
            env = env.env
        return self._env.spec.max_episode_steps if self._env.spec is not None else None

    def render(self) -> Any:
        """What the environment renders."""
        return self._env.render()

    def close(self) -> None:
        """Closes the environment."""
        self._env.close()

    def _call(self, name: str, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except MetrpoError:
            raise
        except Exception as error:
            raise TaskError(
                f"{self._name}: {name}() raised {type(error).__name__}: {error}; "
                "make the environment run by itself first (gymnasium.utils.env_checker.check_env helps)"
            ) from error

    def _state(self, observation: Any, call: str) -> NDArray[np.float64]:
        space = self._env.observation_space
        try:
            state = np.asarray(gymnasium.spaces.flatten(space, observation), np.float64).ravel()
        except Exception as error:
            advice = f"return observations of the space ({type(error).__name__}: {error})"
            raise self._broken(call, f"an observation of {space}", observation, advice) from error
        if (isinstance(space, Box) and np.shape(observation) != space.shape) or state.size != self._size:
            got = f"shape {list(np.shape(observation))}"
            advice = "shapes may not change within a run"
            raise self._broken(call, f"an observation of shape {list(space.shape or (self._size,))}", got, advice)
        if not representable(state):
            where = next(i for i, number in enumerate(state) if not representable(number))
            advice = "end the episode before the simulation diverges, or repair the sensor"
            raise self._broken(call, "finite numbers", f"{state[where]} at index {where}", advice)
        return state

    def _broken(self, call: str, expected: str, got: object, advice: str) -> TaskError:
        return TaskError(f"{self._name}: {call}: expected {expected}, got {_short(got)}; {advice}")


def _is_numeric(space: Any) -> bool:
    if isinstance(space, gymnasium.spaces.Dict):
        return all(_is_numeric(inner) for inner in space.spaces.values())
    if isinstance(space, gymnasium.spaces.Tuple):
        return all(_is_numeric(inner) for inner in space.spaces)
    return isinstance(space, Box)


def _short(value: object) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
