"""Observations of another scale or with an offset: learned as well as plain ones, and acted on wherever a policy is."""

from __future__ import annotations

import dataclasses
import runpy
import shutil

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probe
from helpers import random_ensemble, random_policy
from metrpo import algorithm, scales, training
from metrpo.config import CollectConfig, Config
from metrpo.errors import RunDirectoryError
from metrpo.model import ensemble as ensembles
from metrpo.model.diagnostics import unknown
from metrpo.model.ensemble import Ensemble
from metrpo.model.fit import FitInfo
from metrpo.policy_phase import PhaseInfo
from metrpo.presets import override, preset
from metrpo.run import derived_files
from metrpo.run.checkpoint import load_state, save_state
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.stages import policy_search, records
from metrpo.types import Episode
from metrpo.world import dataset as datasets
from metrpo.world import registry
from metrpo.world.history_env import with_history
from metrpo.world.interface import Interface
from metrpo.world.origin import origin_of, relative, shifted
from metrpo.world.resolve import task_of

FAR = np.array([1e8, 0.0])
CONFIG = CollectConfig()


class Seen(gymnasium.ObservationWrapper):
    """The probe as seen by a sensor of another scale and with an offset."""

    def __init__(self, scale, offset):
        super().__init__(gymnasium.wrappers.TimeLimit(probe.ProbeEnv(), probe.HORIZON))
        self.scale, self.offset = scale, offset

    def observation(self, observation):
        return observation * self.scale + self.offset


def seen(scale, offset):
    """The task of the probe seen so; its formula undoes it."""

    def plain(state):
        return (state - offset) / scale

    def reward(state, action, next_state):
        return probe.reward(plain(state), action, plain(next_state))

    return task_of(lambda **_: Seen(scale, offset), reward, None, name=f"Seen{scale:g}{offset:+g}")


@pytest.fixture
def known(monkeypatch):
    """Makes a task known by its name for this test."""

    def add(task):
        monkeypatch.setitem(registry._TASKS, task.name, task)
        return task

    return add


def episode(offset=0.0, length=30, seed=0, size=2):
    states = np.cumsum(0.1 * np.random.default_rng(seed).standard_normal((length + 1, size)), axis=0) + offset
    actions = np.zeros((length, 1), np.float32)
    return Episode(states, actions, np.zeros(length, np.float32), False)


def dataset_of(episodes, old=None):
    old = old or datasets.empty(episodes[0].states.shape[1], 1)
    return datasets.add(old, episodes, CONFIG, np.random.default_rng(0))


def test_of_a_history_the_newest_observation_alone_is_spoken_of():
    task = with_history(dataclasses.replace(probe.PROBE, name="Coarse"), 3)
    plain = episode(np.array([0.0, 1e6]), size=2)
    plain = plain._replace(actions=np.zeros((30, 2), np.float32))
    whole = plain._replace(states=task.layout.along(plain.states, plain.actions))
    nothing = datasets.empty(task.state_size, 2, task.predicted)
    found = datasets.add(nothing, [whole], CONFIG, np.random.default_rng(0), carried=task.carried)
    loud = found._replace(train=found.train._replace(states=found.train.states + np.float32(2e5)))
    for episodes in ([whole], []):  # from the episodes themselves, and from the dataset alone
        said = {f.dimensions for f in scales.findings(Config("Coarse"), task, loud, episodes)}
        assert (0, 1) in said, "which explode"
        assert {d for dimensions in said for d in dimensions} == {0, 1}


# ---------------------------------------------------------------- the origin


def test_the_origin_is_the_mean_of_dimensions_far_from_0():
    states = episode(np.array([1e8, 3.0, 0.0, 5000.0]), size=4).states
    states[:, 2] = 7.0  # does not vary
    origin = origin_of(states)
    np.testing.assert_array_equal(origin[[1, 2]], 0)
    np.testing.assert_allclose(origin[[0, 3]], states.mean(0)[[0, 3]], rtol=1e-15)


def test_an_offset_costs_the_dataset_no_digits():
    """In float32 the states around 1e8 would lie 8 apart."""
    plain, far = dataset_of([episode(), episode(seed=1)]), dataset_of([episode(FAR), episode(FAR, seed=1)])
    for t, exact in ((far.train, plain.train), (far.validation, plain.validation)):
        moved = (far.origin - FAR) * [1, 0]
        np.testing.assert_allclose(t.states + moved, exact.states, atol=1e-6)
        np.testing.assert_allclose(t.deltas, exact.deltas, atol=1e-6)
    np.testing.assert_allclose(far.starts + moved, plain.starts, atol=1e-6)


