"""Many episodes at a time are the episodes that one after another gives."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

import probe
from helpers import random_policy
from metrpo.baselines import on_policy
from metrpo.errors import DivergedError, TaskError
from metrpo.world import mujoco, together
from metrpo.world.registry import get_task

NAMES = ["Swimmer", "Snake", "Hopper", "HopperUpright", "HalfCheetah", "Ant", "Humanoid", "HumanoidStandup"]


def one_by_one(task):
    """The task through its Gymnasium environment."""
    return dataclasses.replace(task, make=dataclasses.replace(task).make_env)


def noisy(task, std=1.0):
    """Acts at random, each episode by noise of its own."""
    rows = {}

    def act(states, numbers, steps):
        for number in map(int, numbers):
            if number not in rows:
                rows[number] = std * np.random.default_rng(number).standard_normal((task.horizon, task.action_size))
        return np.array([rows[n][t] for n, t in zip(numbers, steps, strict=True)])

    return act


@pytest.mark.parametrize("name", NAMES)
def test_side_by_side_is_the_environment_step_by_step(name):
    """Same states, rewards and ends to the last bit, contacts and their solver's warm start included."""
    task = get_task(name)
    assert together.applies(task)
    episodes = together.play(task, noisy(task), iter(range(3)), threads=2)
    assert len(episodes) == 3
    for seed, episode in enumerate(episodes):
        env = task.make_env()
        states, rewards = [env.reset(seed=seed)[0]], []
        for t, action in enumerate(episode.actions):
            state, reward, terminated, truncated, _ = env.step(action)
            states.append(state)
            rewards.append(reward)
            assert (terminated or truncated) == (t == len(episode.actions) - 1)
        env.close()
        assert terminated == episode.terminated
        np.testing.assert_array_equal(episode.states, np.array(states))
        np.testing.assert_array_equal(episode.rewards, np.array(rewards, np.float32))


@pytest.mark.parametrize("slots", [1, 3])
@pytest.mark.parametrize("at_least", [1, 100, 130, 450])
def test_as_many_episodes_as_one_after_another(monkeypatch, slots, at_least):
    """Ant's end early: the next begins when those before it cannot have enough steps, and none is left unfinished."""
    task = get_task("Ant")
    many = together.play(task, noisy(task, 3.0), itertools.count(7), at_least)
    monkeypatch.setattr(together, "SLOTS", slots)
    few = together.play(task, noisy(task, 3.0), itertools.count(7), at_least)
    assert len({e.terminated for e in many}) == 2 or at_least < 450, "the case must have early ends and late ones"
    assert sum(len(e.rewards) for e in many[:-1]) < at_least <= sum(len(e.rewards) for e in many)
    assert len(few) == len(many)
    for a, b in zip(few, many, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_drawn_episodes_do_not_depend_on_how_many_run_at_a_time(monkeypatch):
    task, policy = get_task("Ant"), random_policy(0, 29, 8, std=1.0)
    many = on_policy.collect(task, policy, 400, np.random.default_rng(3))
    monkeypatch.setattr(together, "SLOTS", 2)
    few = on_policy.collect(task, policy, 400, np.random.default_rng(3))
    assert len(few.episodes) == len(many.episodes) >= 4
    for a, b in zip(many.episodes, few.episodes, strict=True):
        np.testing.assert_allclose(a.states, b.states, atol=1e-5)
    for x, y in zip(many.actions, few.actions, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
    assert len({e.states[0].tobytes() for e in many.episodes}) == len(many.episodes)
    first = [np.float32(a[0]) for a in many.actions]
    assert len({a.tobytes() for a in first}) == len(first), "every episode has noise of its own"


def test_any_other_environment_is_played_one_by_one():
    assert not together.applies(probe.PROBE)
    assert not together.applies(one_by_one(get_task("Swimmer")))
    plain = on_policy.collect(one_by_one(get_task("Swimmer")), random_policy(0, 10, 2), 10, np.random.default_rng(3))
    assert [len(e.rewards) for e in plain.episodes] == [200]


def test_what_is_not_a_number_is_named():
    task = get_task("Swimmer")

    def act(states, numbers, steps):
        return np.where((numbers[:, None] == 1) & (steps[:, None] == 3), np.nan, 0.0) + np.zeros((len(states), 2))

    with pytest.raises(DivergedError, match="Swimmer: step 3 of an episode: expected numbers as action"):
        together.play(task, act, iter(range(3)))


def test_a_simulation_that_diverges_is_named(monkeypatch):
    advance = mujoco.MujocoTask.advance

    def diverged(self, controls):
        state = advance(self, controls)
        if controls[0] > 0.5:
            state[1] = np.inf
        return state

    monkeypatch.setattr(mujoco.MujocoTask, "advance", diverged)
    act = lambda states, numbers, steps: np.where(steps[:, None] == 2, 1.0, 0.0) * np.ones((len(states), 2))  # noqa: E731
    with pytest.raises(TaskError, match=r"Swimmer: the simulation diverged \(at step 2 of an episode\)"):
        together.play(get_task("Swimmer"), act, iter([0]))
