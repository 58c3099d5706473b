"""What an environment does wrong costs as little as it can: a record, an episode, never what has been learned."""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
import signal
import time

import gymnasium
import numpy as np
import pytest

import probe
import tiny_run
from metrpo import algorithm, budget, external, training
from metrpo.checks.health import examine
from metrpo.commands import main
from metrpo.console import interrupt
from metrpo.console.interrupt import Interruptible, Stopped
from metrpo.console.progress import Progress
from metrpo.errors import TaskError
from metrpo.model import calibration, diagnostics
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble
from metrpo.model.fit import FitInfo
from metrpo.policy_phase import PhaseInfo
from metrpo.presets import override
from metrpo.run import machine
from metrpo.run.directory import RunDirectory
from metrpo.run.metrics import read_metrics
from metrpo.stages import records
from metrpo.training import train
from metrpo.world import collection as real
from metrpo.world import dataset as datasets
from metrpo.world import registry
from metrpo.world.task import Task

pytestmark = pytest.mark.usefixtures("plain_curve")

CONFIG = dataclasses.replace(tiny_run.CONFIG, iterations=2)


class Sick(gymnasium.Wrapper):
    """Does what `sickness(env, starts so far, step)` does in every step of an episode, and cannot be closed."""

    sickness = staticmethod(lambda start, step: None)

    def reset(self, **kwargs):
        state, info = self.env.reset(**kwargs)
        self.start, self.step_number = float(state[0]), 0
        return state, info

    def step(self, action):
        state, *rest = self.env.step(action)
        if Sick.sickness(self.start, self.step_number):
            state = np.full_like(state, np.nan)
        self.step_number += 1
        return state, *rest


@pytest.fixture(autouse=True)
def _tasks(monkeypatch):
    monkeypatch.setattr(machine, "prepare", lambda *_, **__: None)
    monkeypatch.setattr(training, "_measure_yardsticks", lambda *_: None)  # they play as well
    sick = dataclasses.replace(probe.PROBE, make=lambda **kw: Sick(gymnasium.make(probe.PROBE.env_id, **kw)))
    monkeypatch.setitem(registry._TASKS, "Probe", sick)
    monkeypatch.setattr(Sick, "sickness", staticmethod(lambda start, step: None))


@pytest.fixture
def taught(monkeypatch):
    """Learning takes no time: it counts the real steps, and keeps what it was given to learn from."""
    given = []

    def learn(config, task, state, episodes, progress, clock, real):
        given.append(episodes)
        steps = state.real_steps + sum(len(e.rewards) for e in episodes)
        row = {"iteration": state.iteration + 1, "real_steps": steps, "return_real": 0.0, "return_real_std": 0.0}
        row["failed_episodes"] = real.failed
        return state._replace(iteration=state.iteration + 1, real_steps=steps), row

    monkeypatch.setattr(algorithm, "learn", learn)
    return given


# ---------------------------------------------------------------- records


def test_no_record_costs_what_is_learned(monkeypatch, caplog):
    """The same state as undisturbed, the same columns, NaN where something could not be measured, and why."""
    task = dataclasses.replace(registry.get_task("Probe"), name="Ending", terminated="learned")
    monkeypatch.setitem(registry._TASKS, "Ending", task)
    config = dataclasses.replace(CONFIG, task="Ending")
    state = training.init(config)
    _learn_nothing(monkeypatch)
    expected, sound = training.step(config, state)

    def fails(*_):
        raise RuntimeError("no model of it")

    episodes = algorithm.collect(config, task, state)
    monkeypatch.setattr(Sick, "sickness", staticmethod(lambda start, step: step == 3))
    monkeypatch.setattr(Sick, "close", fails)
    monkeypatch.setattr(records, "diagnose", fails)
    monkeypatch.setattr(records, "end_calibration", fails)
    monkeypatch.setattr(records.scales, "count", fails)
    caplog.clear()
    found, row = algorithm.learn(config, task, state, episodes)
    assert str(found) == str(expected)
    assert list(row) == list(sound)
    unknown = {name for name, value in row.items() if math.isnan(value)} - {"end_recall", "return_proof"}
    measured = {
        "return_real",
        "return_real_std",
        "gap",
        "outside",
        "disagreement_real",
        "disagreement_imagined",
        "saturated",
        "unfit_dimensions",
    }
    assert (sound["failed_evaluation"], row["failed_evaluation"]) == (0, 1)
    assert unknown == measured | {name for name in row if name.startswith(("error_", "end_"))} - {"end_recall"}
    told = [record.getMessage() for record in caplog.records]
    assert told[0] == ("iteration 1 has no diagnostics (RuntimeError: no model of it); what it learned is kept")
    assert told[1].startswith("Ending: close() raised RuntimeError: no model of it")
    assert told[2].startswith("iteration 1 has no return_real (evaluate, iteration 1: Ending: step 3 of an episode: ")
    assert told[3].startswith("iteration 1 has no calibration (RuntimeError")
    assert told[4].startswith("iteration 1 has no unfit_dimensions (RuntimeError")
    assert len(told) == 5


