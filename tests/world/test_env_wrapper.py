"""What is refused before the first real step, and how everything that an environment takes and returns is checked."""

from __future__ import annotations

import dataclasses
import time

import gymnasium
import hypothesis
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.spaces import Box
from hypothesis import strategies as st

import probe
from metrpo import evaluation
from metrpo.errors import TaskError
from metrpo.run.loaded_policy import LoadedPolicy, PolicyInfo
from metrpo.run.video import VideoError
from metrpo.world import collection as real
from metrpo.world import registry
from metrpo.world.env_wrapper import Guarded
from metrpo.world.resolve import task_of
from metrpo.world.task import Task


class Env(gymnasium.Env):
    """A sound environment of one number; counts the steps and resets of all its instances."""

    observation_space = Box(-10.0, 10.0, (1,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    calls = 0
    reward = 1.0
    info = {}  # noqa: RUF012 - as environments have it

    def __init__(self, **attributes):
        vars(self).update(attributes)

    def observation(self):
        return np.zeros(self.observation_space.shape, self.observation_space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        Env.calls += 1
        return self.observation(), self.info

    def step(self, action):
        Env.calls += 1
        assert self.action_space.contains(action), action
        return self.observation(), self.reward, False, False, self.info


def made(horizon=5, **attributes):
    return task_of(lambda **_: Env(**attributes), name="Mine", horizon=horizon)


def refused(message, make):
    """No real step is made for it, and it takes no time."""
    before, began = Env.calls, time.monotonic()
    with pytest.raises(TaskError, match=message):
        make()
    assert Env.calls == before
    assert time.monotonic() - began < 5


# ---------------------------------------------------------------- what is too large


def test_pixels_are_refused_with_the_room_that_they_would_take():
    message = r"Mine: expected observations of at most 4,000 numbers, got 27,648: .* would take 62 GiB; pictures"
    refused(message, lambda: made(observation_space=Box(0, 255, (96, 96, 3), np.uint8)))
    refused(message, lambda: Task("Mine", None, 96 * 96 * 3, 1, 100, None))


@pytest.mark.parametrize("horizon", [10**6, 100_001, 0, -1])
def test_episodes_without_an_end_are_refused_with_what_to_do(horizon):
    message = rf"Mine: expected episodes of 1 to 100,000 steps, got a time limit of {horizon:,}; .*horizon=1000"
    refused(message, lambda: Task("Mine", None, 1, 1, horizon, None))
    if horizon > 0:
        refused(message, lambda: task_of(lambda **_: wrappers.TimeLimit(Env(), horizon), name="Mine"))
        refused(message, lambda: made(horizon))


# ---------------------------------------------------------------- wrappers with running statistics


class Own(gymnasium.Wrapper):
    """Of somebody's own making, with its statistics under the usual name."""

    def __init__(self, env):
        super().__init__(env)
        self.obs_rms = object()


STATISTICS = {
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "Own": Own,
}


@pytest.mark.parametrize("name", STATISTICS)
def test_running_statistics_are_refused_by_name(name):
    def make(**_):
        return wrappers.TimeLimit(STATISTICS[name](Env()), 5)

    message = f"Mine: {name}: .* running statistics, .* leave it out: metrpo normalises"
    refused(message, lambda: task_of(make, name="Mine"))
    refused(message, lambda: Task("Mine", None, 1, 1, 5, None, make=make).make_env())


def test_other_wrappers_are_fine_and_so_are_frozen_statistics():
    def make(**_):
        fixed = wrappers.NormalizeObservation(Env())
        fixed.update_running_mean = False
        return wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(wrappers.FrameStackObservation(fixed, 3), 5))

    assert task_of(make, name="Mine").state_size == 3


# ---------------------------------------------------------------- actions


BOUND = st.floats(-1e6, 1e6, width=32).map(lambda x: round(x, 1)) | st.floats(-1e8, 1e8)


@hypothesis.given(st.lists(st.tuples(BOUND, BOUND), min_size=1, max_size=4), st.sampled_from([np.float32, np.float64]))
@hypothesis.example([(-2.7, 2.4)], np.float32)
def test_every_action_lies_in_the_environments_own_space(bounds, dtype):
    low, high = (np.array(side, dtype) for side in zip(*map(sorted, bounds), strict=True))
    guard = Guarded(Env(action_space=Box(low, high, dtype=dtype)), "Mine")  # which asserts it in each step
    guard.reset(seed=0)
    for action in (-1.0, 1.0, 0.0, 0.3, -1 / 3, 1 - 2**-24):
        guard.step(np.full(len(bounds), action, np.float32))


@pytest.mark.parametrize("bound", [np.inf, np.finfo(np.float32).max, 1e9])
def test_bounds_that_are_none_are_refused_and_the_advice_helps(bound):
    with pytest.raises(TaskError, match=r"Mine: action_space: .*TransformAction\(env, lambda action: action, .*Box"):
        made(action_space=Box(-bound, bound, (1,), np.float32))
    space = Box(-2.0, 2.0, (1,))

    def make(**_):
        env = Env(action_space=Box(-bound, bound, (1,), np.float32))
        return gymnasium.wrappers.TransformAction(env, lambda action: action, space)

    assert task_of(make, name="Mine", horizon=5).action_size == 1


@pytest.mark.parametrize("size", [1, 3])
def test_an_action_of_another_size_is_not_stretched(size):
    guard = Guarded(Env(action_space=Box(-1.0, 1.0, (2,))), "Mine", 5)
    guard.reset(seed=0)
    with pytest.raises(TaskError, match=rf"step\(\): expected an action of 2 numbers, got shape \[{size}\]"):
        guard.step(np.zeros(size, np.float32))
    for task in (probe.PROBE, task_of(lambda **_: guard._env, name="Mine", horizon=5)):
        with pytest.raises(TaskError, match=rf"expected an action of 2 numbers, got shape \[{size}\]"):
            real.evaluate(task, lambda state: np.zeros(size), 1, seed=0)


def test_a_number_is_an_action_of_one_number_and_nothing_is_none():
    assert real.evaluate(made(), lambda state: 0.5, 2, seed=0).tolist() == [5, 5]
    with pytest.raises(TaskError, match="expected an action of 1 number, got None"):
        real.evaluate(made(), lambda state: None, 1, seed=0)


def test_a_policy_of_other_sizes_is_neither_evaluated_nor_filmed(monkeypatch):
    info = PolicyInfo("Probe", 2, 1, (), 0, 0, None)
    policy = LoadedPolicy(info, ((np.zeros((2, 1), np.float32), np.zeros(1, np.float32)),))
    monkeypatch.setattr(evaluation, "load_policy", lambda path: policy)
    message = "Probe: expected a policy of 2 observed numbers and 2 actions, got one of 2 and 1, trained on 'Probe'"
    with probe.registered():
        for use in (lambda: evaluation.evaluate("dir"), lambda: evaluation.render("dir", "out.gif")):
            with pytest.raises(TaskError, match=message):
                use()


# ---------------------------------------------------------------- what comes back


class Odd:
    """Of which nothing can be made."""

    def __array__(self, *_, **__):
        raise RuntimeError("no array")

    def __bool__(self):
        raise RuntimeError("no truth")


@pytest.mark.parametrize("info", ["text", [1, 2], np.arange(2), None, 7, Odd()])
def test_info_may_be_anything(info):
    guard = Guarded(Env(info=info), "Mine", 5)
    assert guard.reset(seed=0)[1] == {}
    assert guard.step(np.zeros(1))[4] == {}
    plain = dataclasses.replace(probe.PROBE, state_size=1, action_size=1, make=lambda **_: wrappers_of(info))
    assert len(real.evaluate(plain, lambda state: np.zeros(1), 1, seed=0)) == 1


def wrappers_of(info):
    return wrappers.TimeLimit(Env(info=info), 3)


@pytest.mark.parametrize("reward", [{"r": 1}, "3", [1, 2], None, Odd(), np.zeros(2), 1j])
def test_a_reward_that_is_no_number_is_one_error(reward):
    with pytest.raises(TaskError, match=r"Mine: step\(\): expected one finite number as reward, got"):
        made(reward=reward)
    plain = Task("Mine", None, 1, 1, 5, None, make=lambda **_: Env(reward=reward))
    with pytest.raises(TaskError, match=r"Mine: step\(\): expected one finite number as reward, got"):
        real.evaluate(plain, lambda state: np.zeros(1), 1, seed=0)


@pytest.mark.parametrize("observation", [{"a": 1}, "here", None, Odd(), np.zeros(2), [[1], [1, 2]], 1j])
def test_an_observation_that_is_no_state_is_one_error(observation):
    class Other(Env):
        def observation(self):
            return observation

    with pytest.raises(TaskError, match=r"Mine: reset\(\): expected an observation of"):
        task_of(lambda **_: Other(), name="Mine", horizon=5)
    plain = Task("Mine", None, 1, 1, 5, None, make=lambda **_: Other())
    with pytest.raises(TaskError, match=r"Mine: reset\(\): expected an observation of 1 number, got"):
        real.evaluate(plain, lambda state: np.zeros(1), 1, seed=0)


def test_any_exception_of_an_environment_is_one_error():
    class Off(Env):
        def step(self, action):
            raise ValueError("motor 3 is off")

    plain = Task("Mine", None, 1, 1, 5, None, make=lambda **_: Off())
    with pytest.raises(TaskError, match=r"Mine: step\(\) raised ValueError: motor 3 is off"):
        real.evaluate(plain, lambda state: np.zeros(1), 1, seed=0)


def test_an_environment_without_spaces_is_one_error():
    with pytest.raises(TaskError, match="Mine: action_space: expected a Box of floats, got None"):
        task_of(lambda **_: gymnasium.Env(), name="Mine", horizon=5)


# ---------------------------------------------------------------- closing


def test_an_environment_that_cannot_be_closed_costs_a_warning(caplog, tmp_path):
    class Stuck(Env):
        def close(self):
            raise RuntimeError("the door is stuck")

    task = task_of(lambda **_: Stuck(), name="Mine", horizon=5)
    act = lambda state: np.zeros(1)  # noqa: E731
    assert len(real.collect(task, lambda rng: act, 10, np.random.default_rng(0))) == 2
    assert len(real.evaluate(task, act, 2, seed=0)) == 2
    assert len(real.reset_states(task, 2, np.random.default_rng(0))) == 2
    text = "Mine: close() raised RuntimeError: the door is stuck; nothing is lost"
    assert [r.getMessage() for r in caplog.records] == [text] * 4
    with pytest.raises(ValueError, match="policy failed"):  # what happened first is what is said
        real.evaluate(task, _failing, 2, seed=0)
    with pytest.raises(VideoError, match="the environment has no render"):
        evaluation.record(task.make_env, act, tmp_path / "out.gif")


def _failing(state):
    raise ValueError("policy failed")


def test_an_episode_ends_at_the_tasks_horizon_in_any_environment():
    endless = Task("Mine", None, 1, 1, 7, None, make=lambda **_: Env())
    assert real.evaluate(endless, lambda state: np.zeros(1), 2, seed=0).tolist() == [7, 7]


def test_registered_tasks_keep_their_sizes():
    assert all(task.state_size < 400 and task.horizon <= 1000 for task in registry.tasks().values())
