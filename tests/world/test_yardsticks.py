"""What no skill earns: measured once, kept in run.json, drawn and said."""

import dataclasses
import json

import numpy as np
import pytest

import probe
from metrpo import training
from metrpo.console.progress import Progress
from metrpo.errors import TaskError
from metrpo.run import yardstick_record
from metrpo.run.directory import RunDirectory
from metrpo.types import Episode
from metrpo.world import yardsticks as world
from tiny_run import CONFIG


@pytest.fixture(autouse=True)
def _a_task_to_begin(monkeypatch):
    monkeypatch.setattr(training, "_loop", lambda config, state, *_: state)
    with probe.registered():
        yield


def test_doing_nothing_earns_what_a_loop_says():
    found = world.measure(probe.PROBE, episodes=3, seed=5)
    rng = np.random.default_rng(5)
    env, returns = probe.PROBE.make_env(), []
    for _ in range(3):
        env.reset(seed=int(rng.integers(2**31)))
        returns.append(sum(env.step(np.zeros(2, np.float32))[1] for _ in range(probe.HORIZON)))
    env.close()
    assert found.zero.mean == pytest.approx(np.mean(returns), rel=1e-5)
    assert found.zero.std == pytest.approx(np.std(returns), rel=1e-4)
    assert found.zero.episodes == found.random.episodes == 3
    assert found.random.mean < found.zero.mean, "the probe's reward charges for actions"


@pytest.mark.parametrize(("horizon", "episodes"), [(20, 10), (1000, 10), (4000, 2), (50_000, 1)])
def test_long_episodes_are_played_less_often(monkeypatch, horizon, episodes):
    seen = []
    for way in (world.batch_episodes, world.collection):
        monkeypatch.setattr(way, "evaluate", lambda t, act, n, seed, longest: seen.append((n, longest)) or np.zeros(n))
    world.measure(dataclasses.replace(probe.PROBE, horizon=horizon))
    assert seen == 2 * [(episodes, 10_000)]


def test_a_run_says_what_evaluation_cuts(caplog):
    training.check(CONFIG, dataclasses.replace(probe.PROBE, horizon=10_001))
    assert "Probe: episodes have up to 10,001 steps; evaluation cuts them after 10,000" in caplog.text


class Heard(Progress):
    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


def test_a_run_measures_them_once_keeps_and_says_them(tmp_path):
    heard = Heard()
    training.train(CONFIG, tmp_path / "run", heard)
    with RunDirectory(tmp_path / "run", CONFIG) as run:
        run.begin(training.init(CONFIG))
    training.train(CONFIG, tmp_path / "run", heard)
    kept = yardstick_record.kept(tmp_path / "run")
    assert set(kept) == {"doing nothing", "random actions"}
    said = [line for line in heard.lines if line.startswith("doing nothing earns")]
    assert len(said) == 1
    assert f"{kept['doing nothing']:.4g}" in said[0]
    about = json.loads((tmp_path / "run" / "run.json").read_text())
    assert about["format"] == 1
    assert about["yardsticks"]["zero"]["episodes"] == 10


def test_a_run_killed_before_its_first_checkpoint_measures_once(tmp_path):
    first, again, other = Heard(), Heard(), Heard()
    training.train(CONFIG, tmp_path, first)
    assert not [line for line in first.lines if "resuming" in line]
    training.train(CONFIG, tmp_path, again)
    assert again.lines == [f"resuming {tmp_path} at iteration 1 of 3, 0 real steps"]
    elsewhere = dataclasses.replace(CONFIG, task="EndingProbe")
    training.train(elsewhere, tmp_path, other)
    assert other.lines[-1].startswith("doing nothing earns"), "those of another task"
    with RunDirectory(tmp_path, elsewhere) as run:
        run.episodes.append(probe_episode())
    training.train(elsewhere, tmp_path, again)
    assert again.lines[-1] == f"resuming {tmp_path} at iteration 1 of 3, 0 real steps and 20 new ones"


def probe_episode():
    states, actions, rewards = probe.rollout(probe.PROBE, 0, lambda t, s: -s)
    return Episode(states, actions, rewards.astype(np.float32), False)


def test_an_environment_that_fails_there_costs_a_warning(tmp_path, monkeypatch, caplog):
    def broken(task):
        raise TaskError("the motor is off")

    monkeypatch.setattr(training, "measure", broken)
    training.train(CONFIG, tmp_path / "run")
    assert "the motor is off" in caplog.text
    assert yardstick_record.kept(tmp_path / "run") == {}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"yardsticks": 3}', '{"yardsticks": {"zero": {"mean": "x"}}}'])
def test_a_run_without_them_has_none(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    assert yardstick_record.kept(tmp_path) == {}
    assert yardstick_record.kept(tmp_path / "nowhere") == {}