def test_without_an_offset_everything_is_as_float32_has_it():
    exact = episode()
    for e in (exact, exact._replace(states=exact.states.astype(np.float32))):
        found = dataset_of([e])
        single = exact.states.astype(np.float32)
        assert not found.origin.any()
        np.testing.assert_array_equal(found.train.states, single[:-1])
        np.testing.assert_array_equal(found.train.deltas, np.diff(single, axis=0))
        assert {x.dtype for x in found.train[:3]} == {np.dtype(np.float32)}


def test_the_first_data_decide_the_origin_of_later_ones():
    first = dataset_of([episode(FAR)])
    later = dataset_of([episode(2 * FAR, seed=1)], first)
    np.testing.assert_array_equal(later.origin, first.origin)
    assert later.train.states[-1, 0] == pytest.approx(1e8, rel=1e-6)
    started = dataset_of([episode()])
    assert not dataset_of([episode(FAR)], started).origin.any()


def test_formulas_get_real_states_in_float64():
    task, origin = seen(1, 1e8), np.array([1e8, 1e8])
    moved = shifted(task, origin)
    states, actions = jnp.array([[0.3, -0.2], [0.5, 0.7]]), jnp.zeros((2, 2))
    paid = jax.jit(moved.reward)(states, actions, states)
    np.testing.assert_allclose(paid, -(np.asarray(states) ** 2).sum(1), rtol=1e-5)
    assert paid.dtype == np.float32
    assert shifted(task, origin.copy()) is moved, "another object would be compiled anew"
    assert shifted(task, 0 * origin) is task
    ends = dataclasses.replace(task, terminated=lambda s: s[..., 0] > 1e8 + 0.4)
    np.testing.assert_array_equal(jax.jit(shifted(ends, origin).terminated)(states), [False, True])


# ---------------------------------------------------------------- policies and files


def test_a_stored_and_an_exported_policy_count_from_the_origin(tmp_path):
    policy, rng = random_policy(0, 2, 1), np.random.default_rng(0)
    near = rng.standard_normal((20, 2))
    save_policy(tmp_path / "near", policy, "Seen", Learned(1, 20, None))
    save_policy(tmp_path / "far", policy, "Seen", Learned(1, 20, None), origin=FAR)
    expected = load_policy(tmp_path / "near")(near)
    assert np.ptp(expected) > 0.1, "actions that do not differ could not tell"
    loaded = load_policy(tmp_path / "far")
    np.testing.assert_allclose(loaded(near + FAR), expected, atol=1e-6)
    np.testing.assert_allclose(loaded(near[0] + FAR), expected[0], atol=1e-6)
    act = runpy.run_path(str(export(tmp_path / "far")))["act"]
    np.testing.assert_allclose(act(near + FAR), expected, atol=1e-6)
    runpy.run_path(str(tmp_path / "far" / "policy.py"), run_name="__main__")  # its own check
    for refused in (np.zeros(3), [np.nan, 0], [1e300, 0]):
        for use in (loaded, act):
            with pytest.raises(ValueError, match="observation: expected"):
                use(refused)


