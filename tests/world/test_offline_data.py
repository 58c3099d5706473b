"""Transitions that were logged elsewhere: read as episodes, refused when they do not fit, and enough to learn from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import probe
from metrpo import training
from metrpo.config import Config
from metrpo.errors import ConfigError, TaskError
from metrpo.presets import override
from metrpo.stages import records
from metrpo.world import collection as real
from metrpo.world import offline_data

pytestmark = pytest.mark.usefixtures("plain_curve")


@pytest.fixture(autouse=True)
def _probe_is_a_task():
    with probe.registered():
        yield


def random_episodes(task=probe.PROBE, steps=600):
    rng = np.random.default_rng(0)
    return real.collect(task, lambda rng: lambda s: rng.uniform(-1, 1, 2), steps, rng)


def arrays_of(episodes):
    ends = [np.append(np.zeros(len(e.rewards) - 1, bool), e.terminated) for e in episodes]
    return {
        "states": np.concatenate([e.states[:-1] for e in episodes]),
        "actions": np.concatenate([e.actions for e in episodes]),
        "rewards": np.concatenate([e.rewards for e in episodes]),
        "next_states": np.concatenate([e.states[1:] for e in episodes]),
        "terminated": np.concatenate(ends),
    }


def write(path, **changes):
    arrays = arrays_of(random_episodes()) | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


@pytest.mark.parametrize("task", [probe.PROBE, probe.ENDING_PROBE], ids=lambda t: t.name)
def test_episodes_come_back_as_they_were_logged(tmp_path, task):
    episodes = random_episodes(task)
    np.savez(tmp_path / "log.npz", **arrays_of(episodes))
    read = offline_data.load(tmp_path / "log.npz", task)
    assert len(read) == len(episodes)
    for a, b in zip(read, episodes, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    assert any(e.terminated for e in read) == (task is probe.ENDING_PROBE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rewards": None}, "expected the arrays states, .*; rewards missing"),
        (
            {"states": np.zeros((600, 3))},
            r"states: expected numbers of shape \[600, 2\], got float64 of shape \[600, 3\]",
        ),
        ({"actions": np.full((600, 2), 2.0)}, r"actions: expected numbers in \[-1, 1\], got 2"),
        ({"rewards": np.full(600, np.nan)}, "rewards: expected finite numbers"),
        ({"terminated": np.array(["no"] * 600)}, "terminated: expected numbers of shape"),
        ({"states": np.array([None] * 600, object)}, "cannot be read .*pickle"),
        (
            dict.fromkeys(offline_data.ARRAYS, np.zeros((0, 2))) | {"rewards": np.zeros(0), "terminated": np.zeros(0)},
            "got none",
        ),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, changes, message):
    with pytest.raises(TaskError, match=message):
        offline_data.load(write(tmp_path / "log.npz", **changes), probe.PROBE)


@pytest.mark.parametrize("content", [None, b"", b"no archive", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_archive_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "log.npz").write_bytes(content)
    expected = "expected an .npz of states, actions, .* got no such file" if content is None else "cannot be read"
    with pytest.raises(TaskError, match=expected):
        offline_data.load(tmp_path / "log.npz", probe.PROBE)


OFFLINE = override(
    Config(task="Probe", evaluation_episodes=5, iterations=2, real_steps=0),
    probe.LEARN,
)


def test_the_probe_is_learned_from_logs_alone(tmp_path, monkeypatch):
    """From 600 random transitions, without a real step: within a tenth of the Riccati return."""
    config = dataclasses.replace(OFFLINE, data=str(write(tmp_path / "log.npz")))
    monkeypatch.setattr(records, "evaluate", lambda *_: np.zeros(5))
    monkeypatch.setattr(real, "_episode", lambda *_: pytest.fail("a real step"))
    state = training.train(config)
    monkeypatch.undo()
    assert (state.iteration, state.real_steps) == (2, 0)
    assert state.dataset.train.size + state.dataset.validation.size == 600
    optimum = probe.optimum()
    assert 1.1 * optimum <= probe.real_return(state.policy) <= optimum * 0.9999


def test_logs_are_a_start_that_real_steps_add_to(tmp_path):
    config = dataclasses.replace(OFFLINE, real_steps=None, iterations=1, data=str(write(tmp_path / "log.npz")))
    config = override(config, {"collect.steps": 100, "validate.max_updates": 5})
    state = training.train(config)
    assert state.real_steps == 100
    assert state.dataset.train.size + state.dataset.validation.size == 700
    assert len(state.dataset.starts) == 35


def test_settings_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="real_steps: expected at least 1 without offline data"):
        training.init(OFFLINE)
    with pytest.raises(ConfigError, match="data: expected the method model-based to learn from offline data, got trpo"):
        training.init(dataclasses.replace(OFFLINE, method="trpo", data="log.npz"))