def _learn_nothing(monkeypatch):
    """In no time: models and policy stay as they are, and predict that nothing ever changes."""
    three = np.zeros(2)

    def fit(config, task, networks, dataset, iteration, progress, steps):
        n = ensembles.normaliser_of(dataset.train, 0.1, 0.1, ())
        return Ensemble(networks, n), FitInfo(1, three, three, three, three > 1, three > 1)

    def improve(config, task, state, *_):
        return state.policy, state.baseline, PhaseInfo(three, 5, 0, 0, 1, three, 0.0, 0.0)

    def rollouts(ensemble, policy, starts, actions, key):
        length, count, size = actions.shape[1], *starts.shape
        still = np.broadcast_to(starts, (length, 2, count, size))
        beyond = np.zeros((length, count, actions.shape[-1]))
        return still, np.zeros(count), still[:, 0], np.zeros((length, count)), beyond

    monkeypatch.setattr(algorithm, "fit_ensemble", fit)
    monkeypatch.setattr(algorithm, "improve_policy", improve)
    monkeypatch.setattr(diagnostics, "_rollouts", rollouts)
    monkeypatch.setattr(calibration, "_ends", lambda ensemble, states, actions: np.zeros((2, len(states))))


def test_a_request_to_stop_is_not_taken_for_a_failure():
    def stops():
        raise Stopped(signal.SIGTERM)

    with pytest.raises(Stopped):
        records.recorded("return_real", 1, stops, None)


# ---------------------------------------------------------------- episodes


def test_an_episode_of_nan_is_left_out_and_never_played_again(tmp_path, taught, monkeypatch, caplog):
    reset, seeds = probe.ProbeEnv.reset, []

    def watched(self, *, seed=None, options=None):
        seeds.append(seed)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(probe.ProbeEnv, "reset", watched)
    algorithm.collect(CONFIG, registry.get_task("Probe"), training.init(CONFIG))
    second = probe.rollout(probe.PROBE, seeds[1], lambda t, s: np.zeros(2))[0][0, 0]
    monkeypatch.setattr(Sick, "sickness", staticmethod(lambda start, step: start == second and step == 4))
    seeds.clear()
    train(dataclasses.replace(CONFIG, iterations=1), tmp_path / "whole")
    assert len(set(seeds)) == tiny_run.EPISODES + 1
    assert "this episode is left out (1 of at most 10)" in caplog.text
    rows = read_metrics(tmp_path / "whole" / "metrics.csv")
    assert [row["failed_episodes"] for row in rows] == [1]
    assert any(c.code == "failed-episodes" for c in examine(rows, CONFIG))
    # Killed after the failure, the run goes on with the very same episodes, and that seed never comes again.
    seeds.clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Progress, "update", killed_at(60))
        with pytest.raises(KeyboardInterrupt):
            train(CONFIG, tmp_path / "killed")
    train(CONFIG, tmp_path / "killed")
    assert seeds.count(seeds[1]) == 1
    assert [[e.states.tobytes() for e in g] for g in taught[:2]] == [[e.states.tobytes() for e in taught[0]]] * 2
    rows = read_metrics(tmp_path / "killed" / "metrics.csv")
    assert [row["failed_episodes"] for row in rows] == [1, 0]


