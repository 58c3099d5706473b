"""Many real episodes at a time: one call of the policy for all of them, and threads for the physics.

For the paper's tasks; others are played one after another (`metrpo.world.collection`). The episodes are the same: each
has its own seed, the physics of each its own memory (the solver's warm start included), and which episodes are played
does not depend on how many run at a time.

`mujoco.rollout` would not do with a policy in the loop: it hands out neither the solver's warm start, without which the
next call computes other contacts, nor the centre of mass after a step, but before it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import NamedTuple

import numpy as np

from metrpo.errors import EpisodeError
from metrpo.types import Episode
from metrpo.world import collection
from metrpo.world.task import Task
from metrpo.world.tasks.rllab.bodies import is_robot
from metrpo.world.tasks.rllab.environment import MujocoTask

ActAll = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(states [n, S], numbers of their episodes [n], steps of these so far [n]) -> actions [n, A], not yet clipped."""

SLOTS = 64
"""Episodes at a time: a call of the policy costs little more than for one, and their simulations stay in the cache."""


class Stepped(NamedTuple):
    """What one step of n episodes gave."""

    states: np.ndarray
    """[n, S]"""
    rewards: np.ndarray
    """[n]"""
    terminated: np.ndarray
    """[n] of bool"""


class SideBySide:
    """Simulations of one of the paper's tasks that share its model; equal to its environment step by step."""

    def __init__(self, task: Task, threads: int) -> None:
        self._envs = [MujocoTask(task.name)]
        self._task = self._envs[0].task
        self._states = np.zeros((SLOTS, task.state_size))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._threads = threads

    def reset(self, slot: int, seed: int) -> np.ndarray:
        """A fresh episode there: its start state [S]."""
        while slot >= len(self._envs):
            self._envs.append(MujocoTask(self._task.name, model=self._envs[0].model))
        self._states[slot] = self._envs[slot].reset(seed=seed)[0]
        return self._states[slot].copy()

    def step(self, slots: Sequence[int], actions: np.ndarray, steps: np.ndarray) -> Stepped:
        """One step of the episodes in `slots`, with actions [n, A] in [-1, 1]; `steps` [n] are behind them.

        Raises `EpisodeError` when a simulation diverges.
        """
        rows, actions = np.asarray(slots), actions.astype(np.float64)
        before, controls = self._states[rows], self._envs[0].controls(actions)

        def advance(part: np.ndarray) -> None:
            for i in part:
                self._states[rows[i]] = self._envs[rows[i]].advance(controls[i])

        parts = np.array_split(np.arange(len(rows)), min(self._threads, len(rows)))
        for _ in map(advance, parts) if self._pool is None else self._pool.map(advance, parts):
            pass
        after = self._states[rows]
        if not np.isfinite(after).all():
            step = int(steps[np.flatnonzero(~np.isfinite(after).all(axis=1))[0]])
            raise EpisodeError(f"{self._task.name}: the simulation diverged (at step {step} of an episode)")
        assert self._task.reward is not None
        rewards, ends = self._task.reward(before, actions, after), self._task.terminated
        return Stepped(after, rewards, ends(after) if callable(ends) else np.zeros(len(rows), bool))

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown()


def applies(task: Task) -> bool:
    """Whether a task's episodes can be played side by side: the paper's, in the environment that metrpo gives them."""
    return task.make is None and task.env_id == f"metrpo/{task.name}-v0" and is_robot(task.name)


class _Running:
    """An episode under way, of at most `longest` steps."""

    def __init__(self, number: int, state: np.ndarray, longest: int) -> None:
        self.number, self.states, self.longest = number, [state], longest
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []

    def finished(self, terminated: bool) -> Episode:
        actions, rewards = (np.array(x, np.float32) for x in (self.actions, self.rewards))
        return Episode(np.array(self.states, np.float64), actions, rewards, terminated)


