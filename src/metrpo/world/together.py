"""Many real episodes of the paper's tasks at a time: one call of the policy for all, and threads for the physics.

They are the episodes that one after another gives: each has its own seed, the physics of each its own memory (the
solver's warm start included), and which episodes are played does not depend on how many run at a time.

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

import gymnasium
import numpy as np

from metrpo.errors import DivergedError, TaskError
from metrpo.types import Episode
from metrpo.world import mujoco
from metrpo.world.task import Task

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
    truncated: np.ndarray
    """[n] of bool"""


class SideBySide:
    """Simulations of one of the paper's tasks that share its model; equal to its environment step by step."""

    def __init__(self, task: Task, count: int, threads: int) -> None:
        self._envs = [mujoco.MujocoTask(task.name)]
        self._task, self._limit = self._envs[0].task, time_limit(task)
        self._states = np.zeros((count, task.state_size))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._threads = threads
        self.count = count

    def reset(self, slot: int, seed: int) -> np.ndarray:
        """A fresh episode in `slot`: its start state [S]."""
        while slot >= len(self._envs):
            self._envs.append(mujoco.MujocoTask(self._task.name, model=self._envs[0].model))
        self._states[slot] = self._envs[slot].reset(seed=seed)[0]
        return self._states[slot].copy()

    def step(self, slots: Sequence[int], actions: np.ndarray, steps: np.ndarray) -> Stepped:
        """One step of the episodes in `slots`, with actions [n, A] in [-1, 1]; `steps` [n] are behind them."""
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
            raise TaskError(f"{self._task.name}: the simulation diverged (at step {step} of an episode)")
        assert self._task.reward is not None
        rewards, ends = self._task.reward(before, actions, after), self._task.terminated
        terminated = ends(after) if callable(ends) else np.zeros(len(rows), bool)
        return Stepped(after, rewards, terminated, steps + 1 >= self._limit)

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown()


def applies(task: Task) -> bool:
    """Whether the task is one of the paper's, which alone can be played so."""
    return task.make is None and task.env_id == f"metrpo/{task.name}-v0" and mujoco.is_robot(task.name)


def time_limit(task: Task) -> int:
    """Steps after which the task's environment cuts an episode off."""
    assert task.env_id is not None
    return gymnasium.spec(task.env_id).max_episode_steps or task.horizon


class _Running:
    """An episode under way."""

    def __init__(self, number: int, state: np.ndarray) -> None:
        self.number, self.states = number, [state]
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
    on_steps: Callable[[int], None] = lambda steps: None,
    threads: int | None = None,
) -> list[Episode]:
    """Whole episodes from resets by `seeds`, until they have `at_least` steps together or the seeds are used up.

    The very episodes that playing one after another would give, in the order of their seeds: another one begins only
    when those before it cannot have enough steps. `on_steps(steps so far)` follows every step.

    Raises `TaskError` where the environment gives NaN or infinity, `DivergedError` where the policy gives NaN.
    """
    horizon = task.horizon
    ended: dict[int, Episode] = {}
    with closing(SideBySide(task, SLOTS, threads or _cores())) as slots:
        running: dict[int, _Running] = {}
        free = list(range(slots.count))[::-1]
        steps = begun = 0
        while True:
            while free and steps + _left(running, horizon) < at_least and (seed := next(seeds, None)) is not None:
                slot = free.pop()
                running[slot], begun = _Running(begun, slots.reset(slot, seed)), begun + 1
            if not running:
                return [ended[number] for number in range(begun)]
            for slot, terminated in _advance(task.name, slots, running, act):
                episode = running.pop(slot)
                ended[episode.number] = episode.finished(terminated)
                free.append(slot)
            steps = sum(len(e.rewards) for e in ended.values()) + sum(len(r.rewards) for r in running.values())
            on_steps(steps)


def _left(running: dict[int, _Running], horizon: int) -> int:
    """Steps that the episodes under way may still have."""
    return sum(horizon - len(r.rewards) for r in running.values())


def _advance(name: str, slots: SideBySide, running: dict[int, _Running], act: ActAll) -> list[tuple[int, bool]]:
    """One step of every episode under way; those that ended by it, and whether the task ended them."""
    order, now = list(running), list(running.values())
    steps = np.array([len(r.rewards) for r in now])
    states = np.array([r.states[-1] for r in now])
    drawn = act(states, np.array([r.number for r in now]), steps)
    if np.isnan(drawn).any():
        first = int(np.flatnonzero(np.isnan(drawn).any(axis=1))[0])
        raise DivergedError(
            f"{name}: step {steps[first]} of an episode: expected numbers as action, got {drawn[first].tolist()}; "
            "the policy has diverged: go back to one from before, or start anew"
        )
    actions = np.clip(drawn, -1.0, 1.0).astype(np.float32)
    got = slots.step(order, actions, steps)
    for i, r in enumerate(now):
        r.states.append(got.states[i])
        r.actions.append(actions[i])
        r.rewards.append(float(got.rewards[i]))
    over = got.terminated | got.truncated
    return [(slot, bool(got.terminated[i])) for i, slot in enumerate(order) if over[i]]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
