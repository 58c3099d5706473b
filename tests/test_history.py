"""Histories: how states are put together, what models predict of them, and what a policy's file remembers."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import late
import probe
from exported import act_and_reset, module_of
from helpers import random_policy
from metrpo import evaluate, evaluation, external, training
from metrpo.commands import main
from metrpo.commands.parse import parse
from metrpo.config import Config, from_json, to_json
from metrpo.errors import ConfigError, RunDirectoryError, TaskError
from metrpo.history import History, runs, tied
from metrpo.model.diagnostics import diagnose
from metrpo.model.imagine import Simulator, imagine, returns_per_model
from metrpo.model.sampling import SAMPLINGS
from metrpo.policy import gaussian
from metrpo.presets import override, preset
from metrpo.run.episodes import EpisodeLog, append_episode
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.metrics import read_metrics
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.training import train
from metrpo.world import collection, dataset, offline_data, registry
from metrpo.world.history_env import with_history
from metrpo.world.registry import task_for

pytestmark = pytest.mark.usefixtures("plain_curve")

SIZES = st.tuples(st.integers(1, 5), st.integers(1, 4), st.integers(1, 3))
SEEN = with_history(late.LATE, late.LENGTH)
LAYOUT = late.LAYOUT
POLICY = random_policy(3, LAYOUT.state_size, 2, scale=0.8)


@pytest.fixture(autouse=True, scope="module")
def _tasks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._TASKS, "Late", late.LATE)
        patch.setitem(registry._TASKS, "LateElsewhere", dataclasses.replace(late.LATE, make=None, env_id=None))
        yield


def slow_states(observations, actions, length):
    """Straight from the definition, a number at a time."""
    states = []
    for t in range(len(observations)):
        seen = [observations[max(t - k, 0)] for k in range(length)]
        taken = [actions[t - k] if t >= k else np.zeros(actions.shape[1]) for k in range(1, length)]
        states.append(np.concatenate([*seen, *taken]))
    return np.array(states)


# ---------------------------------------------------------------- the layout


@given(SIZES, st.integers(0, 7))
def test_states_step_by_step_and_of_a_whole_episode_are_those_of_the_definition(sizes, steps):
    layout, rng = History(*sizes), np.random.default_rng(steps)
    observations = rng.normal(size=(steps + 1, layout.observation_size))
    actions = rng.normal(size=(steps, layout.action_size)).astype(np.float32)
    expected = slow_states(observations, actions, layout.length)
    np.testing.assert_array_equal(layout.along(observations, actions), expected)
    state = layout.begin(observations[0])
    for t in range(steps):
        np.testing.assert_array_equal(state, expected[t])
        state = layout.follow(state, actions[t], observations[t + 1])
    np.testing.assert_array_equal(state, expected[-1])
    np.testing.assert_array_equal(layout.newest(expected), observations)
    assert History.of_state(layout.length, layout.state_size, layout.action_size) == layout
    assert sum(size for size, _ in layout.parts) == layout.state_size == len(state)


@given(SIZES)
def test_copies_are_counted_from_where_their_originals_are(sizes):
    layout = History(*sizes)
    first = 1.0 + np.arange(layout.observation_size)
    whole = tied(first, layout.carried)
    observed = layout.length * layout.observation_size
    np.testing.assert_array_equal(whole[:observed], np.tile(first, layout.length))
    np.testing.assert_array_equal(whole[observed:], 0)
    np.testing.assert_array_equal(layout.copies(range(layout.observation_size)), np.arange(observed))


def test_runs_are_the_indices_in_order():
    for indices in ((), (3,), (0, 1, 2), (4, 5, 0, 1, 9), LAYOUT.carried):
        assert tuple(i for part in runs(indices) for i in range(10)[part]) == tuple(i for i in indices if i < 10)


@pytest.mark.parametrize(("length", "size"), [(2, 5), (3, 4), (4, 2)])
def test_a_state_that_holds_no_such_history_is_refused(length, size):
    said = f"expected a state of {length} observations and {length - 1} actions of 2, got {size} numbers"
    with pytest.raises(ValueError, match=said):
        History.of_state(length, size, 2)
    with pytest.raises(TaskError, match="Odd: history: expected a state of"):
        dataclasses.replace(probe.PROBE, name="Odd", state_size=5, action_size=2, history=2)


# ---------------------------------------------------------------- learning


def explored(task, steps=400):
    rng = np.random.default_rng(0)
    return collection.collect(task, lambda rng: lambda state: rng.uniform(-1, 1, 2), steps, rng)


def unexplained(task, episodes):
    """Of the changes that models are to predict: what a linear model leaves, over what there is."""
    rows = dataset.append(
        dataset.empty(task.state_size, 2, task.predicted).train, episodes, 10_000, task.learned, None, task.carried
    )
    inputs = np.column_stack([rows.states, rows.actions, np.ones(len(rows.states))]).astype(np.float64)
    best = np.linalg.lstsq(inputs, rows.deltas.astype(np.float64), rcond=None)[0]
    return np.sqrt(np.mean((inputs @ best - rows.deltas) ** 2) / np.mean((rows.deltas - rows.deltas.mean(0)) ** 2))


def test_late_actions_can_be_predicted_from_a_history_and_not_without():
    assert unexplained(late.LATE, explored(late.LATE)) > 0.7
    assert unexplained(with_history(late.LATE, 2), explored(with_history(late.LATE, 2))) > 0.7, "one action too few"
    assert unexplained(SEEN, explored(SEEN)) < 1e-5


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_imagination_with_the_true_models_is_reality(sampling):
    simulator = Simulator(late.true_models(5), SEEN.reward, None, SEEN.horizon, sampling=sampling)
    starts = collection.reset_states(SEEN, 1, np.random.default_rng(0)).astype(np.float32)
    mean = partial(gaussian.mean, POLICY)
    episode = next(collection.play(SEEN, lambda _: mean, [np.random.default_rng(0)]))
    rollouts, _ = jax.jit(lambda s, k: imagine(simulator, lambda s, _: gaussian.mean(POLICY, s), s, k))(
        starts, jax.random.key(0)
    )
    np.testing.assert_allclose(rollouts.states[:, 0], episode.states[:-1], atol=1e-4)
    np.testing.assert_allclose(rollouts.last[0], episode.states[-1], atol=1e-4)
    states, actions = np.asarray(rollouts.states[:, 0]), np.clip(rollouts.actions[:, 0], -1, 1)
    carried = np.concatenate([states, actions], axis=1)[:-1, list(LAYOUT.carried)]
    np.testing.assert_array_equal(states[1:, 2:], carried, "nothing but the newest observation is predicted")
    if sampling == "step_rand":
        values = jax.jit(lambda s: returns_per_model(simulator, partial(gaussian.mean, POLICY), s))(starts)
        np.testing.assert_allclose(values, [episode.rewards.sum()] * 5, rtol=1e-4)


def test_diagnostics_of_the_true_models_find_no_error_and_speak_of_observations():
    rows = dataset.append(dataset.empty(10, 2, 2).train, explored(SEEN), 10_000, (), None, SEEN.carried)
    found = diagnose(late.true_models(), POLICY, rows, rows, SEEN.horizon, jax.random.key(0))
    assert {len(errors) for errors in found.errors.values()} == {2}
    assert all(errors.max() < 1e-3 for errors in found.errors.values())
    noisy = late.true_models()
    worse = noisy._replace(networks=((noisy.networks[0][0] * 0, noisy.networks[0][1]),))
    again = diagnose(worse, POLICY, rows, rows, SEEN.horizon, jax.random.key(0))
    np.testing.assert_allclose(again.errors[1], 1.0, rtol=1e-5)


# ---------------------------------------------------------------- a run

BRIEF = probe.BRIEF | {
    "history": 3,
    "iterations": 2,
    "ensemble.hidden": (),
    "fit.max_steps": 1500,
    "fit.batch_size": 50,
}
BRIEF |= {"fit.learning_rate": 0.02, "fit.patience": 300}
BRIEF |= {"collect.noise_correlation": 0.0}  # noise that lasts tells the blind what they did not see


def config(task="Late", **settings):
    return override(dataclasses.replace(preset("Swimmer"), task=task), {**BRIEF, **settings})


def result(run_dir):
    names = ("policy.npz", "policy.json", "metrics.csv", "config.json", "checkpoints/iteration-00002.npz")
    return [(run_dir / name).read_bytes() for name in names]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("history") / "run"
    train(config(), run_dir)
    return run_dir


@pytest.mark.slow
def test_a_run_learns_what_comes_late(whole, tmp_path):
    train(config(history=1), tmp_path)
    blind, seeing = (read_metrics(run / "metrics.csv")[-1] for run in (tmp_path, whole))
    assert blind["error_1"] > 0.5
    assert seeing["error_1"] < 0.1
    assert seeing["error_T"] < 0.2 < blind["error_T"]


def test_its_steps_one_at_a_time_are_the_loop_byte_for_byte(whole, tmp_path):
    external.begin(config(), tmp_path)
    for _ in range(2):
        external.collect(tmp_path)
        external.improve(tmp_path)
    assert result(tmp_path) == result(whole)


def test_it_resumes_byte_for_byte_with_episodes_that_wait(whole, tmp_path):
    train(dataclasses.replace(config(), iterations=1), tmp_path)
    external.collect(tmp_path, at_least=40)
    arrays, _ = read_arrays(sorted((tmp_path / "episodes").glob("*.npz"))[-1])
    assert arrays["states"].shape == (probe.HORIZON + 1, 2), "files hold what was observed"
    train(config(), tmp_path)
    assert result(tmp_path) == result(whole)


def played(act, seed, env=None, steps=probe.HORIZON):
    """Plain observations, actions and rewards of a plain environment under a policy that remembers by itself."""
    env = env or late.LATE.make_env()
    observations, actions, rewards = [env.reset(seed=seed)[0]], [], []
    for _ in range(steps):
        actions.append(act(observations[-1]))
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(actions), np.array(rewards)


def test_another_program_hands_over_what_it_observed(whole, tmp_path):
    external.begin(config("LateElsewhere"), tmp_path)
    policy, rng = load_policy(tmp_path), np.random.default_rng(0)
    expected = []
    for seed in range(4):
        policy.reset()
        noisy = lambda o: policy.limited(policy.unlimited(o) + rng.standard_normal(2))  # noqa: E731
        observations, actions, rewards = played(noisy, seed)
        append_episode(tmp_path, observations, actions, rewards, terminated=False)
        expected.append(slow_states(observations, actions, 3))
    with pytest.raises(TaskError, match=r"states: expected \[21, 2\], got shape \[21, 10\]"):
        append_episode(tmp_path, expected[0], actions, rewards, terminated=False)
    log = EpisodeLog(tmp_path)
    log.layout = LAYOUT
    for episode, states in zip(log.pending(), expected, strict=True):
        np.testing.assert_array_equal(episode.states, states)
    row = external.improve(tmp_path)
    assert row["real_steps"] == 80
    assert row["error_1"] < 0.1


def test_a_log_of_observations_becomes_states(tmp_path):
    episodes = explored(late.LATE, 40)
    log = {name: np.concatenate([getattr(e, name) for e in episodes]) for name in ("actions", "rewards")}
    log["states"], log["next_states"] = (
        np.concatenate([e.states[rows] for e in episodes]) for rows in (np.s_[:-1], np.s_[1:])
    )
    np.savez(tmp_path / "log.npz", **log, terminated=np.zeros(len(log["rewards"])))
    found = offline_data.load(tmp_path / "log.npz", SEEN)
    for episode, plain in zip(found, episodes, strict=True):
        np.testing.assert_allclose(episode.states, slow_states(plain.states, plain.actions, 3), rtol=1e-6)
    external.begin(config("LateElsewhere"), tmp_path / "run")
    for _ in range(2):  # the second time, all of it waits already
        waiting = external.collect(tmp_path / "run", data=tmp_path / "log.npz")
        assert [len(e.rewards) for e in waiting] == [20, 20]
        np.testing.assert_array_equal(waiting[1].states, found[1].states)


def test_evaluation_and_video_play_the_history(whole, monkeypatch):
    policy, returns = load_policy(whole), []
    for seed in (int(s) for s in np.random.default_rng(5).integers(2**31, size=1)):
        policy.reset()
        returns.append(played(policy, seed)[2].sum())
    np.testing.assert_allclose(evaluate(whole, episodes=1, seed=5).returns, returns, rtol=1e-6)
    np.testing.assert_allclose(evaluate(policy, episodes=1, seed=5).returns, returns, rtol=1e-6)
    seen = []

    def record(make_env, policy, path, seed):
        seen.extend(played(policy, seed, make_env())[1])
        return path

    monkeypatch.setattr(evaluation, "record", record)
    evaluation.render(whole, seed=7)
    policy.reset()
    np.testing.assert_array_equal(seen, played(policy, 7)[1])


@pytest.mark.parametrize("method", ["trpo", "svg", "ppo"])
def test_other_systems_learn_from_the_same_states(method, tmp_path):
    if method == "ppo":
        pytest.importorskip("stable_baselines3")
    settings = {"method": method, "iterations": 1, "collect.steps": 40, "svg.model_steps": 3}
    state = train(config(**settings), tmp_path)
    assert state.policy.layers[0][0].shape[0] == LAYOUT.state_size
    assert load_policy(tmp_path).info.history == 3
    assert evaluate(tmp_path, episodes=1).mean == pytest.approx(evaluate(tmp_path, episodes=1).mean)


# ---------------------------------------------------------------- the setting


def test_the_command_line_and_old_configs():
    assert parse(["train", "Late", "--history", "3", "--trust-reward"]).config.history == 3
    old = to_json(Config("Late")).replace('  "history": 1,\n', "")
    assert '"history"' not in old
    assert from_json(old).history == 1
    assert task_for(config()) is task_for(config()), "compiled code knows a task by its identity"
    assert task_for(config(history=1)) is registry.get_task("Late")


@pytest.mark.parametrize(
    ("length", "said"),
    [("0", "history: expected at least 1, got 0"), ("5000", "history: expected at most 1000 for Late, got 5000: 5000")],
)
def test_a_history_that_cannot_be_is_refused_in_plain_words(length, said, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("metrpo.run.machine.prepare", lambda *_, **__: None)
    command = ["train", "Late", "--trust-reward", "--history", length, "--run-dir", str(tmp_path / "run")]
    assert main.main(command) == 2
    assert said in capsys.readouterr().err


def test_the_most_that_a_state_may_hold():
    assert with_history(late.LATE, 1000).state_size == 3998
    with pytest.raises(ConfigError, match="at most 1000 for Late"):
        with_history(late.LATE, 1001)


# ---------------------------------------------------------------- the policy's file


def a_policy(directory, limits=(1.0, None), origin=None):
    settings = Config("Late", history=3, max_action=limits[0], max_change=limits[1])
    save_policy(directory, POLICY, "Late", Learned(1, 20, None), origin=origin, settings=settings)
    return directory


ORIGIN = tied(np.array([1e8, 0.0]), LAYOUT.carried)


@pytest.mark.parametrize("limits", [(1.0, None), (0.6, 0.25)], ids=["free", "held"])
@pytest.mark.parametrize("origin", [None, ORIGIN], ids=["near", "far"])
@pytest.mark.parametrize("ending", [".npz", ".py", ".onnx"])
def test_every_form_sees_the_same_states(ending, origin, limits, tmp_path):
    rng, shift = np.random.default_rng(0), np.zeros(2) if origin is None else origin[:2]
    observations = rng.normal(size=(8, 2)).astype(np.float32).astype(np.float64) + shift
    most, change = limits
    state, before, expected, states = None, np.zeros(2, np.float32), [], []
    for observation in observations:
        state = LAYOUT.begin(observation) if state is None else LAYOUT.follow(state, before, observation)
        wanted = gaussian.mean(POLICY, (state if origin is None else state - origin).astype(np.float32))
        wanted = np.clip(np.clip(wanted, -1, 1), -most, most)
        before = wanted if change is None else np.clip(wanted, before - change, before + change)
        expected.append(before)
        states.append(state)
    path = export(a_policy(tmp_path, limits, origin), tmp_path / f"held{ending}")
    if ending == ".onnx":
        session = pytest.importorskip("onnxruntime").InferenceSession(str(path), providers=["CPUExecutionProvider"])
        kind = np.float32 if origin is None else np.float64
        inputs = {"state": np.array(states, kind)}
        if change is not None:
            inputs["previous_action"] = np.array([[0, 0], *expected[:-1]], np.float32)
        np.testing.assert_allclose(session.run(["action"], inputs)[0], expected, atol=1e-5)
        said = session.get_inputs()[0]
        assert said.name == "state"
        return
    act, reset = act_and_reset(path)
    for _ in range(2):
        np.testing.assert_allclose([act(o) for o in observations], expected, atol=1e-5)
        reset()
    many = [act(np.array([o, observations[-1]])) for o in observations]
    np.testing.assert_allclose([actions[0] for actions in many], expected, atol=1e-5)
    with pytest.raises(ValueError, match=r"as in the step before|call reset\(\) first"):
        act(observations[0])
    reset()
    act(observations[0])
    with pytest.raises(ValueError, match=r"expected finite numbers, got nan at \[1\]"):
        act([shift[0], np.nan])
    np.testing.assert_allclose(act(observations[1]), expected[1], atol=1e-5, err_msg="what is refused is not kept")


def test_an_onnx_says_the_layout_of_its_states(tmp_path):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(export(a_policy(tmp_path), tmp_path / "late.onnx"))
    text = model.graph.input[0].doc_string
    assert "the observation now (2), the observation 1 step before (2), the observation 2 steps before (2)" in text
    assert "the action 1 step before, in [-1, 1] (2), the action 2 steps before, in [-1, 1] (2)" in text


def test_an_exported_file_checks_two_episodes_of_itself(tmp_path):
    path = export(a_policy(tmp_path))
    command = [sys.executable, "-I", str(path)]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.stdout == "ok: 'Late', observations of 2 numbers, actions of 2\n", ran.stderr
    assert "last 3 observations and the 2 actions between them" in path.read_text()
    for old, new in (("before[..., _CARRIED]", "before[..., _CARRIED[::-1]]"), ("    _last.clear()", "    pass")):
        broken = tmp_path / "broken.py"
        broken.write_text(path.read_text().replace(old, new))
        ran = subprocess.run([*command[:2], str(broken)], capture_output=True, text=True)
        assert "expected the actions" in ran.stderr


def test_an_action_of_ones_own_is_what_the_next_state_holds(tmp_path):
    export(a_policy(tmp_path))
    policy, module = load_policy(tmp_path), module_of(tmp_path / "policy.py")
    observations, own = np.random.default_rng(1).normal(size=(2, 2)), np.array([0.3, -0.9], np.float32)
    state = LAYOUT.follow(LAYOUT.begin(observations[0]), own, observations[1])
    expected = policy.of_state(state)
    policy.unlimited(observations[0])
    with pytest.raises(ValueError, match=r"expected an action of shape \[2\] since the one before, got none"):
        policy.unlimited(observations[1])
    policy.limited(own)
    np.testing.assert_allclose(policy(observations[1]), expected, atol=1e-6)
    module.act(observations[0])
    module.limited(own)
    np.testing.assert_allclose(module.act(observations[1]), expected, atol=1e-6)


@pytest.mark.parametrize("value", [0, 2.0, "3", None])
def test_a_policys_file_with_an_impossible_history_is_refused(value, tmp_path):
    a_policy(tmp_path)
    arrays, meta = read_arrays(tmp_path / "policy.npz")
    write_arrays(tmp_path / "policy.npz", arrays, {**meta, "policy": {**meta["policy"], "history": value}})
    with pytest.raises(RunDirectoryError, match="history: expected a whole number above 0"):
        load_policy(tmp_path)


def test_methods_begin_with_states_of_the_whole_size():
    assert training.init(config()).dataset.train.deltas.shape == (0, 2)
    assert training.init(config(learn_reward=True)).dataset.train.deltas.shape == (0, 4)
