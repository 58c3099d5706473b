"""Any environment as the loop wants it: flat states, actions in [-1, 1], promises checked at every call."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from metrpo.counting import counted
from metrpo.errors import NotFiniteError, TaskError
from metrpo.world import env_returns
from metrpo.world.env_returns import broken, representable, shown
from metrpo.world.size_limits import require_size

_HUGE = 1e9
"""A bound as large as this says that there is none: an action in [-1, 1] would stand for numbers that nobody wants."""


class Guarded(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """`env` with observations flattened to [S] float64 and actions in [-1, 1], rescaled to its own range.

    With `horizon` every episode is cut off (truncated) after so many steps. Every call is checked, for a broken
    environment poisons the dataset in silence. Raises `TaskError`, naming the environment, the call, what was expected
    and what was got, when it breaks its promise; and at once when its spaces are of a kind that cannot be learned.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], name: str, horizon: int | None = None) -> None:
        self._env, self._name, self._horizon, self._steps = env, name, horizon, 0
        self.metadata, self.render_mode = env.metadata, env.render_mode
        refuse_running_statistics(env, name)
        actions: Any = getattr(env, "action_space", None)
        space: Any = getattr(env, "observation_space", None)
        if not (isinstance(actions, Box) and np.issubdtype(actions.dtype, np.floating)):
            advice = "metrpo learns continuous control; discretised actions can be made continuous by a wrapper"
            raise broken(name, "action_space", "a Box of floats", shown(actions), advice)
        if not (np.abs(actions.low) < _HUGE).all() or not (np.abs(actions.high) < _HUGE).all():
            raise broken(
                name,
                "action_space",
                "finite bounds, to which actions in [-1, 1] are rescaled (1e9 or more counts as infinite)",
                actions,
                "give the Box the range that the motors have, or wrap the environment: gymnasium.wrappers."
                "TransformAction(env, lambda action: action, gymnasium.spaces.Box(low, high, shape))",
            )
        if refused := [f"{shown(part)}{_at(path)}" for path, part in parts(space) if not isinstance(part, Box)]:
            advice = "encode it as numbers, for example with a gymnasium.ObservationWrapper"
            expected = "a Box, or a Dict or Tuple of them"
            raise broken(name, "observation_space", expected, _several(refused), advice)
        self._actions, self._observations = actions, space
        self._low, self._high = actions.low.astype(np.float64), actions.high.astype(np.float64)
        self._size = int(gymnasium.spaces.flatdim(space))
        sizes = {path: int(np.prod(part.shape)) for path, part in parts(space)}
        most = max(sizes, key=lambda path: sizes[path], default=())
        require_size(name, self._size, f"{sizes[most]:,} of them{_at(most)}" if most else "")
        self.action_size = int(np.prod(actions.shape))
        self.observation_space = Box(-np.inf, np.inf, (self._size,), np.float64)
        self.action_space = Box(-1.0, 1.0, (self.action_size,), np.float32)
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """A new episode: state [S] and the environment's info."""
        super().reset(seed=seed)
        observation, info = env_returns.after_reset(self._name, lambda: self._env.reset(seed=seed, options=options))
        self._over, self._steps = False, 0
        return self._state(observation, "reset()"), info

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """One step with an action in [-1, 1]: state [S], reward, terminated, truncated, info."""
        if self._over:
            raise TaskError(f"{self._name}: expected reset() after the end of an episode, got step()")
        given = self._rescaled(action)
        observation, reward, terminated, truncated, info = env_returns.after_step(
            self._name, lambda: self._env.step(given)
        )
        state = self._state(observation, "step()")
        if not representable(reward):
            advice = "end the episode before the simulation diverges"
            raise broken(self._name, "step()", "one finite number as reward", reward, advice, NotFiniteError)
        self._steps += 1
        truncated = truncated or self._steps == self._horizon
        self._over = terminated or truncated
        return state, reward, terminated, truncated, info

    def _rescaled(self, action: NDArray[np.float32]) -> NDArray[Any]:
        """The action in the environment's own range and type, never beyond its bounds."""
        wanted = np.asarray(action, np.float64)
        if wanted.shape != (self.action_size,):
            expected, got = f"an action of {counted(self.action_size, 'number')}", f"shape {list(wanted.shape)}"
            raise broken(self._name, "step()", expected, got, "use a policy that was made for this task")
        part = 0.5 * (np.clip(wanted, -1, 1) + 1).reshape(self._actions.shape)
        scaled = (self._low + part * (self._high - self._low)).astype(self._actions.dtype)
        return np.clip(scaled, self._actions.low, self._actions.high)  # the last bit may have been rounded beyond

    @property
    def inner(self) -> gymnasium.Env[Any, Any]:
        """The guarded environment, without any wrapper; `unwrapped` is this one, as Gymnasium's own check expects."""
        return self._env.unwrapped

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

    def _state(self, observation: Any, call: str) -> NDArray[np.float64]:
        space = self._observations
        try:
            state = np.asarray(gymnasium.spaces.flatten(space, observation), np.float64).ravel()
        except Exception as error:
            path, part, value = _misfit(space, observation)
            advice = f"return observations of the space ({type(error).__name__}: {error})"
            expected = f"an observation of {shown(part)}{_at(path)}"
            raise broken(self._name, call, expected, value, advice) from error
        if (isinstance(space, Box) and np.shape(observation) != space.shape) or state.size != self._size:
            got = f"shape {list(np.shape(observation))}"
            advice = "shapes may not change within a run"
            raise broken(self._name, call, f"an observation of shape {list(space.shape or (self._size,))}", got, advice)
        if not representable(state):
            where = next(i for i, number in enumerate(state) if not representable(number))
            advice = "end the episode before the simulation diverges, or repair the sensor"
            got = f"{state[where]} at index {where}{_part_at(space, where)}"
            raise broken(self._name, call, "finite numbers", got, advice, NotFiniteError)
        return state


