"""A task's environment with a history: its states, its formulas, and what a broken environment is told."""

from __future__ import annotations

import dataclasses

import gymnasium
import numpy as np
import pytest

import late
import probe
from metrpo.errors import EpisodeError, NotFiniteError, TaskError
from metrpo.limits import Limits
from metrpo.world import collection
from metrpo.world.formula_check import check_formulas
from metrpo.world.history_env import with_history
from metrpo.world.registry import get_task, limited

SEEN = with_history(late.LATE, 3)


def test_states_hold_the_actions_as_they_were_executed():
    task = with_history(limited(late.LATE, Limits(0.6, 0.25)), 3)
    loud = lambda rng: lambda state: 9 * rng.standard_normal(2)  # noqa: E731
    for episode in collection.collect(task, loud, 60, np.random.default_rng(0)):
        states, actions = episode.states, episode.actions
        assert np.abs(actions).max() <= np.float32(0.6)
        np.testing.assert_array_equal(states[0], [*states[0, :2]] * 3 + [0.0] * 4)
        np.testing.assert_array_equal(states[3:, 6:8], actions[2:])
        np.testing.assert_array_equal(states[3:, 8:], actions[1:-1])
        np.testing.assert_array_equal(states[1:, 2:4], states[:-1, :2])
        np.testing.assert_array_equal(states[2:, 4:6], states[:-2, :2])


def test_an_environments_actions_are_remembered_within_its_range():
    env = SEEN.make_env()
    env.reset(seed=0)
    env.env.env.step = lambda action: (np.zeros(2), 0.0, False, False, {})
    state, *_ = env.step(np.array([3.0, -0.5], np.float32))
    np.testing.assert_array_equal(state[6:8], [1.0, -0.5])
    env.close()


def test_the_observations_are_those_of_the_plain_environment_and_nothing_is_shared():
    plain, seen = late.LATE.make_env(), SEEN.make_env()
    before = plain.reset(seed=3)[0], seen.reset(seed=3)[0]
    kept = before[1].copy()
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32):
        now = plain.step(action), seen.step(action)
        np.testing.assert_array_equal(now[0][0], now[1][0][:2])
        assert now[0][1:] == now[1][1:]
    np.testing.assert_array_equal(before[1], kept)
    assert seen.observation_space.contains(now[1][0])
    plain.close()
    seen.close()


def test_formulas_are_of_the_newest_observation():
    ending = with_history(dataclasses.replace(probe.ENDING_PROBE, unseen=(1,)), 2)
    states = np.random.default_rng(0).normal(size=(7, 6))
    actions, following = states[:, :2], states[::-1]
    np.testing.assert_array_equal(
        ending.reward(states, actions, following), probe.reward(states[:, :2], actions, following[:, :2])
    )
    np.testing.assert_array_equal(ending.terminated(following), probe.beyond(following[:, :2]))
    assert ending.unseen == (1, 3)
    assert (ending.observation_size, ending.state_size, ending.predicted) == (2, 6, 2)
    check_formulas(ending, np.random.default_rng(0))
    check_formulas(SEEN, np.random.default_rng(0))


def test_a_task_of_ours_with_a_history_is_its_environment():
    swimmer = with_history(get_task("Swimmer"), 2)
    act = lambda state: 0.5 * np.tanh(state[:2])  # noqa: E731
    np.testing.assert_array_equal(
        collection.evaluate(swimmer, act, 1, seed=0), collection.evaluate(get_task("Swimmer"), act, 1, seed=0)
    )


def test_one_observation_is_no_history_and_two_histories_are_refused():
    assert with_history(late.LATE, 1) is late.LATE
    assert with_history(SEEN, 3) is SEEN
    assert with_history(late.LATE, 3) is SEEN
    with pytest.raises(ValueError, match="Late: expected a task without a history, got one of 3"):
        with_history(SEEN, 2)
    unplayable = with_history(dataclasses.replace(late.LATE, make=None, env_id=None), 3)
    assert not unplayable.playable


class Broken(gymnasium.Wrapper):
    given = None

    def step(self, action):
        return self.given, 0.0, False, False, {}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (np.zeros(3), "expected an observation of 2 numbers, got shape \\[3\\]"),
        ("none", "expected an observation of 2 numbers, got none"),
    ],
)
def test_an_observation_of_another_shape_is_named_as_such(given, said):
    task = broken_task(given)
    with pytest.raises(EpisodeError, match=f"Late: step\\(\\): {said}"):
        collection.evaluate(task, lambda s: np.zeros(2), 1, 0)


def broken_task(given):
    make = lambda **kw: type("Once", (Broken,), {"given": given})(late.LATE.make_env(**kw))  # noqa: E731
    return with_history(dataclasses.replace(late.LATE, make=make), 3)


def test_what_is_not_finite_and_what_is_no_step_are_refused_as_ever():
    with pytest.raises(NotFiniteError, match="Late: step 0 of an episode: expected finite numbers"):
        collection.evaluate(broken_task(np.array([0.0, np.nan])), lambda s: np.zeros(2), 1, 0)
    task = dataclasses.replace(late.LATE, make=lambda **kw: Quiet(late.LATE.make_env(**kw)))
    with pytest.raises(TaskError, match=r"Late: reset\(\): expected \(observation, info\), got"):
        collection.evaluate(with_history(task, 2), lambda s: np.zeros(2), 1, 0)


class Quiet(gymnasium.Wrapper):
    def reset(self, **given):
        return self.env.reset(**given)[0]
