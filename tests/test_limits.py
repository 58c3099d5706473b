"""Limits of actions: in collection, imagination, evaluation, and wherever the policy's file is used."""

import dataclasses
import importlib
from functools import partial

import jax
import numpy as np
import pytest

import probe
from exported import act_and_reset, module_of
from helpers import linear_ensemble, random_policy
from metrpo import evaluate, training
from metrpo.config import Config
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.limits import Limits
from metrpo.model.imagine import Simulator, imagine, returns_per_model
from metrpo.policy import gaussian
from metrpo.presets import override, preset
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.world import batch_episodes, collection
from metrpo.world.registry import get_task, limited, task_for
from places import ROOT

BOTH = Limits(0.6, 0.25)
LOUD = random_policy(0, 2, 2, scale=9.0)


def are_within(actions, limits=BOTH):
    steps = np.diff(np.concatenate([np.zeros_like(actions[:1]), actions]), axis=0)
    return abs(actions).max() <= limits.max_action + 1e-6 and abs(steps).max() <= limits.max_change + 1e-6


def test_collection_holds_every_policy_to_them():
    task = limited(probe.PROBE, BOTH)
    rng = np.random.default_rng(0)
    noisy = lambda rng: lambda state: 5 * rng.standard_normal(2)  # noqa: E731
    free, held = (collection.collect(t, noisy, 100, rng) for t in (probe.PROBE, task))
    assert all(are_within(e.actions) for e in held)
    assert not any(are_within(e.actions) for e in free)
    assert max(abs(e.actions).max() for e in held) == np.float32(0.6), "as far as they may go"


@pytest.mark.parametrize("limits", [BOTH, Limits(0.5), Limits(1.0, 0.1)])
def test_side_by_side_is_one_after_another(limits):
    task = limited(get_task("Swimmer"), limits)
    act = partial(gaussian.mean, random_policy(1, task.state_size, task.action_size))
    expected = collection.evaluate(task, act, 3, seed=4)
    np.testing.assert_allclose(batch_episodes.evaluate(task, act, 3, seed=4), expected, rtol=1e-5)
    assert not np.allclose(expected, collection.evaluate(get_task("Swimmer"), act, 3, seed=4))


@pytest.mark.parametrize("limits", [BOTH, Limits(0.5)])
def test_imagination_through_the_true_dynamics_is_the_limited_reality(limits):
    ensemble = linear_ensemble([(probe.A, probe.B)] * 2)
    simulator = Simulator(ensemble, probe.reward, None, probe.HORIZON, limits=limits)
    rng = np.random.default_rng(0)
    starts = np.array([collection.reset_states(probe.PROBE, 1, np.random.default_rng(0))[0]], np.float32)
    mean = partial(gaussian.mean, LOUD)
    real = collection.evaluate(limited(probe.PROBE, limits), lambda s: mean(np.float32(s)), 1, seed=0)
    values = jax.jit(lambda s: returns_per_model(simulator, partial(gaussian.mean, LOUD), s))(starts)
    np.testing.assert_allclose(values, [real[0]] * 2, rtol=1e-3)
    imagined = jax.jit(lambda s, k: imagine(simulator, lambda s, _: gaussian.mean(LOUD, s), s, k))
    _, info = imagined(starts, jax.random.key(rng.integers(9)))
    np.testing.assert_allclose(info.mean_return, real[0], rtol=1e-3)


def test_a_runs_task_and_simulator_have_the_runs_limits():
    config = override(Config("Swimmer"), {"max_action": 0.6, "max_change": 0.25})
    assert task_for(config).limits == BOTH
    assert task_for(config) is task_for(config), "compiled code knows a task by its identity"
    from metrpo.policy_phase import simulator_of

    assert simulator_of(config, task_for(config), linear_ensemble([(probe.A, probe.B)])).limits == BOTH


