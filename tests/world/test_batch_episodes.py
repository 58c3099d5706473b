"""Many episodes at a time are the episodes that one after another gives."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from functools import partial

import numpy as np
import pytest
from scipy import stats

import probe
from helpers import random_policy
from metrpo.baselines import on_policy
from metrpo.errors import DivergedError, EpisodeError, TaskError
from metrpo.policy import gaussian
from metrpo.world import batch_episodes, collection
from metrpo.world.registry import get_task
from metrpo.world.tasks.rllab.environment import MujocoTask

NAMES = ["Swimmer", "Snake", "Hopper", "HopperUpright", "HalfCheetah", "Ant", "Humanoid", "HumanoidStandup"]


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
    assert batch_episodes.applies(task)
    episodes = batch_episodes.play(task, noisy(task), iter(range(3)))
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


def one_after_another(task, seeds, at_least, longest=None):
    """The same by `collection.play`, whose generators give the seeds."""

    class Given:
        def __init__(self, seed):
            self.seed = seed

        def integers(self, _):
            return self.seed

    noise, episodes = noisy(task, 3.0), []

    def draw_act(rng):
        number, steps = np.array([len(episodes)]), itertools.count()
        return lambda state: noise(state[None], number, np.array([next(steps)]))[0]

    with contextlib.closing(collection.play(task, draw_act, map(Given, seeds), longest)) as played:
        while sum(len(e.rewards) for e in episodes) < at_least:
            episodes.append(next(played))
    return episodes


@pytest.mark.parametrize("slots", [1, 3, 64])
@pytest.mark.parametrize(("at_least", "longest"), [(1, None), (100, None), (130, 30), (450, None)])
def test_as_many_episodes_as_one_after_another(monkeypatch, slots, at_least, longest):
    """Ant's end early: the next begins when those before it cannot have enough steps, and none is left unfinished."""
    task = get_task("Ant")
    monkeypatch.setattr(batch_episodes, "SLOTS", slots)
    got = batch_episodes.play(task, noisy(task, 3.0), itertools.count(7), at_least, longest)
    plain = one_after_another(task, itertools.count(7), at_least, longest)
    assert len({e.terminated for e in plain}) == 2 or at_least < 450, "the case must have early ends and late ones"
    assert sum(len(e.rewards) for e in plain[:-1]) < at_least <= sum(len(e.rewards) for e in plain)
    assert len(got) == len(plain)
    for a, b in zip(got, plain, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_drawn_episodes_do_not_depend_on_how_many_run_at_a_time(monkeypatch):
    task, policy = get_task("Ant"), random_policy(0, 29, 8, std=1.0)
    many = on_policy.collect(task, policy, 400, np.random.default_rng(3))
    monkeypatch.setattr(batch_episodes, "SLOTS", 2)
    few = on_policy.collect(task, policy, 400, np.random.default_rng(3))
    assert len(few.episodes) == len(many.episodes) >= 4
    for a, b in zip(many.episodes, few.episodes, strict=True):
        np.testing.assert_allclose(a.states, b.states, atol=1e-5)
    for x, y, e in zip(many.actions, few.actions, many.episodes, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
        np.testing.assert_allclose(np.clip(x, -1, 1), e.actions, atol=1e-6)
    assert len({e.states[0].tobytes() for e in many.episodes}) == len(many.episodes)
    z = np.concatenate([(a - gaussian.mean(policy, e.states[:-1])) for a, e in zip(*many[::-1], strict=True)])
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    first = {np.round(a[0], 3).tobytes() for a in many.actions}
    assert len(first) == len(many.actions), "every episode has noise of its own"


@pytest.mark.parametrize("name", ["Swimmer", "Ant"])
def test_returns_are_those_of_the_plain_evaluation(name):
    task = get_task(name)
    act = partial(gaussian.mean, random_policy(1, task.state_size, task.action_size))
    expected = collection.evaluate(task, act, 5, seed=4)
    np.testing.assert_array_equal(batch_episodes.evaluate(task, act, 5, seed=4), expected)
    assert len(set(expected)) == 5


def test_any_other_environment_is_played_one_after_another():
    act = partial(gaussian.mean, random_policy(1, 2, 2))
    for task in (probe.PROBE, probe.ENDING_PROBE, dataclasses.replace(get_task("Swimmer"), make=probe.ProbeEnv)):
        assert not batch_episodes.applies(task)
    for task in (probe.PROBE, probe.ENDING_PROBE):
        np.testing.assert_array_equal(
            batch_episodes.evaluate(task, act, 6, seed=4), collection.evaluate(task, act, 6, seed=4)
        )


def test_steps_are_told_and_the_evaluation_has_its_bound():
    task, told = get_task("Swimmer"), []
    batch_episodes.play(task, noisy(task), itertools.count(), 250, 100, told.append)
    assert told == [*range(3, 301, 3)]
    act = partial(gaussian.mean, random_policy(1, task.state_size, task.action_size))
    np.testing.assert_array_equal(
        batch_episodes.evaluate(task, act, 9, 4, at_most=350), collection.evaluate(task, act, 9, 4, at_most=350)
    )
    short = batch_episodes.evaluate(task, act, 3, 4, longest=5)
    np.testing.assert_array_equal(short, collection.evaluate(task, act, 3, 4, longest=5))
    assert not np.array_equal(short, batch_episodes.evaluate(task, act, 3, 4))


@pytest.mark.parametrize("at_most", [1, 90, 400])
def test_no_step_is_played_beyond_the_most(at_most):
    task, policy = get_task("Ant"), random_policy(0, 29, 8, std=3.0)
    drawn = on_policy.collect(task, policy, 450, np.random.default_rng(0), at_most=at_most)
    assert sum(len(e.rewards) for e in drawn.episodes) == at_most
    assert [len(a) for a in drawn.actions] == [len(e.rewards) for e in drawn.episodes]


def test_what_is_not_a_number_is_named():
    task = get_task("Swimmer")

    def act(states, numbers, steps):
        return np.where((numbers[:, None] == 1) & (steps[:, None] == 3), np.nan, 0.0) + np.zeros((len(states), 2))

    with pytest.raises(DivergedError, match="Swimmer: step 3 of an episode: expected numbers as action"):
        batch_episodes.play(task, act, iter(range(3)))
    with pytest.raises(
        TaskError, match=r"Swimmer: step 0 of an episode: expected an action of 2 numbers, got shape \[3"
    ):
        batch_episodes.play(task, lambda states, numbers, steps: np.zeros((len(states), 3)), iter([0]))


def test_a_simulation_that_diverges_is_named(monkeypatch):
    advance = MujocoTask.advance

    def diverged(self, controls):
        state = advance(self, controls)
        if controls[0] > 0.5:
            state[1] = np.inf
        return state

    monkeypatch.setattr(MujocoTask, "advance", diverged)
    act = lambda states, numbers, steps: np.where(steps[:, None] == 2, 1.0, 0.0) * np.ones((len(states), 2))  # noqa: E731
    with pytest.raises(EpisodeError, match=r"Swimmer: the simulation diverged \(at step 2 of an episode\)"):
        batch_episodes.play(get_task("Swimmer"), act, iter([0]))
