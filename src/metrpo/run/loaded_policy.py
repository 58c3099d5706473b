"""The learned policy in use, without JAX: NumPy in, NumPy out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from metrpo.history import History
from metrpo.limits import Limits
from metrpo.safe_load import brief


@dataclass(frozen=True)
class PolicyInfo:
    """A policy's task, sizes, limits and origin."""

    task: str
    """Name of the task it was trained on."""
    observation_size: int
    """O, the size of an observation."""
    action_size: int
    """A"""
    hidden: tuple[int, ...]
    """Sizes of the hidden layers."""
    iteration: int
    """Outer iterations of training."""
    real_steps: int
    """Real steps that it learned from."""
    return_real: float | None
    """Mean real return of the deterministic policy at that time."""
    activation: str = "tanh"
    """Of the hidden layers; the output layer is linear, clipped to [-1, 1]."""
    observation: tuple[tuple[int, str], ...] | None = None
    """The parts of an observation, in order: size and description; None: unknown."""
    action_low: tuple[float, ...] | None = None
    """[A], the environment's action for -1; None: unknown."""
    action_high: tuple[float, ...] | None = None
    """[A], the environment's action for 1; None: unknown."""
    env_kwargs: tuple[str, ...] = ()
    """Keyword arguments of its environment, each KEY=VALUE (`metrpo.config.env_kwargs`)."""
    imports: tuple[str, ...] = ()
    """Modules that register its environment."""
    max_action: float = 1.0
    """Its actions stay within plus and minus this."""
    max_change: float | None = None
    """Limit on the change of its actions from one step to the next; None: no limit."""
    history: int = 1
    """Observations that its network sees: the newest, the older ones, and the actions between them."""

    @property
    def layout(self) -> History:
        """How the states that its network sees are put together."""
        return History(self.history, self.observation_size, self.action_size)