def killed_at(steps):
    def update(self, done, note=""):
        if done == steps:
            raise KeyboardInterrupt

    return update


def test_the_run_stops_where_every_episode_fails(tmp_path, taught, monkeypatch, capsys):
    monkeypatch.setattr(Sick, "sickness", staticmethod(lambda start, step: step == 2))
    run_dir = tmp_path / "run"
    assert main.main(tiny_run.command_line(run_dir)) == 2
    err = capsys.readouterr().err
    assert "10 episodes before it failed too: repair the environment" in err
    assert "The same command resumes" not in err
    monkeypatch.undo()
    with probe.registered():
        train(tiny_run.CONFIG, run_dir)
    assert read_metrics(run_dir / "metrics.csv")[0]["failed_episodes"] == 11


def test_an_exception_is_tried_once_more_and_then_left_out(tmp_path, taught, monkeypatch, capsys):
    def hot(start, step):
        if hot.left and len(list((tmp_path / "run").glob("episodes/0*.npz"))) == 2 and step == 1:
            hot.left -= 1
            raise TaskError("the motor is hot")

    hot.left = 2
    monkeypatch.setattr(Sick, "sickness", staticmethod(hot))
    command = tiny_run.command_line(tmp_path / "run")
    assert main.main(command) == 2
    assert "The same command resumes." in capsys.readouterr().err
    assert main.main(command) == 0
    rows = read_metrics(tmp_path / "run" / "metrics.csv")
    assert [row["failed_episodes"] for row in rows] == [1, 0, 0]


@pytest.mark.parametrize("what", ["{", "[]", '{"0": 3}', '{"0": {"1": "x"}}', "\xff", '{"x": {}}'])
def test_a_damaged_note_of_failures_costs_nothing(tmp_path, what):
    with RunDirectory(tmp_path, CONFIG) as run:
        run.episodes.note_failures({1: True, 4: False})
        assert run.episodes.failures() == {1: True, 4: False}
        run.episodes.start(after=3)
        assert run.episodes.failures() == {}
        run.episodes.note_failures({0: True})
        run.episodes.start(after=0)
        assert run.episodes.failures() == {1: True, 4: False}, "a damaged checkpoint leads back here"
        (tmp_path / "episodes" / "failed.json").write_text(what, "latin-1")
        assert run.episodes.failures() == {}


def test_resets_of_nan_are_drawn_again():
    class Blinking(probe.ProbeEnv):
        def reset(self, *, seed=None, options=None):
            state, info = super().reset(seed=seed)
            return (np.full(2, np.nan) if state[0] > 0.3 else state), info

    task = dataclasses.replace(probe.PROBE, make=lambda **_: Blinking())
    states = real.reset_states(task, 8, np.random.default_rng(1))
    assert states.shape == (8, 2)
    assert np.all(states[:, 0] <= 0.3)


# ---------------------------------------------------------------- "The same command resumes", where it can


def test_what_cannot_go_on_does_not_say_so(tmp_path, taught, monkeypatch, capsys):
    elsewhere = Task("Elsewhere", None, 2, 2, probe.HORIZON, probe.reward)
    monkeypatch.setitem(registry._TASKS, "Elsewhere", elsewhere)
    run_dir = tmp_path / "run"
    external.begin(dataclasses.replace(CONFIG, task="Elsewhere"), run_dir)
    assert main.main(["collect", str(run_dir)]) == 2
    assert main.main(["collect", str(run_dir), "--data", str(tmp_path / "none.npz")]) == 2
    err = capsys.readouterr().err
    assert "expected an environment, got none" in err
    assert "expected an .npz of states" in err
    assert "command resumes" not in err


# ---------------------------------------------------------------- time


LONG = 1500


@pytest.fixture
def long_task(monkeypatch):
    env_id = "tests/VeryLong-v0"
    if env_id not in gymnasium.registry:
        gymnasium.register(env_id, entry_point=probe.ProbeEnv, max_episode_steps=LONG, disable_env_checker=True)
    task = Task("Long", env_id, 2, 2, LONG, probe.reward)
    monkeypatch.setitem(registry._TASKS, "Long", task)
    return task