def test_an_onnx_policy_takes_float64_where_there_is_an_origin(tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    save_policy(tmp_path, random_policy(0, 2, 1), "Seen", Learned(1, 20, None), origin=FAR)
    far = np.random.default_rng(0).standard_normal((20, 2)) + FAR
    session = runtime.InferenceSession(str(export(tmp_path, tmp_path / "p.onnx")), providers=["CPUExecutionProvider"])
    found = session.run(["action"], {"observation": far})[0]
    np.testing.assert_allclose(found, load_policy(tmp_path)(far), atol=1e-5)


def test_a_policy_without_an_origin_is_stored_as_ever(tmp_path):
    save_policy(tmp_path, random_policy(0, 2, 1), "Seen", Learned(1, 20, None), origin=np.zeros(2))
    assert "origin" not in read_arrays(tmp_path / "policy.npz")[0]
    assert "_ORIGIN" not in export(tmp_path).read_text()


@pytest.mark.parametrize("origin", [np.zeros(3), np.float32([1, 2]), np.array([np.inf, 0])])
def test_an_origin_that_does_not_fit_is_refused(tmp_path, origin):
    save_policy(tmp_path, random_policy(0, 2, 1), "Seen", Learned(1, 20, None))
    arrays, meta = read_arrays(tmp_path / "policy.npz")
    write_arrays(tmp_path / "policy.npz", arrays | {"origin": origin}, meta)
    with pytest.raises(RunDirectoryError, match=r"origin|finite weights"):
        load_policy(tmp_path)


def test_an_old_checkpoint_has_no_origin_another_size_is_refused(tmp_path):
    path = tmp_path / "state.npz"
    state = algorithm.State(*[0] * 6, datasets.empty(2, 1), 0)
    save_state(path, state, {})
    arrays, meta = read_arrays(path)
    assert arrays[".dataset.origin"].dtype == np.float64
    old = {n: a for n, a in arrays.items() if n != ".dataset.origin"}
    assert len(old) == len(arrays) - 1
    write_arrays(path, old, meta)
    np.testing.assert_array_equal(load_state(path, state)[0].origin, [0, 0])
    write_arrays(path, arrays | {".dataset.origin": np.zeros(5)}, meta)
    with pytest.raises(RunDirectoryError, match="origin of shape"):
        load_state(path, state)


def test_an_episode_keeps_its_digits_and_an_old_one_is_read(tmp_path):
    log = EpisodeLog(tmp_path)
    (tmp_path / "episodes").mkdir()
    exact = episode(FAR)
    log.append(exact)
    log.append(exact._replace(states=exact.states.astype(np.float32)))
    new, old = EpisodeLog(tmp_path).pending()
    np.testing.assert_array_equal(new.states, exact.states)
    np.testing.assert_array_equal(old.states, exact.states.astype(np.float32))
    log.append(exact._replace(states=1e300 * exact.states))
    with pytest.raises(RunDirectoryError, match="finite numbers"):
        EpisodeLog(tmp_path).pending()


# ---------------------------------------------------------------- the loop


def learn_at_once(monkeypatch):
    """Instead of what has to be compiled: a fit and a policy that depend on the dataset's states and origin alone."""
    two = np.zeros(2)

    def fit(config, task, networks, dataset, iteration, progress, steps):
        normaliser = ensembles.normaliser_of(dataset.train, 1e-8, 1e-8, task.unseen)
        return Ensemble(networks, normaliser), FitInfo(1, two, two, two, two > 1, two > 1)

    def improve(config, task, state, *_):
        dataset = state.dataset
        weights, bias = state.policy.layers[-1]
        seen = dataset.train.states.std() + (dataset.origin - [1e8, 1e8]).sum()
        layers = (*state.policy.layers[:-1], (weights, np.asarray(bias) + np.float32(seen)))
        info = PhaseInfo(two, 5, 1, 0, 1, two, 0.0, 0.0)
        return state.policy._replace(layers=layers), state.baseline, info

    def networks(config, task, key):
        return random_ensemble(0, 2, task.state_size, task.action_size).networks

    monkeypatch.setattr(algorithm, "fresh_networks", networks)
    monkeypatch.setattr(policy_search.gaussian, "init", lambda key, s, a, hidden, std: random_policy(0, s, a, hidden))
    monkeypatch.setattr(policy_search, "init_baseline", lambda *_: np.zeros(1, np.float32))
    monkeypatch.setattr(algorithm, "fit_ensemble", fit)
    monkeypatch.setattr(algorithm, "improve_policy", improve)
    monkeypatch.setattr(records, "_diagnosis", lambda _, task, *rest: unknown(task.state_size, probe.HORIZON))


@pytest.mark.parametrize("learns", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_run_with_an_offset_resumes_byte_for_byte(tmp_path, known, monkeypatch, learns):
    if not learns:
        learn_at_once(monkeypatch)
    monkeypatch.setattr(derived_files, "draw_curve", lambda *_: None)
    said, task = [], known(seen(1, 1e8))
    monkeypatch.setattr(scales, "warn", lambda config, task, *_: said.append(task.name))
    config = override(dataclasses.replace(preset(task.name), iterations=2), probe.BRIEF)
    training.train(config, tmp_path / "whole")
    assert said == [task.name], "in the first iteration only"
    parts = shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    newest = "checkpoints/iteration-00002.npz"
    (parts / newest).unlink()
    training.train(config, parts)
    assert (parts / newest).read_bytes() == (tmp_path / "whole" / newest).read_bytes()
    assert said == [task.name]
    stored = load_policy(tmp_path / "whole")
    assert stored.origin == pytest.approx([1e8, 1e8])
    state = load_state(parts / newest, training.init(config))[0]
    # The record was earned by the policy in the file, counted from its origin.
    earned = records.evaluate(config, task, state.policy, 2, origin=state.origin).mean()
    assert earned == pytest.approx(stored.info.return_real, rel=1e-6)


LEARN = {
    "collect.steps": 200,
    "fit.max_steps": 1500,
    "imagine.steps": 2000,
    "iterations": 3,
    "policy.initial_std": 0.5,
    "trust_reward": True,
    "validate.max_updates": 40,
}


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "offset"), [(1, 0), (1e-3, 0), (1, 5000), (1, 1e8)])
def test_the_probe_is_learned_whatever_its_scale_and_offset(known, scale, offset):
    task = known(seen(scale, offset))
    config = override(preset(task.name), probe.LEARN | LEARN)
    state = training.init(config)
    for _ in range(config.iterations):
        state, row = training.step(config, state)
    assert row["return_real"] > 1.1 * probe.optimum()