@dataclass(frozen=True)
class LoadedPolicy:
    """A deterministic policy: call it with observations to get actions.

    With a `max_change` it remembers its last action, with a `history` its last observations and the actions between
    them. Then call it once a step, and `reset()` before each episode.
    """

    info: PolicyInfo
    layers: tuple[tuple[np.ndarray, np.ndarray], ...] = field(repr=False)
    """Weights [in, out] and bias [out] of every layer."""
    origin: np.ndarray | None = field(default=None, repr=False)
    """[S], float64: what its states are counted from, where that is not 0."""
    _last: dict[str, np.ndarray] = field(default_factory=dict, compare=False, repr=False)
    """The last `action`, where the next one depends on it; the last `state`, where that holds a history; and the action
    `taken` in it, once there is one."""

    def __call__(self, observation: Any) -> np.ndarray:
        """The action, within the policy's limits in [-1, 1], float32: [O] -> [A] or [B, O] -> [B, A].

        Raises `ValueError` as `unlimited` and `limited`.
        """
        return self.limited(self.unlimited(observation))

    def reset(self) -> None:
        """Begins an episode: `max_change` counts from 0, the middle of the range of actions; no history is left."""
        self._last.clear()

    def limited(self, action: Any) -> np.ndarray:
        """An action [A] or [B, A] of your own (`unlimited` plus noise, say), cut to the policy's limits.

        Remembers it as the last one, also for a history. Raises `ValueError` when its shape is another one or not the
        last one's, and when it is not finite.
        """
        wanted, before = _finite_actions(action, self.info.action_size, np.float32), self._last.get("action")
        if before is not None and before.shape != wanted.shape:
            expected, got = list(before.shape), list(wanted.shape)
            raise ValueError(f"action: expected shape {expected} as in the step before, got {got}; call reset() first")
        limited = Limits.of(self.info).within(wanted, before).astype(np.float32)
        if self.info.max_change is not None:
            self._last["action"] = limited.copy()  # the caller may write into theirs
        if self.info.history > 1:
            self._last["taken"] = limited.copy()
        return limited

    def unlimited(self, observation: Any) -> np.ndarray:
        """The action in [-1, 1] before the policy's limits, float32: [O] -> [A] or [B, O] -> [B, A].

        Keeps nothing; with a history, the observation: then call `limited` with the action that is executed, before the
        next observation. Raises `ValueError` when the observation has another shape, or is not finite in float32, and
        where a history lacks the action that led to it.
        """
        if self.info.history == 1:
            return self.of_state(observation)
        state = self._state(observation)
        action = self.of_state(state)
        self._last.pop("taken", None)
        self._last["state"] = state
        return action

    @property
    def _precision(self) -> type:
        """Of the states that it is given: an origin is subtracted before they are rounded."""
        return np.float32 if self.origin is None else np.float64

    def _state(self, observation: Any) -> np.ndarray:
        """The state [S] or [B, S] that an observation makes with what came before."""
        layout = self.info.layout
        observed = _as_batch(
            "observation", observation, layout.observation_size, self._precision, self.info.observation
        )
        before, action = self._last.get("state"), self._last.get("taken")
        if before is None:
            return layout.begin(observed)
        if before.shape[:-1] != observed.shape[:-1]:
            expected, got = [*before.shape[:-1], layout.observation_size], list(observed.shape)
            raise ValueError(f"observation: expected shape {expected} as in the step before, got {got}; reset() first")
        wanted = (*observed.shape[:-1], layout.action_size)
        if action is None or action.shape != wanted:
            came = "none" if action is None else f"one of {list(action.shape)}"
            raise ValueError(
                f"observation: expected an action of shape {list(wanted)} since the one before, got {came}; call "
                "limited(action) with the executed action, or reset() to begin an episode"
            )
        return layout.follow(before, action, observed)

    def of_state(self, state: Any) -> np.ndarray:
        """The action in [-1, 1] before the policy's limits, of a whole state (`metrpo.history`): [S] -> [A] or
        [B, S] -> [B, A]; keeps nothing. Without a history a state is an observation.

        Raises `ValueError` when the state has another shape, or is not finite in float32.
        """
        parts = self.info.observation if self.info.history == 1 else None
        hidden = _as_batch("observation", state, self.info.layout.state_size, self._precision, parts)
        if self.origin is not None:
            with np.errstate(over="ignore"):
                hidden = (hidden - self.origin).astype(np.float32)
        _require_finite("observation", hidden)
        for weights, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weights + bias)
        weights, bias = self.layers[-1]
        return np.clip(hidden @ weights + bias, -1.0, 1.0)

    def to_env(self, action: Any) -> np.ndarray:
        """An action in [-1, 1] in the environment's own units, within its bounds: [A] -> [A] or [B, A] -> [B, A].

        float32 where that holds the bounds exactly, else float64. Raises `ValueError` for other shapes, for NaN and
        infinity, and when the policy does not say the bounds, as older ones do not.
        """
        if self.info.action_low is None or self.info.action_high is None:
            raise ValueError(f"the policy for {brief(self.info.task)} does not say its environment's range of actions")
        low, high = np.array(self.info.action_low), np.array(self.info.action_high)
        part = 0.5 * (np.clip(_finite_actions(action, len(low), np.float64), -1.0, 1.0) + 1.0)
        scaled = np.clip((1.0 - part) * low + part * high, low, high)
        exact = np.array_equal(low, np.float32(low)) and np.array_equal(high, np.float32(high))
        return scaled.astype(np.float32 if exact else np.float64)


def _as_batch(
    name: str, value: Any, size: int, kind: type, parts: tuple[tuple[int, str], ...] | None = None
) -> np.ndarray:
    """Raises `ValueError` unless it is of shape [size] or [B, size]; the message says of which `parts`."""
    with np.errstate(over="ignore"):
        batch: np.ndarray = np.asarray(value, dtype=kind)
    if batch.ndim not in (1, 2) or batch.shape[-1] != size:
        made_of = f" ({'; '.join(f'{count}: {what}' for count, what in parts)})" if parts else ""
        raise ValueError(f"{name}: expected shape [{size}] or [B, {size}]{made_of}, got {list(batch.shape)}")
    return batch


def _finite_actions(action: Any, size: int, kind: type) -> np.ndarray:
    """Raises `ValueError` unless they are of shape [size] or [B, size], and finite."""
    batch = _as_batch("action", action, size, kind)
    _require_finite("action", batch)
    return batch


def _require_finite(name: str, batch: np.ndarray) -> None:
    if not np.isfinite(batch).all():
        at = np.argwhere(~np.isfinite(batch))[0]
        raise ValueError(f"{name}: expected finite numbers, got {batch[tuple(at)]} at {at.tolist()}")
