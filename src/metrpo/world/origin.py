"""Where states are counted from, so that an offset of an observation does not use up the digits that it varies in.

All that is learned computes in float32, which has seven digits: of 100,000,000.5 the half is lost. Real states are kept
in float64; models and policy see them less an origin, which the first data decide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import numpy as np

from metrpo.types import Array
from metrpo.world.task import Task

FAR = 100.0
"""Standard deviations from 0 beyond which a dimension is counted from its mean. Usual observations lie within."""


def origin_of(states: np.ndarray) -> np.ndarray:
    """The origin [S], float64, for `states` [n, S]: their mean in dimensions that lie far from 0, else 0.

    What does not vary keeps 0: it has no digits to lose.
    """
    exact = np.asarray(states, np.float64)
    mean, std = exact.mean(axis=0), exact.std(axis=0)
    varies = exact.max(axis=0) > exact.min(axis=0)
    return np.where(varies & (np.abs(mean) > FAR * std), mean, 0.0)


def relative(states: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Real `states` [..., S] counted from `origin` [S], in float64; where it is 0 throughout, as they are."""
    return np.asarray(states, np.float64) - origin if origin.any() else states


def of_real(act: Callable[[np.ndarray], np.ndarray], origin: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """`act`, which takes states counted from `origin`, for states as the environment gives them."""
    return lambda state: act(relative(state, origin))


def shifted(task: Task, origin: np.ndarray) -> Task:
    """The task for states counted from `origin`; the same object every time, for compiled code knows it by that."""
    return _shifted(task, tuple(origin.tolist())) if origin.any() else task


@cache
def _shifted(task: Task, origin: tuple[float, ...]) -> Task:
    """The task whose formulas get real states, in float64: float32 could not hold them."""
    import jax  # for imagination only: nothing else of the real side needs it

    reward, terminated = task.reward, task.terminated
    offset = np.array(origin)

    def rewarded(states: Array, actions: Array, following: Array) -> Array:
        assert reward is not None
        with jax.enable_x64(True):
            before, after = (x.astype("float64") + offset for x in (states, following))
            return reward(before, actions, after).astype("float32")

    def ended(following: Array) -> Array:
        assert callable(terminated)
        with jax.enable_x64(True):
            return terminated(following.astype("float64") + offset)

    return dataclasses.replace(
        task,
        reward=None if reward is None else rewarded,
        terminated=ended if callable(terminated) else terminated,
    )