def play(
    task: Task,
    act: ActAll,
    seeds: Iterator[int],
    at_least: float = math.inf,
    longest: int | None = None,
    on_steps: Callable[[int], None] = lambda steps: None,
    at_most: float = math.inf,
) -> list[Episode]:
    """Whole episodes from resets by `seeds`, until they have `at_least` steps together or the seeds are used up.

    The very episodes that playing one after another would give, in the order of their seeds: another one begins only
    when those before it cannot have enough steps. An episode of more than `longest` steps is cut there, and one that
    begins where fewer than that remain of `at_most` steps of all together, after those. `on_steps(steps so far)`
    follows every step. As many threads as there are cores share the physics.

    Raises `EpisodeError` where a simulation diverges, `TaskError` where the policy is another task's, `DivergedError`
    where it gives NaN.
    """
    horizon = task.horizon if longest is None else min(longest, task.horizon)
    ended: dict[int, Episode] = {}
    running: dict[int, _Running] = {}
    free = list(range(SLOTS))[::-1]
    steps = begun = 0
    with closing(SideBySide(task, _cores())) as slots:
        while True:
            while free and (taken := steps + _left(running)) < min(at_least, at_most):
                if (seed := next(seeds, None)) is None:
                    break
                slot = free.pop()
                most = int(min(horizon, at_most - taken))
                running[slot], begun = _Running(begun, slots.reset(slot, seed), most), begun + 1
            if not running:
                return [ended[number] for number in range(begun)]
            for slot, terminated in _advance(task, slots, running, act):
                episode = running.pop(slot)
                ended[episode.number] = episode.finished(terminated)
                free.append(slot)
            steps = sum(len(e.rewards) for e in ended.values()) + sum(len(r.rewards) for r in running.values())
            on_steps(steps)


def _left(running: dict[int, _Running]) -> int:
    """Steps that the episodes under way may still have."""
    return sum(r.longest - len(r.rewards) for r in running.values())


def _advance(task: Task, slots: SideBySide, running: dict[int, _Running], act: ActAll) -> list[tuple[int, bool]]:
    """One step of every episode under way; those that ended by it, and whether the task ended them."""
    order, now = list(running), list(running.values())
    steps = np.array([len(r.rewards) for r in now])
    actions = act(np.array([r.states[-1] for r in now]), np.array([r.number for r in now]), steps)
    if actions.shape != (len(now), task.action_size) or np.isnan(actions).any():
        for action, step in zip(actions, steps, strict=True):
            collection.action_of(task, action, f"step {step} of an episode")  # raises
    actions = task.limits.within(actions, _before(task, now)).astype(np.float32)
    got = slots.step(order, actions, steps)
    for i, r in enumerate(now):
        r.states.append(got.states[i])
        r.actions.append(actions[i])
        r.rewards.append(float(got.rewards[i]))
    over = got.terminated | (steps + 1 >= np.array([r.longest for r in now]))
    return [(slot, bool(got.terminated[i])) for i, slot in enumerate(order) if over[i]]


def _before(task: Task, now: list[_Running]) -> np.ndarray | None:
    """The last actions of the episodes under way, [n, A]; None where they do not matter."""
    if task.limits.max_change is None:
        return None
    return np.array([r.actions[-1] if r.actions else np.zeros(task.action_size, np.float32) for r in now])


def evaluate(
    task: Task, act: collection.Act, episodes: int, seed: int, at_most: int | None = None, longest: int | None = None
) -> np.ndarray:
    """`collection.evaluate` for an `act` that takes many states at once, [n, S] -> [n, A]: the same returns, sooner."""
    if not applies(task):
        return collection.evaluate(task, act, episodes, seed, at_most, longest)
    rng = np.random.default_rng(seed)
    seeds = (collection.seed_of(rng) for _ in range(episodes))
    played = play(task, lambda states, numbers, steps: act(states), seeds, at_most or math.inf, longest)
    return np.array([e.rewards.sum(dtype=np.float64) for e in played])


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
