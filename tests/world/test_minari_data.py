"""Episodes out of Minari datasets that are made here."""

from __future__ import annotations

import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from metrpo.errors import TaskError
from metrpo.world import offline_data
from metrpo.world.registry import get_task
from metrpo.world.resolve import task_of

minari = pytest.importorskip("minari")


class Recorder:
    """Plays random actions in `env` and makes a dataset of it."""

    def __init__(self, env, seed=0):
        self.env, self.episodes = env, []
        env.action_space.seed(seed)

    def play(self, seed, spoil=lambda rows: rows):
        state, _ = self.env.reset(seed=seed)
        rows, over = [(state, None, None, None, None)], False
        while not over:
            action = self.env.action_space.sample()
            state, *rest = self.env.step(action)
            rows.append((state, action, *rest[:3]))
            over = rest[1] or rest[2]
        states, actions, rewards, terminated, truncated = map(list, zip(*rows, strict=True))
        self.episodes.append((states, *(column[1:] for column in (actions, rewards, terminated, truncated))))
        return self

    def save(self, name):
        from minari.data_collector import EpisodeBuffer

        def stacked(observations):
            if isinstance(observations[0], dict):
                return {key: np.array([o[key] for o in observations]) for key in observations[0]}
            return np.array(observations)

        buffers = [
            EpisodeBuffer(observations=stacked(s), actions=np.array(a), rewards=r, terminations=t, truncations=u)
            for s, a, r, t, u in self.episodes
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it asks for an author, a description, ...
            minari.create_dataset_from_buffers(
                name,
                buffer=buffers,
                action_space=self.env.action_space,
                observation_space=self.env.observation_space,
            )


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))


def test_episodes_come_as_played_with_actions_in_our_range():
    recorder = Recorder(gymnasium.make("Pendulum-v1")).play(seed=1).play(seed=2)
    recorder.save("pendulum/random-v0")
    task = get_task("Pendulum-v1")
    episodes = offline_data.load("minari:pendulum/random-v0", task)
    assert [len(e.rewards) for e in episodes] == [200, 200]
    for found, (states, actions, rewards, _, _) in zip(episodes, recorder.episodes, strict=True):
        np.testing.assert_allclose(found.states, states, rtol=1e-6)
        np.testing.assert_allclose(2 * found.actions, actions, atol=1e-6)  # its motor has 2 N m
        np.testing.assert_allclose(found.rewards, rewards, rtol=1e-6)
        assert found.terminated is False, "the clock ended it"
        replayed = task.make_env()  # our actions do in our environment what theirs did in theirs
        replayed.reset(seed=1 if found is episodes[0] else 2)
        again = np.array([replayed.step(a)[0] for a in found.actions[:5]])
        np.testing.assert_allclose(again, found.states[1:6], atol=1e-4)


class Ending(gymnasium.Env):
    """Observes a Dict; the task ends it after three steps."""

    observation_space = Dict({"place": Box(-9, 9, (2,), np.float64), "age": Box(0, 9, (1,), np.float64)})
    action_space = Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.age = 0
        return self.seen(np.zeros(2)), {}

    def seen(self, place):
        return {"place": np.asarray(place, np.float64), "age": np.array([float(self.age)])}

    def step(self, action):
        self.age += 1
        return self.seen(action), 1.0, self.age == 3, False, {}


def test_observations_of_parts_are_flattened_as_in_training():
    recorder = Recorder(Ending()).play(seed=0)
    recorder.save("ending/random-v0")
    task = task_of(Ending, horizon=10)
    (episode,) = offline_data.load("minari:ending/random-v0", task)
    assert episode.terminated is True
    assert episode.states.shape == (4, 3)
    np.testing.assert_array_equal(episode.states[:, 0], [0, 1, 2, 3])  # "age" comes before "place"
    _, actions, *_ = recorder.episodes[0]
    np.testing.assert_allclose(episode.states[1:, 1:], actions, rtol=1e-6)
    np.testing.assert_allclose(episode.actions[:, 1], np.array(actions)[:, 1] / 2 - 1, atol=1e-6)


def test_what_does_not_fit_is_named():
    Recorder(gymnasium.make("Pendulum-v1")).play(seed=1).save("pendulum/random-v0")
    with pytest.raises(TaskError, match="observations: expected 10 numbers for Swimmer, got 3"):
        offline_data.load("minari:pendulum/random-v0", get_task("Swimmer"))


def test_a_dataset_that_nobody_has_is_one_message(monkeypatch):
    def none(*_, **__):
        raise FileNotFoundError("no such dataset")

    monkeypatch.setattr(minari, "load_dataset", none)
    with pytest.raises(
        TaskError, match=r"minari:no/such-v0: expected a data set's full name, such as .*minari list remote"
    ):
        offline_data.load("minari:no/such-v0", get_task("Swimmer"))


def test_without_minari_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(TaskError, match=r"pip install 'metrpo\[minari\]'"):
        offline_data.load("minari:no/such-v0", get_task("Swimmer"))