@pytest.mark.parametrize(("method", "name"), [("svg", "max_action"), ("ppo", "max_action"), ("ddpg", "max_change")])
def test_methods_that_cannot_keep_them_refuse(method, name):
    config = dataclasses.replace(preset("Swimmer"), method=method, **{name: 0.5})
    with pytest.raises(ConfigError, match=f"{name}: expected the system me-trpo or trpo to learn under limits, got"):
        training.init(config)


# ---------------------------------------------------------------- the policy's file


def a_run(directory, limits=BOTH, task="Probe", policy=LOUD):
    settings = Config(task, max_action=limits.max_action, max_change=limits.max_change)
    save_policy(directory, policy, task, Learned(1, 20, None), settings=settings)


@pytest.mark.parametrize("ending", [".npz", ".py", ".onnx"])
def test_every_form_keeps_them_and_forgets_at_reset(ending, tmp_path):
    a_run(tmp_path)
    observations = np.random.default_rng(1).normal(size=(30, 2)).astype(np.float32)
    free = gaussian.mean(LOUD, observations)
    expected, before = [], np.zeros(2)
    for action in free:
        before = np.clip(np.clip(action, -0.6, 0.6), before - 0.25, before + 0.25)
        expected.append(before)
    assert are_within(np.array(expected))
    path = export(tmp_path, tmp_path / f"held{ending}")
    if ending == ".onnx":
        session = pytest.importorskip("onnxruntime").InferenceSession(str(path), providers=["CPUExecutionProvider"])
        found, last = [], np.zeros((1, 2), np.float32)
        for observation in observations:
            last = session.run(["action"], {"observation": observation[None], "previous_action": last})[0]
            found.append(last[0])
        np.testing.assert_allclose(found, expected, atol=1e-5)
        return
    act, reset = act_and_reset(path)
    for _ in range(2):
        np.testing.assert_allclose([act(o) for o in observations], expected, atol=1e-5)
        reset()
    assert act(observations[:5]).shape == (5, 2)
    with pytest.raises(ValueError, match=r"expected shape \[5, 2\] as in the step before"):
        act(observations[0])


def test_noise_of_ones_own_is_held_too(tmp_path):
    a_run(tmp_path)
    policy, rng = load_policy(tmp_path), np.random.default_rng(0)
    actions = [policy.limited(policy.unlimited(rng.normal(size=2)) + 9 * rng.normal(size=2)) for _ in range(50)]
    assert are_within(np.array(actions))
    assert (policy.info.max_action, policy.info.max_change) == (0.6, 0.25)


@pytest.mark.parametrize("ending", [".npz", ".py"])
@pytest.mark.parametrize("history", [1, 2])
def test_what_a_caller_writes_into_an_action_is_not_the_last_one(ending, history, tmp_path):
    """Scaled to a motor in place, or with noise added: ordinary code."""
    settings = Config("Probe", max_action=0.6, max_change=0.25, history=history)
    policy = random_policy(0, 3 * history - 1, 1, scale=9.0)
    save_policy(tmp_path, policy, "Probe", Learned(1, 20, None), settings=settings)
    path = export(tmp_path, tmp_path / f"held{ending}")
    act, reset = act_and_reset(path)
    observations = np.random.default_rng(1).normal(size=(20, 2)).astype(np.float32)
    expected = [act(observation).copy() for observation in observations]
    reset()
    found = []
    for observation in observations:
        action = act(observation)
        found.append(action.copy())
        action *= 99
    np.testing.assert_array_equal(found, expected)
    assert are_within(np.array(found))


def test_a_last_action_beyond_the_range_does_not_lead_beyond_it():
    """As a log of another controller may hold one."""
    np.testing.assert_array_equal(BOTH.within(np.array([0.9]), np.array([5.0])), [0.6])


