"""The loop's steps one at a time are the loop; what was collected is never lost; a robot's own program can play."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import probe
from metrpo import external, training
from metrpo.commands import main
from metrpo.errors import ConfigError, MetrpoError, RunDirectoryError, TaskError
from metrpo.presets import override, preset
from metrpo.run import machine
from metrpo.run.directory import RunDirectory
from metrpo.run.episodes import EpisodeLog, append_episode
from metrpo.run.metrics import read_metrics
from metrpo.run.policy_file import load_policy
from metrpo.training import train
from metrpo.world import registry
from metrpo.world.task import Task
from places import ROOT

pytestmark = pytest.mark.usefixtures("plain_curve")

ROBOT = ROOT / "examples" / "robot"
SMALL = probe.BRIEF | {"collect.steps": 100, "collect.max_train": 400, "collect.max_validation": 200}


class Fragile(gymnasium.Wrapper):
    """Breaks in the first step of the `left`-th episode from now."""

    left = None

    def reset(self, **kwargs):
        if Fragile.left is not None:
            Fragile.left -= 1
        return self.env.reset(**kwargs)

    def step(self, action):
        if Fragile.left == 0:
            raise TaskError("the motor is hot")
        return self.env.step(action)


FRAGILE = dataclasses.replace(probe.PROBE, make=lambda **kw: Fragile(gymnasium.make(probe.PROBE.env_id, **kw)))
PLAYED_ELSEWHERE = Task("Elsewhere", None, 2, 2, probe.HORIZON, probe.reward)


@pytest.fixture(autouse=True, scope="module")
def _tasks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._TASKS, "Probe", FRAGILE)
        patch.setitem(registry._TASKS, "Elsewhere", PLAYED_ELSEWHERE)
        yield


def config(task="Probe", **settings):
    return override(dataclasses.replace(preset("Swimmer"), task=task), {**SMALL, "iterations": 2, **settings})


def result(run_dir):
    """What a run has learned, and its record."""
    names = ("policy.npz", "metrics.csv", "config.json", "checkpoints/iteration-00002.npz")
    return [(run_dir / name).read_bytes() for name in names]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("uninterrupted") / "run"
    train(config(), run_dir)
    return run_dir


def test_the_steps_one_at_a_time_are_the_loop(uninterrupted, tmp_path):
    external.begin(config(), tmp_path)
    assert load_policy(tmp_path).info.iteration == 0
    for _ in range(2):
        waiting = external.collect(tmp_path)
        assert sum(len(e.rewards) for e in waiting) == 100
        row = external.improve(tmp_path)
    assert row["iteration"] == 2
    assert result(tmp_path) == result(uninterrupted)


def test_steps_and_the_loop_take_turns(uninterrupted, tmp_path):
    external.begin(config(), tmp_path)
    train(dataclasses.replace(config(), iterations=1), tmp_path)
    external.collect(tmp_path, at_least=40)  # the loop plays the rest
    train(config(), tmp_path)
    assert result(tmp_path) == result(uninterrupted)


@pytest.mark.parametrize("episode", [1, 3, 5])
def test_episodes_before_the_environment_broke_are_kept(uninterrupted, tmp_path, monkeypatch, episode):
    train(dataclasses.replace(config(), iterations=1), tmp_path)
    monkeypatch.setattr(Fragile, "left", episode)
    with pytest.raises(TaskError, match="the motor is hot"):
        train(config(), tmp_path)
    kept = EpisodeLog(tmp_path)
    kept.start(after=5)
    assert len(kept.pending()) == episode - 1
    played = 5 - (episode - 1)
    monkeypatch.setattr(Fragile, "left", played + config().evaluation_episodes + 1)  # no more resets than these
    train(config(), tmp_path)
    assert Fragile.left == 1
    assert result(tmp_path) == result(uninterrupted)


def test_a_broken_environment_ends_with_how_to_go_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(machine, "prepare", lambda *_, **__: None)
    monkeypatch.setattr(training, "_measure_yardsticks", lambda *_: None)  # its episodes would be the broken ones
    monkeypatch.setattr(Fragile, "left", 3)
    command = ["train", "Probe", "--trust-reward", "--collect.steps", "100", "--run-dir", str(tmp_path / "run")]
    assert main.main(command) == 2
    err = capsys.readouterr().err
    assert "metrpo: collect, iteration 1: the motor is hot" in err
    assert "run keeps every finished iteration and real episode. The same command resumes." in err
    assert len(EpisodeLog(tmp_path / "run").pending()) == 2


def test_a_damaged_checkpoint_costs_no_real_episode(uninterrupted, tmp_path, caplog, monkeypatch):
    train(config(), tmp_path)
    newest = tmp_path / "checkpoints" / "iteration-00002.npz"
    newest.write_bytes(newest.read_bytes()[:-1])

    def nobody(*_):
        pytest.fail("the real data was there")
        yield

    monkeypatch.setattr("metrpo.world.collection.play", nobody)
    train(config(), tmp_path)
    assert "iteration-00002.npz is damaged" in caplog.text
    assert "resuming from iteration-00001.npz" in caplog.text
    assert result(tmp_path) == result(uninterrupted)


def test_only_another_program_plays(tmp_path):
    asked = config("Elsewhere")
    external.begin(asked, tmp_path)
    with pytest.raises(RunDirectoryError, match="expected episodes to learn from, got none"):
        external.improve(tmp_path)
    with pytest.raises(TaskError, match="Elsewhere: expected an environment, got none"):
        external.collect(tmp_path)
    for seed in range(5):
        states, actions, rewards = probe.rollout(probe.PROBE, seed, lambda t, s: np.sin([t + s[0], t * s[1]]))
        append_episode(tmp_path, states, actions, rewards, terminated=False)
    row = external.improve(tmp_path)
    assert row["real_steps"] == 100
    assert math.isnan(row["return_real"])
    assert row["return_collected"] < 0
    assert load_policy(tmp_path).info.return_real is None
    assert read_metrics(tmp_path / "metrics.csv")[0]["real_steps"] == 100


def test_a_log_from_elsewhere_can_be_added(tmp_path):
    external.begin(config("Elsewhere"), tmp_path / "run")
    states, actions, rewards = probe.rollout(probe.PROBE, 0, lambda t, s: -s)
    log = {"states": states[:-1], "next_states": states[1:], "actions": actions, "rewards": rewards}
    np.savez(tmp_path / "log.npz", **log, terminated=np.zeros(len(rewards)))
    waiting = external.collect(tmp_path / "run", data=tmp_path / "log.npz")
    assert len(waiting) == 1
    np.testing.assert_allclose(waiting[0].states, states, rtol=1e-6)


@pytest.mark.parametrize("setting", [{"validate.rule": "real"}, {"imagine.start": "reset"}])
def test_what_needs_an_environment_is_refused_without_one(tmp_path, setting):
    with pytest.raises(ConfigError, match="Elsewhere: expected an environment for"):
        external.begin(config("Elsewhere", **setting), tmp_path)


def test_more_than_the_budget_is_collected_only_when_asked_for(tmp_path):
    external.begin(dataclasses.replace(config(), real_steps=33), tmp_path)
    waiting = external.collect(tmp_path)
    assert sum(len(e.rewards) for e in waiting) == 33
    assert len(external.collect(tmp_path)) == len(waiting)
    assert sum(len(e.rewards) for e in external.collect(tmp_path, at_least=50)) >= 50
    external.improve(tmp_path)
    with pytest.raises(ConfigError, match=r"budget of .*, 33, is spent; .* metrpo collect .* --steps \d+"):
        external.collect(tmp_path)


def test_a_run_is_begun_once(tmp_path):
    external.begin(config(), tmp_path)
    with pytest.raises(RunDirectoryError, match="holds a run already"):
        external.begin(config(), tmp_path)
    with pytest.raises(ConfigError, match="expected one that learns models, got ppo"):
        external.begin(dataclasses.replace(config(), method="ppo", system="ppo"), tmp_path / "other")
    for step in (external.collect, external.improve):
        with pytest.raises(RunDirectoryError, match=r"holds no run: .* metrpo init TASK"):
            step(tmp_path / "nothing")


def test_a_stale_lock_holder_is_not_disturbed(tmp_path):
    external.begin(config(), tmp_path)
    with RunDirectory(tmp_path, config()), pytest.raises(MetrpoError, match="in use"):
        external.improve(tmp_path)


def test_the_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(machine, "prepare", lambda *_, **__: None)
    typed = []
    for name, value in SMALL.items():
        if value is True:
            continue
        words = [str(v) for v in value] if isinstance(value, tuple) else [str(value)]
        typed += [f"--{name.replace('_', '-')}", *words]
    run_dir = str(tmp_path / "run")
    assert main.main(["init", "Probe", "--run-dir", run_dir, *typed]) == 0
    assert "untrained policy" in capsys.readouterr().out
    assert main.main(["collect", run_dir, "--steps", "60", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["episodes"], found["steps"]) == (3, 60)
    assert main.main(["improve", run_dir, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["real_steps"] == 60
    assert main.main(["collect", run_dir, "--steps", "0"]) == 2
    assert "steps: expected at least 1, got 0" in capsys.readouterr().err
    assert main.main(["improve", str(tmp_path / "none")]) == 2
    assert "holds no run" in capsys.readouterr().err


def test_the_robot_of_the_example_hands_over_what_it_saw(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "prepare", lambda *_, **__: None)
    few = ["--ensemble.hidden", "8", "--fit.max-steps", "20", "--imagine.steps", "600", "--validate.max-updates", "5"]
    run_dir = tmp_path / "arm"
    assert main.main(["init", f"{ROBOT / 'arm.py'}:task", "--run-dir", str(run_dir), *few]) == 0
    command = [sys.executable, str(ROBOT / "robot.py"), str(run_dir), "--rounds", "1", "--episodes", "3"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [row["real_steps"] for row in read_metrics(run_dir / "metrics.csv")] == [180]
    assert "without noise" in done.stdout
