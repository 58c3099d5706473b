"""Real episodes of a stochastic policy, with the actions as it drew them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np

from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.types import Episode
from metrpo.world import batch_episodes
from metrpo.world import collection as real
from metrpo.world.collection import seed_of
from metrpo.world.task import Task


class Drawn(NamedTuple):
    """Real episodes and what the policy drew in them."""

    episodes: list[Episode]
    actions: list[np.ndarray]
    """[L, A] of each episode, before clipping: log-probabilities are of these."""


def collect(
    task: Task,
    policy: Policy,
    at_least: int,
    rng: np.random.Generator,
    on_episode: real.OnEpisode = lambda steps: None,
    longest: int | None = None,
    at_most: float = math.inf,
) -> Drawn:
    """Whole episodes of `at_least` steps together, acting by samples of `policy` (see `world.collection.collect`).

    The paper's tasks are played many episodes at a time (`world.batch_episodes`), each with noise of its own.
    No step is played beyond `at_most` of all together.
    """
    if batch_episodes.applies(task):
        return _together(task, policy, at_least, rng, on_episode, longest, at_most)
    host = jax.tree.map(np.asarray, policy)
    std, drawn, actions = np.exp(host.log_std), list[list[np.ndarray]](), list[np.ndarray]()

    def draw_act(rng: np.random.Generator) -> real.Act:
        nonlocal actions
        actions = []

        def act(state: np.ndarray) -> np.ndarray:
            actions.append(gaussian.mean(host, state) + std * rng.standard_normal(len(std)))
            return actions[-1]

        return act

    def keep(steps: int) -> None:  # an episode that fails is left out
        drawn.append(actions)
        on_episode(steps)

    episodes = real.collect(task, draw_act, at_least, rng, keep, longest, at_most)
    return Drawn(episodes, [np.array(actions, np.float32) for actions in drawn])


def _together(
    task: Task,
    policy: Policy,
    at_least: int,
    rng: np.random.Generator,
    on_steps: Callable[[int], None],
    longest: int | None,
    at_most: float,
) -> Drawn:
    host = jax.tree.map(np.asarray, policy)
    std, noise, drawn = np.exp(host.log_std), list[np.ndarray](), list[np.ndarray]()

    def seeds() -> Iterator[int]:
        while True:
            noise.append(std * np.random.default_rng(seed_of(rng)).standard_normal((task.horizon, len(std))))
            drawn.append(np.empty((task.horizon, len(std)), np.float32))
            yield seed_of(rng)

    def act(states: np.ndarray, numbers: np.ndarray, steps: np.ndarray) -> np.ndarray:
        actions = gaussian.mean(host, states)
        for i, (number, step) in enumerate(zip(numbers, steps, strict=True)):
            actions[i] += noise[number][step]
            drawn[number][step] = actions[i]
        return actions

    episodes = batch_episodes.play(task, act, seeds(), at_least, longest, on_steps, at_most=at_most)
    return Drawn(episodes, [actions[: len(e.rewards)] for actions, e in zip(drawn, episodes, strict=True)])
