"""Real episodes out of a Minari dataset (the Farama Foundation's offline datasets; extra `minari`)."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from gymnasium.spaces import Box, flatten

from metrpo.counting import counted
from metrpo.errors import TaskError
from metrpo.types import Episode
from metrpo.world.task import Task

PREFIX = "minari:"


def load(name: str, task: Task) -> list[Episode]:
    """The episodes, of observations, of the dataset `minari:NAME`, downloaded where it is not on this machine.

    Observations are flattened, actions rescaled from the dataset's bounds to [-1, 1]. Raises `TaskError` when Minari is
    missing, there is no such dataset, or it does not fit the task.
    """
    try:
        minari = importlib.import_module("minari")
    except ImportError as error:
        raise TaskError(f"{name}: needs Minari: pip install 'metrpo[minari]'") from error
    try:
        dataset = minari.load_dataset(name.removeprefix(PREFIX), download=True)
        found = list(dataset.iterate_episodes())
    except Exception as error:
        raise TaskError(
            f"{name}: expected a data set's full name, such as minari:D4RL/door/human-v2; see: minari list remote "
            f"({type(error).__name__}: {error})"
        ) from error
    bounds = dataset.action_space
    if not (isinstance(bounds, Box) and np.isfinite(bounds.low).all() and np.isfinite(bounds.high).all()):
        raise TaskError(f"{name}: expected a Box of actions with finite bounds, got {bounds}")
    episodes = [_episode(e, dataset.observation_space, bounds) for e in found if len(e.rewards)]
    if not episodes:
        raise TaskError(f"{name}: expected transitions, got none")
    for what, expected, rows in (
        ("observations", task.observation_size, episodes[0].states),
        ("actions", task.action_size, episodes[0].actions),
    ):
        if rows.shape[1] != expected:
            raise TaskError(
                f"{name}: {what}: expected {counted(expected, 'number')} for {task.name}, got {rows.shape[1]}"
            )
    for number, episode in enumerate(episodes):
        if not all(np.isfinite(rows).all() for rows in episode[:3]):
            raise TaskError(f"{name}: episode {number}: expected finite numbers, got some that are not")
    return episodes


def _episode(episode: Any, space: Any, bounds: Box) -> Episode:
    steps = len(episode.rewards)
    if isinstance(space, Box):
        states = np.reshape(episode.observations, (steps + 1, -1))
    else:  # a dict or tuple of arrays, step by step
        states = np.array([flatten(space, _at(episode.observations, t)) for t in range(steps + 1)])
    low, high = bounds.low.ravel(), bounds.high.ravel()
    actions = 2 * (np.reshape(episode.actions, (steps, -1)) - low) / (high - low) - 1
    return Episode(
        states.astype(np.float64),
        np.clip(actions, -1, 1).astype(np.float32),
        np.asarray(episode.rewards, np.float32),
        bool(episode.terminations[-1]),
    )


def _at(observations: Any, t: int) -> Any:
    if isinstance(observations, dict):
        return {name: _at(inner, t) for name, inner in observations.items()}
    if isinstance(observations, tuple):
        return tuple(_at(inner, t) for inner in observations)
    return observations[t]
