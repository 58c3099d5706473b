"""Policy x environment -> episodes: the only code that steps a real environment."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np

from metrpo.config import CollectConfig
from metrpo.errors import DivergedError, TaskError
from metrpo.types import Episode
from metrpo.world.guard import representable
from metrpo.world.task import Task

Act = Callable[[np.ndarray], np.ndarray]
"""State [S] -> action [A], not yet clipped."""
OnEpisode = Callable[[int], None]
"""Called after every episode with the steps so far."""


def collect(
    task: Task,
    draw_act: Callable[[np.random.Generator], Act],
    at_least: int,
    rng: np.random.Generator,
    on_episode: OnEpisode = lambda steps: None,
) -> list[Episode]:
    """Whole episodes of `at_least` steps together; `draw_act(rng)` acts in one episode and brings its own noise.

    `on_episode(steps so far)` follows every episode.
    """
    episodes: list[Episode] = []
    steps = 0
    with closing(play(task, draw_act, itertools.repeat(rng))) as played:
        while steps < at_least:
            episodes.append(next(played))
            steps += len(episodes[-1].rewards)
            on_episode(steps)
    return episodes


def play(
    task: Task, draw_act: Callable[[np.random.Generator], Act], rngs: Iterable[np.random.Generator]
) -> Generator[Episode]:
    """One whole episode for each of `rngs`, which decides its start and its noise; `draw_act(rng)` acts in it.

    Raises `TaskError` where the environment gives NaN or infinity, `DivergedError` where the policy gives NaN.
    """
    env = task.make_env()
    try:
        for rng in rngs:
            yield _episode(task.name, env, draw_act(rng), _seed(rng))
    finally:
        env.close()


def evaluate(task: Task, act: Act, episodes: int, seed: int) -> np.ndarray:
    """Real, undiscounted returns [episodes] of `act` without any noise, from seeded resets."""
    rng = np.random.default_rng(seed)
    env = task.make_env()
    try:
        return np.array(
            [_episode(task.name, env, act, _seed(rng)).rewards.sum(dtype=np.float64) for _ in range(episodes)]
        )
    finally:
        env.close()


def reset_states(task: Task, count: int, rng: np.random.Generator) -> np.ndarray:
    """States [count, S] of fresh resets (real interaction that nobody counts: `imagine.start = "reset"`)."""
    env = task.make_env()
    try:
        return np.array([_start(task.name, env, _seed(rng)) for _ in range(count)], np.float32)
    finally:
        env.close()


def explore(mean: Act, config: CollectConfig, rng: np.random.Generator) -> Act:
    """The paper's exploration (appendix A.1.1): `mean` plus std x N(0, I), std ~ U[0, max_std] per episode or step."""

    def stds() -> Iterator[float]:
        std = rng.uniform(0.0, config.max_std)
        while True:
            yield std
            if config.std_per == "step":
                std = rng.uniform(0.0, config.max_std)

    std = stds()

    def act(state: np.ndarray) -> np.ndarray:
        action = mean(state)
        return action + next(std) * rng.standard_normal(action.shape)

    return act


def _episode(name: str, env: gymnasium.Env, act: Act, seed: int) -> Episode:
    state = _start(name, env, seed)
    states, rewards = [state], []
    actions: list[np.ndarray] = []
    terminated = truncated = False
    while not (terminated or truncated):
        action = np.clip(act(state), -1.0, 1.0).astype(np.float32)
        if np.isnan(action).any():
            raise DivergedError(
                f"{name}: step {len(actions)} of an episode: expected numbers as action, got {action.tolist()}; "
                "the policy has diverged: go back to one from before, or start anew"
            )
        try:
            state, reward, terminated, truncated, _ = env.step(action)
        except TaskError as error:
            raise TaskError(f"{error} (at step {len(actions)} of an episode)") from error
        _require_numbers(f"{name}: step {len(actions)} of an episode", state, reward)
        states.append(state)
        actions.append(action)
        rewards.append(reward)
    return Episode(
        np.array(states, np.float32), np.array(actions, np.float32), np.array(rewards, np.float32), bool(terminated)
    )


def _start(name: str, env: gymnasium.Env, seed: int) -> np.ndarray:
    state: np.ndarray = env.reset(seed=seed)[0]
    _require_numbers(f"{name}: reset()", state, 0.0)
    return state


def _require_numbers(where: str, state: np.ndarray, reward: Any) -> None:
    """Not every environment is `Guarded`: those that are our own or have formulas may come as they are."""
    for what, value in (("observation", state), ("reward", reward)):
        if not representable(value):
            raise TaskError(
                f"{where}: expected finite numbers below 1.7e38 as {what}, got {value}; "
                "end the episode before the simulation diverges"
            )


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))