@pytest.mark.parametrize("ending", [".npz", ".py"])
@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([np.nan, 0.0], r"action: expected finite numbers, got nan at \[0\]"),
        ([[0.0, 0.0], [0.0, np.inf]], r"action: expected finite numbers, got inf at \[1, 1\]"),
        ([0.0], r"action: expected shape \[2\] or \[B, 2\], got \[1\]"),
        (0.3, r"action: expected shape \[2\] or \[B, 2\], got \[\]"),
    ],
)
def test_an_action_that_is_none_is_refused_and_not_remembered(ending, action, message, tmp_path):
    a_run(tmp_path)
    path = export(tmp_path, tmp_path / f"held{ending}")
    module = load_policy(path) if ending == ".npz" else module_of(path)
    before = module.limited(np.array([0.2, 0.2]))
    with pytest.raises(ValueError, match=message):
        module.limited(action)
    np.testing.assert_allclose(module.limited(np.array([9.0, 9.0])), before + 0.25, atol=1e-6)


def test_without_limits_a_policy_keeps_nothing(tmp_path):
    a_run(tmp_path, Limits())
    policy, rng = load_policy(tmp_path), np.random.default_rng(0)
    for shape in ((2,), (5, 2), (2,)):
        observation = rng.normal(size=shape)
        np.testing.assert_array_equal(policy(observation), policy.unlimited(observation))


def test_evaluate_and_render_play_within_them(tmp_path, monkeypatch):
    played = []
    real = probe.ProbeEnv.step
    monkeypatch.setattr(probe.ProbeEnv, "step", lambda self, a: played.append(np.array(a)) or real(self, a))
    with probe.registered():
        a_run(tmp_path)
        policy = load_policy(tmp_path)
        evaluate(policy, episodes=2)
        assert len(played) == 2 * probe.HORIZON
        assert are_within(np.array(played[: probe.HORIZON]))
        assert are_within(np.array(played[probe.HORIZON :]))
        again = evaluate(tmp_path, episodes=2).returns
        np.testing.assert_array_equal(evaluate(policy, episodes=2).returns, again)


@pytest.mark.parametrize(
    ("name", "value"), [("max_action", 0), ("max_action", 1.5), ("max_change", -1), ("max_change", "1")]
)
def test_limits_that_cannot_be_are_refused(name, value, tmp_path):
    a_run(tmp_path)
    arrays, meta = read_arrays(tmp_path / "policy.npz")
    meta["policy"][name] = value
    write_arrays(tmp_path / "policy.npz", arrays, meta)
    with pytest.raises(RunDirectoryError, match=f"{name}: expected a number above 0"):
        load_policy(tmp_path)


# ---------------------------------------------------------------- the robot's loop


def test_the_robots_loop_counts_the_deadlines_it_misses(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "robot"))
    fixed_rate, robot = importlib.import_module("fixed_rate"), importlib.import_module("robot")
    shows = importlib.import_module("arm").shows
    settings = Config("arm", max_action=0.6, max_change=0.25)
    save_policy(tmp_path, random_policy(0, 3, 1, scale=9.0), "arm", Learned(0, 0, None), shows, settings=settings)
    policy, arm, now, moved = load_policy(tmp_path), robot.Arm(np.random.default_rng(0)), [100.0], []

    def move(torque):
        now[0] += {4: 0.06, 8: 0.26}.get(len(moved), 0.01)  # a period is 0.05
        moved.append((now[0], torque))
        return 1.0

    monkeypatch.setattr(arm, "move", move)
    done = fixed_rate.control(policy, arm, 20, 12, clock=lambda: now[0], sleep=lambda s: now.__setitem__(0, now[0] + s))
    assert (done.steps, done.missed, done.total) == (12, 2, 12.0)
    for wrong, said in ((["--hz", "0"], "--hz: expected a number above 0, got 0"), ([], "holds no policy")):
        monkeypatch.setattr("sys.argv", ["fixed_rate.py", str(tmp_path if wrong else tmp_path / "none"), *wrong])
        with pytest.raises(SystemExit, match="2"):
            fixed_rate.main()
        assert said in capsys.readouterr().err
    assert done.slowest == pytest.approx(0.26)
    torques = np.array([[torque] for _, torque in moved])
    assert are_within(torques / 4)
    begun = [time - 0.01 for i, (time, _) in enumerate(moved) if i not in (4, 8)]
    np.testing.assert_allclose((np.array(begun) - 100) / 0.05 % 1 % 0.9999, 0, atol=1e-3)
