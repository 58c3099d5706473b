"""Formulas held against the environment before anything is learned from them."""

from __future__ import annotations

import numpy as np

from metrpo.errors import TaskError
from metrpo.types import Episode
from metrpo.world import collection as real
from metrpo.world.task import Task

STEPS = 1000
"""Real steps that the check takes, with random actions."""
TOLERANCE = 1e-3
"""Of 1 + |reward|: states are kept in float32."""
_ADVICE = "Correct it, or learn it from data with --learn-reward; --trust-reward trains with it as it is"


def check_formulas(task: Task, rng: np.random.Generator) -> None:
    """Holds the task's reward and termination, where they are formulas, against `STEPS` real steps.

    Raises `TaskError` with the largest difference, where it is and what was given when they do not agree.
    """
    if task.reward is None and not callable(task.terminated):
        return
    episodes = real.collect(
        task, lambda rng: lambda state: rng.uniform(-1.0, 1.0, task.action_size), STEPS, rng, longest=STEPS
    )
    if task.reward is not None:
        _check_rewards(task, episodes)
    if callable(task.terminated):
        _check_ends(task, episodes)


def _check_rewards(task: Task, episodes: list[Episode]) -> None:
    newest = task.layout.newest
    paid = np.concatenate([e.rewards for e in episodes]).astype(np.float64)
    states, actions, following = _transitions(episodes)
    assert task.reward is not None
    said = np.asarray(task.reward(states, actions, following))
    if said.shape != paid.shape:
        raise TaskError(
            f"{task.name}: reward(s, a, s') of {list(states.shape)} states: expected shape {list(paid.shape)}, got "
            f"{list(said.shape)}; sum over the last axis (axis=-1) and index states as s[..., i]"
        )
    off = np.abs(said - paid)
    off = np.where(np.isfinite(off), off, np.inf)
    if np.any(off > TOLERANCE * (1 + np.abs(paid)) + task.reward_error):
        at = int(np.argmax(off))
        raise TaskError(
            f"{task.name}: the reward formula disagrees with the environment: of {len(paid)} random transitions the "
            f"largest difference is {off[at]:.4g} at number {at}, where the environment paid {paid[at]:.6g} and the "
            f"formula says {said[at]:.6g}; s = {_row(newest(states[at]))}, a = {_row(actions[at])} (in [-1, 1]), "
            f"s' = {_row(newest(following[at]))}. {_ADVICE}"
        )


def _check_ends(task: Task, episodes: list[Episode]) -> None:
    assert callable(task.terminated)
    following = _transitions(episodes)[2]
    said = np.asarray(task.terminated(following)).astype(bool)
    ended = np.concatenate([np.append(np.zeros(len(e.rewards) - 1, bool), e.terminated) for e in episodes])
    if said.shape != ended.shape or np.any(said != ended):
        at = int(np.argmax(said != ended)) if said.shape == ended.shape else 0
        raise TaskError(
            f"{task.name}: the termination formula disagrees with the environment: at random transition {at} of "
            f"{len(ended)} the environment {'ended' if ended[at] else 'did not end'} the episode, the formula says "
            f"otherwise; s' = {_row(task.layout.newest(following[at]))}. {_ADVICE}"
        )


def _transitions(episodes: list[Episode]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        np.concatenate([e.states[:-1] for e in episodes]),
        np.concatenate([e.actions for e in episodes]),
        np.concatenate([e.states[1:] for e in episodes]),
    )


def _row(values: np.ndarray) -> str:
    return np.array2string(values, precision=4, max_line_width=10_000, threshold=12)
