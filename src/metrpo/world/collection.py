"""Policy x environment -> episodes: the only code that steps a real environment."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from metrpo.config import CollectConfig
from metrpo.counting import counted
from metrpo.errors import DivergedError, EpisodeError, NotFiniteError, TaskError, UnplayableError
from metrpo.types import Episode
from metrpo.world import env_returns
from metrpo.world.env_returns import representable
from metrpo.world.task import Task

Act = Callable[[np.ndarray], np.ndarray]
"""State [S] -> action [A], not yet clipped."""
OnEpisode = Callable[[int], None]
"""Called after every episode with the steps so far."""
MOST_FAILURES = 10
"""Episodes of one collection, or resets, that may fail and are left out."""

_log = logging.getLogger("metrpo")


def collect(
    task: Task,
    draw_act: Callable[[np.random.Generator], Act],
    at_least: int,
    rng: np.random.Generator,
    on_episode: OnEpisode = lambda steps: None,
    longest: int | None = None,
    at_most: float = math.inf,
) -> list[Episode]:
    """Plays whole episodes until they have `at_least` steps in all; `draw_act(rng)` acts in one, with noise.

    An episode is cut after `longest` steps, and where all episodes reach `at_most` steps. An episode in which the
    environment gives NaN or infinity is left out, with a warning; after every other one, `on_episode(steps so far)` is
    called.

    Raises `UnplayableError` when more than `MOST_FAILURES` are left out, `TaskError` as `play`.
    """
    episodes: list[Episode] = []
    steps = failed = 0
    while steps < at_least:
        try:
            with closing(play(task, draw_act, itertools.repeat(rng), longest, at_most=at_most - steps)) as played:
                while steps < at_least:
                    episodes.append(next(played))
                    steps += len(episodes[-1].rewards)
                    on_episode(steps)
        except NotFiniteError as error:
            failed += 1
            leave_out(failed, error)
    return episodes


def leave_out(failed: int, error: EpisodeError) -> None:
    """Warns that an episode, the `failed`-th of its collection, is left out.

    Raises `UnplayableError` when there have been too many.
    """
    if failed > MOST_FAILURES:
        text = f"{error}. {MOST_FAILURES} episodes before it failed too: repair the environment, then resume"
        raise UnplayableError(text) from error
    _log.warning("%s; this episode is left out (%d of at most %d)", error, failed, MOST_FAILURES)


def play(
    task: Task,
    draw_act: Callable[[np.random.Generator], Act],
    rngs: Iterable[np.random.Generator],
    longest: int | None = None,
    on_step: Callable[[], None] = lambda: None,
    at_most: float = math.inf,
) -> Generator[Episode]:
    """One whole episode for each of `rngs`, which decides its start and its noise; `draw_act(rng)` acts in it.

    An episode of more than `longest` steps is cut there, as by the clock. So is the one that reaches `at_most` steps of
    all together, and none follows it. `on_step` is called at every step.

    Raises `EpisodeError` where the environment fails or breaks its promise (`NotFiniteError` where it gives NaN or
    infinity), `TaskError` where the policy is another task's, `DivergedError` where it gives NaN.
    """
    with env_returns.closing(task.make_env(), task.name) as env:
        for rng in rngs:
            longest_now = int(min(task.horizon if longest is None else longest, at_most))
            episode = _episode(task, env, draw_act(rng), seed_of(rng), longest_now, on_step)
            at_most -= len(episode.rewards)
            yield episode
            if at_most <= 0:
                return


def evaluate(
    task: Task, act: Act, episodes: int, seed: int, at_most: int | None = None, longest: int | None = None
) -> np.ndarray:
    """Real, undiscounted returns [episodes] of `act` without any noise, from seeded resets.

    Fewer where the first ones have `at_most` steps together. Episodes of more than `longest` steps are cut there.
    """
    rng = np.random.default_rng(seed)
    returns, steps = list[float](), 0
    with env_returns.closing(task.make_env(), task.name) as env:
        while len(returns) < episodes and (at_most is None or steps < at_most):
            rewards = _episode(task, env, act, seed_of(rng), longest).rewards
            returns.append(rewards.sum(dtype=np.float64))
            steps += len(rewards)
    return np.array(returns)


def reset_states(task: Task, count: int, rng: np.random.Generator) -> np.ndarray:
    """States [count, S], float64, of fresh resets (real interaction that nobody counts: `imagine.start = "reset"`).

    Resets that give NaN or infinity are left out, as in `collect`.
    """
    states, failed = list[np.ndarray](), 0
    with env_returns.closing(task.make_env(), task.name) as env:
        while len(states) < count:
            try:
                states.append(_start(task, env, seed_of(rng)))
            except NotFiniteError as error:
                failed += 1
                leave_out(failed, error)
    return np.array(states, np.float64)


def explore(mean: Act, config: CollectConfig, rng: np.random.Generator) -> Act:
    """`mean` plus std x noise, std = max_std x U[0, 1] ** std_power per episode or step.

    The noise is `correlated`. The paper (appendix A.1.1) has the power 1 and no correlation.
    """

    def draw() -> float:
        return config.max_std * rng.uniform() ** config.std_power

    def stds() -> Iterator[float]:
        std = draw()
        while True:
            yield std
            if config.std_per == "step":
                std = draw()

    std, noise = stds(), correlated(config.noise_correlation, rng)

    def act(state: np.ndarray) -> np.ndarray:
        action, width = mean(state), next(std)  # drawn before the noise
        return action + width * noise(action.shape)

    return act


def correlated(correlation: float, rng: np.random.Generator) -> Callable[[tuple[int, ...]], np.ndarray]:
    """Noise for the steps of an episode, an array N(0, I) of the given shape for each.

    It is correlated with that of the step before: a first-order autoregressive process.
    """
    last = list[np.ndarray]()

    def step(shape: tuple[int, ...]) -> np.ndarray:
        noise = rng.standard_normal(shape)
        if last:
            noise = correlation * last.pop() + math.sqrt(1 - correlation**2) * noise
        last.append(noise)
        return noise

    return step


def _episode(
    task: Task,
    env: gymnasium.Env,
    act: Act,
    seed: int,
    longest: int | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Episode:
    state = _start(task, env, seed)
    states, rewards = [state], list[float]()
    actions: list[np.ndarray] = []
    before: np.ndarray | None = None
    terminated = truncated = False
    longest = task.horizon if longest is None else min(longest, task.horizon)
    while not (terminated or truncated) and len(actions) < longest:
        on_step()
        where = f"step {len(actions)} of an episode"
        action = before = action_of(task, act(state), where, before)
        with _of_episode(f" (at {where})"):
            observation, reward, terminated, truncated, _ = env_returns.after_step(task.name, partial(env.step, action))
        state = _numbers(task, where, observation, reward)
        states.append(state)
        actions.append(action)
        rewards.append(reward)
    return Episode(
        np.array(states, np.float64), np.array(actions, np.float32), np.array(rewards, np.float32), terminated
    )


def action_of(task: Task, output: np.ndarray, where: str, before: np.ndarray | None = None) -> np.ndarray:
    """The action [A], within the task's limits, from a policy's `output` after the action `before`.

    Raises `TaskError` when its size is another than the task's, `DivergedError` when it holds NaN.
    """
    array = env_returns.array_of(output)
    if array is None or array.size != task.action_size or array.ndim > 1:
        got = f"{output!r}" if array is None else f"shape {list(array.shape)}"
        raise TaskError(
            f"{task.name}: {where}: expected an action of {counted(task.action_size, 'number')}, got {got}; use a "
            "policy that was made for this task"
        )
    action = task.limits.within(array.reshape(task.action_size), before).astype(np.float32)
    if np.isnan(action).any():
        raise DivergedError(
            f"{task.name}: {where}: expected numbers as action, got {action.tolist()}; "
            "the policy has diverged: use an earlier one, or start anew"
        )
    return action


@contextmanager
def _of_episode(where: str = "") -> Iterator[None]:
    """Turns an error of the environment into an `EpisodeError` that says `where`."""
    try:
        yield
    except TaskError as error:
        kind = type(error) if isinstance(error, EpisodeError) else EpisodeError
        raise kind(f"{error}{where}") from error


def _start(task: Task, env: gymnasium.Env, seed: int) -> np.ndarray:
    with _of_episode():
        observation, _ = env_returns.after_reset(task.name, partial(env.reset, seed=seed))
    return _numbers(task, "reset()", observation, 0.0)


def _numbers(task: Task, where: str, observation: Any, reward: float) -> np.ndarray:
    """The observation as a state [S]. (A `Task`'s own environment may not be `Guarded`.)"""
    state = env_returns.array_of(observation)
    if state is None or state.shape != (task.state_size,):
        got = observation if state is None else f"shape {list(state.shape)}"
        advice = "return an array of that many numbers, or create the task with metrpo.task_of, which flattens others"
        expected = f"an observation of {counted(task.state_size, 'number')}"
        raise env_returns.broken(task.name, where, expected, got, advice, EpisodeError)
    for what, value in (("observation", state), ("reward", reward)):
        if not representable(value):
            raise NotFiniteError(
                f"{task.name}: {where}: expected finite numbers below 1.7e38 as {what}, got {value}; "
                "end the episode before the simulation diverges"
            )
    return state


def seed_of(rng: np.random.Generator) -> int:
    """The seed of an episode's reset."""
    return int(rng.integers(2**31))