# ---------------------------------------------------------------- what is said


def found_in(offset, scale=1.0, config=None, states=None):
    e = episode()
    e = e._replace(states=e.states * scale + offset if states is None else states)
    task = dataclasses.replace(probe.PROBE, interface=Interface(((1, "o['gps']"), (1, "o['speed']")), (-1,), (1,)))
    return scales.findings(config or preset("Swimmer"), task, dataset_of([e]), [e]), task


def test_usual_observations_and_small_offsets_give_no_warning():
    for offset, scale in ((0, 1), (1e8, 1), (0, 1e-6), (5000, 1e-3)):
        assert found_in(offset, scale) == ([], found_in(0)[1])
    assert found_in(0, config=preset("Swimmer", "paper"))[0] == []


def test_what_float32_cannot_tell_apart_is_named(caplog):
    drifting = np.column_stack([np.linspace(0, 1e7, 31) + 1e-3 * np.arange(31) % 2, np.linspace(0, 1, 31)])
    drifting[:, 0] = np.where(np.arange(31) < 15, 0, 1e7) + 1e-3 * np.arange(31)
    still = np.concatenate([np.diff(drifting[:15, 0]), np.diff(drifting[16:, 0])])
    assert np.abs(still).max() < 1e-2
    e = episode()
    far, near = e._replace(states=drifting[15:]), e._replace(states=drifting[:15])
    far, near = (x._replace(actions=e.actions[:n], rewards=e.rewards[:n]) for x, n in ((far, 15), (near, 14)))
    task = found_in(0)[1]
    scales.warn(preset("Swimmer"), task, dataset_of([near, far]), [near, far])
    assert "dimension 0 (number 0 of o['gps']): float32 cannot tell one step's states apart" in caplog.text
    assert "speed" not in caplog.text


def test_an_environment_that_rounds_to_float32_itself_is_named():
    rounded = (episode().states + 1e6).astype(np.float32)
    (found,), _ = found_in(0, states=rounded)
    assert found.dimensions == (0, 1)
    assert "the environment gives float32" in found.why
    assert found_in(1e6)[0] == [], "in float64 nothing is lost"


def test_states_beyond_what_imagination_takes_are_named():
    (found,), _ = found_in(0, 1e8)
    assert "count as diverged" in found.why


@pytest.mark.parametrize(("scale", "settings"), [(1e-3, {"policy.normalise"}), (1e4, {"policy.normalise"})])
def test_a_policy_that_sees_states_as_they_are_says_so(scale, settings):
    found, _ = found_in(0, scale, preset("Swimmer", "paper"))
    advice = " ".join(f.advice for f in found)
    assert settings <= set(advice.replace(",", "").split())
    assert ("std_floor" in advice) == (scale < 1), "which hides small ones from the models"


def test_the_record_counts_the_dimensions_that_are_named(monkeypatch):
    rounded = episode()._replace(states=(episode().states + 1e6).astype(np.float32))
    plain = preset("Swimmer")
    assert scales.count(plain, probe.PROBE, dataset_of([rounded]), [rounded]) == 2
    assert scales.count(plain, probe.PROBE, dataset_of([episode()]), [episode()]) == 0


def test_relative_leaves_states_without_an_origin_alone():
    states = np.zeros((3, 2), np.float32)
    assert relative(states, np.zeros(2)) is states