def refuse_running_statistics(env: Any, name: str) -> None:
    """Raises `TaskError` where an environment, or a wrapper in it, keeps running statistics to normalise by.

    Gymnasium's NormalizeObservation and NormalizeReward do, and whatever keeps its statistics under the same names.
    """
    layers, seen = [env], set[int]()
    while layers:
        layer = layers.pop()
        own = getattr(layer, "__dict__", {})
        seen.add(id(layer))
        layers += [own[inner] for inner in _INNER if id(own.get(inner)) not in seen and own.get(inner) is not None]
        frozen = getattr(layer, "update_running_mean", True) is False
        if any(statistics in own for statistics in _STATISTICS) and not frozen:
            raise broken(
                name,
                type(layer).__name__,
                "observations and rewards that mean the same in every episode",
                "a wrapper with running statistics, which are lost whenever a fresh environment is made",
                "leave it out: metrpo normalises what it learns from by itself",
            )


_STATISTICS = ("obs_rms", "return_rms", "ret_rms")
"""Names of running statistics in the wrappers of Gymnasium and Stable-Baselines3."""
_INNER = ("env", "_env", "venv", "gym_env")
"""Where wrappers keep what they wrap."""


KeyPath = tuple[Any, ...]
"""The keys and indices that lead to a part of a space."""


def parts(space: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """The parts of Dicts and Tuples, in the order in which they are flattened, with the way to each; else the space."""
    inner: Any = getattr(space, "spaces", None)
    if not isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
        yield path, space
        return
    for key, part in inner.items() if isinstance(inner, dict) else enumerate(inner):
        yield from parts(part, (*path, key))


def _several(texts: list[str]) -> str:
    return " and ".join([*texts[:3], *([f"{len(texts) - 3} more"] if len(texts) > 3 else [])])


def _at(path: KeyPath) -> str:
    return " at " + "".join(f"[{key!r}]" for key in path) if path else ""


def _part_at(space: Any, index: int) -> str:
    """The part that holds number `index` of a flattened observation, in words."""
    for path, part in parts(space):
        index -= int(np.prod(part.shape))
        if index < 0:
            return f" ({_at(path).removeprefix(' at ')})" if path else ""
    return ""


def _misfit(space: Any, observation: Any) -> tuple[KeyPath, Any, Any]:
    """The first part of a space that an observation does not fit: the way to it, the part, and what stands there."""
    for path, part in parts(space):
        value = observation
        try:
            for key in path:
                value = value[key]
            gymnasium.spaces.flatten(part, value)
        except Exception:
            return path, part, value
    return (), space, observation