def test_only_very_long_episodes_are_cut(long_task):
    config = dataclasses.replace(CONFIG, task="Long")
    state = training.init(config)
    episodes = algorithm.collect(config, long_task, state)
    assert [len(e.rewards) for e in episodes] == [budget.LONGEST]
    assert not episodes[0].terminated
    assert [len(e.rewards) for e in algorithm.collect(config, long_task, state, at_least=1001)] == [1000, 1000]
    more = override(config, {"collect.steps": 1200})
    assert [len(e.rewards) for e in algorithm.collect(more, long_task, state)] == [1200]
    short = override(config, {"collect.steps": 30, "task": "Probe"})
    assert [len(e.rewards) for e in algorithm.collect(short, probe.PROBE, state)] == [20, 20], (
        "a whole one may go beyond"
    )


def test_an_evaluation_ends(long_task, monkeypatch):
    config = dataclasses.replace(CONFIG, task="Long", evaluation_episodes=1000)
    monkeypatch.setattr(records, "EVALUATION_STEPS", 2 * LONG)
    assert len(records.evaluate(config, long_task, training.init(config).policy, 1)) == 2
    assert records.evaluate(CONFIG, probe.PROBE, training.init(CONFIG).policy, 1).shape == (1,)


def test_a_request_to_stop_does_not_wait_for_a_long_episode(tmp_path, monkeypatch, capfd):
    """The episode is lost, and the same one when the command is given again."""
    began, step = [], probe.ProbeEnv.step

    def slow(self, action):
        if not began:
            began.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)
        return step(self, action)

    monkeypatch.setattr(probe.ProbeEnv, "step", slow)
    monkeypatch.setattr(interrupt, "PATIENCE", 0.3, raising=False)
    assert main.main(tiny_run.command_line(tmp_path / "run")) == 143
    assert time.monotonic() - began[0] < 1.5
    assert not list((tmp_path / "run").glob("episodes/*.npz"))
    assert "The same command resumes." in capfd.readouterr().err


def test_a_short_episode_is_finished_first(monkeypatch):
    with Interruptible(Progress()) as progress:
        progress.begin(1, 1)
        progress.stage("collect")
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        progress.played()
        with pytest.raises(Stopped):
            progress.update(20)


# ---------------------------------------------------------------- processes of an environment


def _wait():
    time.sleep(60)


@pytest.mark.filterwarnings("ignore:.*fork:RuntimeWarning", "ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_children_of_an_environment_end_when_they_are_told(number):
    """Forked, they have our handlers; `close()` ends them, and waits."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Interruptible(Progress()) as progress:
            progress.begin(1, 1)
            progress.stage("collect")
            child = multiprocessing.get_context("fork").Process(target=_wait, daemon=True)
            child.start()
            time.sleep(0.2)
            os.kill(child.pid, number)
            child.join(5)
            ended = child.exitcode
            child.kill()
            assert ended is not None, "it would be waited for for ever"
            assert ended in (-number, 1)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.filterwarnings("ignore:.*fork:RuntimeWarning", "ignore:.*fork:DeprecationWarning")
def test_the_handler_of_many_runs_acts_in_its_own_process_only():
    before = signal.signal(signal.SIGTERM, interrupt.stop)
    try:
        child = multiprocessing.get_context("fork").Process(target=_wait, daemon=True)
        child.start()
        time.sleep(0.2)
        child.terminate()
        child.join(5)
        assert child.exitcode == -signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)


# ---------------------------------------------------------------- memory


def test_room_for_wide_states_grows_as_it_is_needed(monkeypatch):
    monkeypatch.setattr(datasets, "ROOM", 100 * 4 * 9, raising=False)
    shapes = []
    for size in (0, 99, 100, 101, 250, 390):
        rows = [np.ones((size, n), np.float32) for n in (4, 1, 4)]
        padded = datasets.with_capacity(datasets.Transitions(*rows, size), 390)
        assert padded.states.sum() == 4 * size
        shapes.append(len(padded.states))
    assert shapes == [100, 100, 100, 200, 390, 390]
