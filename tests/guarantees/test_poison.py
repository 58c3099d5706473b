"""NaN and infinity never poison a run in silence: each is refused or recovered from, by name, and none is saved."""

from __future__ import annotations

import math
import re
import types
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probe
from helpers import random_policy
from metrpo import algorithm, finite, policy_phase, training
from metrpo.baselines import real_trpo
from metrpo.config import AdvantageConfig, Config
from metrpo.console.progress import SILENT
from metrpo.errors import DivergedError, TaskError
from metrpo.model import fit as fitting
from metrpo.model.imagine import ImagineInfo, Simulator, imagine, returns_per_model
from metrpo.policy.improvers.improver_table import IMPROVERS, init_memory
from metrpo.policy.improvers.settings import PhaseSettings
from metrpo.policy.stopping import RULES, Evidence
from metrpo.policy.value import linear
from metrpo.policy.value.value_table import init_baseline
from metrpo.presets import override
from metrpo.run import derived_files
from metrpo.run.clock import Clock
from metrpo.run.metrics import completed, read_metrics
from metrpo.stages import ensemble_fit, policy_search, records
from metrpo.training import train
from metrpo.types import Trajectories
from metrpo.world import collection as real
from metrpo.world.env_wrapper import Guarded

POISON = [math.nan, math.inf, -math.inf]
TINY = override(
    Config(task="Probe", iterations=3, evaluation_episodes=2, deterministic=True),
    {
        "collect.steps": 80,
        "collect.max_train": 400,
        "collect.max_validation": 200,
        "ensemble.members": 3,
        "ensemble.hidden": (8,),
        "fit.batch_size": 20,
        "fit.learning_rate": 0.01,
        "fit.max_passes": 10,
        "fit.reinitialise_every": 0,
        "imagine.steps": 100,
        "policy.hidden": (4,),
        "validate.max_updates": 5,
        "validate.starts": 4,
    },
)


@pytest.fixture(scope="module", autouse=True)
def _probe_is_a_task():
    with probe.registered(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_measure_yardsticks", lambda *_: None)  # they play as well
        patch.setattr(derived_files, "draw_curve", lambda rows, path, title, *_: path.write_text(f"{len(rows)} rows"))
        yield


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """A whole run that nothing disturbs: its directory, its states, its rows, and what each fit gave."""
    path, states, rows, fits = tmp_path_factory.mktemp("clean") / "run", [], [], []
    learn, fit = algorithm.learn, ensemble_fit.fit

    def watched(*args):
        state, row = learn(*args)
        states.append(state)
        rows.append(row)
        return state, row

    def watched_fit(*args):
        fits.append(fit(*args))
        return fits[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(algorithm, "learn", watched)
        patch.setattr(ensemble_fit, "fit", watched_fit)
        train(TINY, path)
    return types.SimpleNamespace(path=path, states=states, rows=rows, fits=fits)


def content(path):
    """Every file of a run that the clock has no part in."""
    names = ("metrics.csv", "policy.npz", "policy.json", "config.json", "curve.png", "checkpoints/*.npz")
    return {str(f.relative_to(path)): f.read_bytes() for name in names for f in path.glob(name)}


def iterations_on_disk(path):
    """Newest finished iteration; every number of every file of arrays is finite."""
    for file in path.rglob("*.npz"):
        with np.load(file, allow_pickle=False) as arrays:
            for name in arrays.files:
                assert arrays[name].dtype.kind != "f" or np.isfinite(arrays[name]).all(), (file.name, name)
    return max([0, *(int(f.stem[-5:]) for f in path.glob("checkpoints/*.npz"))])


def sound(tree):
    return all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(tree))


def same(one, other):
    return jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b), one, other))


def only(networks, keep):
    return jax.tree.map(lambda x: np.asarray(x)[keep], networks)


# ---------------------------------------------------------------- the real environment


class Sick:
    """Makes the probe give `value`, in its reset or at step `at` of its episode number `episode`."""

    def __init__(self, monkeypatch, what, at, value, episode=0):
        self.episode, self.at = -1, 0
        reset, step = probe.ProbeEnv.reset, probe.ProbeEnv.step

        def sick_reset(env, **kwargs):
            self.episode, self.at = self.episode + 1, 0
            state, info = reset(env, **kwargs)
            hit = what == "observation" and at is None and self.episode == episode
            return (np.array([state[0], value]) if hit else state), info

        def sick_step(env, action):
            state, reward, *rest = step(env, action)
            hit = self.episode == episode and self.at == at
            self.at += 1
            if hit:
                state, reward = (np.array([state[0], value]), reward) if what == "observation" else (state, value)
            return state, reward, *rest

        monkeypatch.setattr(probe.ProbeEnv, "reset", sick_reset)
        monkeypatch.setattr(probe.ProbeEnv, "step", sick_step)


PLACES = [("observation", None), ("observation", 0), ("observation", 17), ("reward", 0), ("reward", 17)]


@pytest.mark.parametrize("value", [*POISON, 1e39, -3e38])
@pytest.mark.parametrize(("what", "at"), PLACES)
def test_a_sick_environment_is_named_with_stage_and_step(clean, monkeypatch, caplog, what, at, value):
    """1e39 is infinite in float32; from -3e38 to 3e38 it is farther than float32 reaches."""
    where = r"reset\(\)" if at is None else f"step {at} of an episode"
    message = f"iteration 2: Probe: {where}: expected finite numbers below 1.7e38 as {what}, got"
    Sick(monkeypatch, what, at, value, episode=2)
    assert len(algorithm.collect(TINY, probe.PROBE, clean.states[0])) == 4, "it is left out, and another one played"
    assert re.match(f"collect, {message}", caplog.messages[0])
    Sick(monkeypatch, what, at, value, episode=1)
    with pytest.raises(TaskError, match=f"^evaluate, {message}"), finite.naming("evaluate", 2):
        records.evaluate(TINY, probe.PROBE, clean.states[0].policy, 2)


@pytest.mark.parametrize("value", [*POISON, 1e39])
@pytest.mark.parametrize(("what", "at"), PLACES)
def test_a_guarded_environment_is_held_to_the_same(monkeypatch, what, at, value):
    Sick(monkeypatch, what, at, value)

    def play():
        guard = Guarded(probe.ProbeEnv(), "Mine", 20)
        task = probe.PROBE.__class__("Mine", None, 2, 2, 20, probe.reward, make=lambda: guard)
        return next(real.play(task, lambda rng: lambda state: np.zeros(2), [np.random.default_rng(0)]))

    where = r"Mine: reset\(\)" if at is None else rf"Mine: step\(\).*\(at step {at} of an episode\)$"
    with pytest.raises(TaskError, match=where):
        play()


@pytest.mark.parametrize(
    ("what", "at", "value", "episode", "stage"),
    [
        ("observation", 17, math.nan, 4, "collect"),  # 4 collected, 2 evaluated in every iteration
        ("reward", 3, math.inf, 7, "collect"),
        ("observation", None, -math.inf, 9, "collect"),
        ("observation", 19, math.nan, 10, "evaluate"),
        ("reward", 0, -math.inf, 11, "evaluate"),
    ],
)
def test_the_run_goes_on_without_what_was_sick(clean, tmp_path, caplog, what, at, value, episode, stage):
    episode += 2 if stage == "collect" and episode < 6 else 0
    with pytest.MonkeyPatch.context() as patch:
        Sick(patch, what, at, value, episode)
        train(TINY, tmp_path)
    assert f"{stage}, iteration 2: " in caplog.text
    assert iterations_on_disk(tmp_path) == 3
    rows, expected = (read_metrics(path / "metrics.csv") for path in (tmp_path, clean.path))
    assert [row["failed_episodes"] for row in rows] == [0, int(stage == "collect"), 0]
    if stage == "evaluate":
        assert math.isnan(rows[1]["return_real"])
        assert str([rows[0], rows[2]]) == str([expected[0], expected[2]]), "a record, and no more"
        assert content(tmp_path)["policy.npz"] == content(clean.path)["policy.npz"]


@pytest.mark.parametrize("stage", ["improve", "validate"])
def test_resets_and_oracles_in_the_policy_phase_name_their_stage(clean, monkeypatch, caplog, stage):
    """A reset is drawn again; a policy that cannot be judged is no improvement."""
    settings = {"imagine.start": "reset"} if stage == "improve" else {"validate.rule": "real"}
    Sick(monkeypatch, "observation", None, math.nan)
    policy, _, _ = in_imagination(clean, clean.fits[1][0], settings)
    assert sound(policy)
    assert caplog.messages[0].startswith(
        "Probe: reset" if stage == "improve" else "iteration 2 has no return_real (val"
    )


# ---------------------------------------------------------------- what a state holds


def poisoned(tree, value, leaf=0, at=0):
    """The tree with `value` in its `leaf`-th array."""
    leaves, structure = jax.tree.flatten(tree)
    array = np.array(leaves[leaf])
    array[np.unravel_index(at, array.shape)] = value
    return jax.tree.unflatten(structure, [*leaves[:leaf], array, *leaves[leaf + 1 :]])


def going_on(clean, state):
    """The second iteration from another state than the undisturbed run's."""
    episodes = algorithm.collect(TINY, probe.PROBE, clean.states[0])
    return algorithm.learn(TINY, probe.PROBE, state, episodes)


@pytest.mark.parametrize("value", POISON)
@pytest.mark.parametrize("part", ["states", "actions", "deltas"])
@pytest.mark.parametrize("split", ["train", "validation"])
def test_poisoned_data_are_named_and_never_learned_from(clean, monkeypatch, split, part, value):
    monkeypatch.setattr(ensemble_fit, "fit", None)
    dataset = clean.states[0].dataset
    rows = getattr(dataset, split)
    rows = rows._replace(**{part: poisoned(getattr(rows, part), value, at=5)})
    named = rf"^collect, iteration 2: dataset\.{split}\.{part}: expected finite numbers, got {value} at \[2, 1\]"
    with pytest.raises(DivergedError, match=named):
        going_on(clean, clean.states[0]._replace(dataset=dataset._replace(**{split: rows})))


@pytest.mark.parametrize("value", POISON)
def test_a_poisoned_policy_is_named_before_anything_is_saved(clean, value):
    first, last = (clean.states[0]._replace(policy=poisoned(clean.states[0].policy, value, leaf)) for leaf in (0, 3))
    if math.isnan(value):
        for state in (first, last):
            with pytest.raises(
                DivergedError, match=r"^collect, iteration 2: Probe: step 0 .* expected numbers as action"
            ):
                algorithm.collect(TINY, probe.PROBE, state)
    with pytest.raises(
        DivergedError, match=rf"^improve, iteration 2: policy\.layers\[1\]\[1\]: .* got {value} at \[0\]"
    ):
        going_on(clean, last)


@pytest.mark.parametrize("value", POISON)
def test_a_poisoned_linear_baseline_costs_one_update(clean, value):
    state, row = going_on(clean, clean.states[0]._replace(baseline=poisoned(clean.states[0].baseline, value, at=7)))
    assert sound(state)
    assert row["rejected_steps"] == clean.rows[1]["rejected_steps"] + 1
    assert not same(state.policy, clean.states[0].policy), "the other updates were made"


def test_what_no_stage_has_noticed_is_not_saved(clean, tmp_path, monkeypatch):
    improve = algorithm.improve_policy

    def spoilt(config, task, state, *rest):
        policy, baseline, info = improve(config, task, state, *rest)
        return (policy, poisoned(baseline, math.nan, at=3), info) if state.iteration == 1 else (policy, baseline, info)

    monkeypatch.setattr(algorithm, "improve_policy", spoilt)
    with pytest.raises(
        DivergedError, match=r"^improve, iteration 2: baseline: expected finite numbers, got nan at \[3\]"
    ):
        train(TINY, tmp_path)
    assert iterations_on_disk(tmp_path) == 1
    monkeypatch.undo()
    train(TINY, tmp_path)
    assert content(tmp_path) == content(clean.path)


@pytest.mark.parametrize("value", POISON)
def test_the_other_methods_are_checked_as_they_end_an_iteration(monkeypatch, tmp_path, value):
    config = override(TINY, {"method": "trpo"})

    def step(config, task, state, progress):
        return state._replace(iteration=1, policy=poisoned(state.policy, value)), {}

    monkeypatch.setattr(real_trpo, "step", step)
    with pytest.raises(DivergedError, match=r"^learn, iteration 1: state\.policy\.layers\[0\]\[0\]: .* learning rates"):
        train(config, tmp_path)
    assert iterations_on_disk(tmp_path) == 0


# ---------------------------------------------------------------- the fit


LEAVES = {"first weights": 0, "first biases": 1, "last weights": 2, "last biases": 3}


def member_poisoned(networks, k, value, leaf=0):
    leaves, structure = jax.tree.flatten(networks)
    array = np.array(leaves[leaf])
    array[(k, *(0,) * (array.ndim - 1))] = value
    return jax.tree.unflatten(structure, [*leaves[:leaf], array, *leaves[leaf + 1 :]])


@pytest.mark.parametrize("value", [*POISON, 1e30])
@pytest.mark.parametrize("leaf", LEAVES)
def test_a_poisoned_member_is_made_anew_and_disturbs_no_other(clean, caplog, leaf, value):
    state = clean.states[0]._replace(networks=member_poisoned(clean.states[0].networks, 1, value, LEAVES[leaf]))
    ensemble, info = ensemble_fit.fit_ensemble(TINY, probe.PROBE, state.networks, clean.states[1].dataset, 2, SILENT)
    assert (info.resets, sound(ensemble), sound(info)) == (1, True, True)
    assert "fit, iteration 2: members 1 diverged; re-initialised and fitted again" in caplog.text
    expected, expected_info = clean.fits[1]
    assert same(only(ensemble.networks, [0, 2]), only(expected.networks, [0, 2]))
    assert same(only(info[1:4], [0, 2]), only(expected_info[1:4], [0, 2]))
    assert info.validation_loss[1] < 3 * np.max(expected_info.validation_loss) + 0.1, "it has learned"
    again, _ = ensemble_fit.fit_ensemble(TINY, probe.PROBE, state.networks, clean.states[1].dataset, 2, SILENT)
    assert same(again.networks, ensemble.networks)


def test_the_metrics_count_resets(clean):
    networks = member_poisoned(member_poisoned(clean.states[0].networks, 0, math.nan), 2, math.inf)
    state, row = going_on(clean, clean.states[0]._replace(networks=networks))
    assert (row["members_reset"], sound(state)) == (2, True)
    assert [r["members_reset"] for r in clean.rows] == [0, 0, 0]


class Blocks:
    """Spoils the networks of member `k` before the training blocks that `when` chooses by their number."""

    def __init__(self, monkeypatch, k, value, when):
        self.count, block = 0, fitting.train_and_validate

        def spoilt(at, *args):
            self.count += 1
            if when(self.count) and k < len(at.best_loss):
                at = at._replace(networks=jax.tree.map(lambda x: x.at[k].set(value), at.networks))
            return block(at, *args)

        monkeypatch.setattr(fitting, "train_and_validate", spoilt)


def second_fit(clean):
    return ensemble_fit.fit_ensemble(TINY, probe.PROBE, clean.states[0].networks, clean.states[1].dataset, 2, SILENT)


@pytest.mark.parametrize("value", POISON)
def test_a_member_that_diverges_at_once_is_made_anew(clean, monkeypatch, caplog, value):
    Blocks(monkeypatch, 2, value, lambda block: block == 1)
    ensemble, info = second_fit(clean)
    assert (info.resets, sound(ensemble)) == (1, True)
    assert "fit, iteration 2: members 2 diverged; re-initialised" in caplog.text
    assert same(only(ensemble.networks, [0, 1]), only(clean.fits[1][0].networks, [0, 1]))


@pytest.mark.parametrize("value", POISON)
def test_a_member_that_diverges_later_keeps_its_best_weights(clean, monkeypatch, caplog, value):
    Blocks(monkeypatch, 0, value, lambda block: block == 2)
    ensemble, info = second_fit(clean)
    assert (info.resets, list(info.diverged), list(info.lost)) == (0, [True, False, False], [False] * 3)
    assert "fit, iteration 2: members 0 diverged and kept their best weights" in caplog.text
    assert info.best_pass[0] == TINY.fit.validate_every
    assert sound(ensemble)
    assert same(only(ensemble.networks, [1, 2]), only(clean.fits[1][0].networks, [1, 2]))


def test_a_member_that_diverges_again_ends_the_run_by_name(clean, tmp_path, monkeypatch):
    # Alone it is number 0: both of it are spoilt, from the second iteration's first block on.
    block_count = 2 * TINY.fit.max_passes // TINY.fit.validate_every
    Blocks(monkeypatch, 0, math.nan, lambda block: block > block_count // 2)
    with pytest.raises(
        DivergedError, match=r"^fit, iteration 2: members 0: expected finite .* start anew with fit\.learning_rate"
    ):
        train(TINY, tmp_path)
    assert iterations_on_disk(tmp_path) == 1
    monkeypatch.undo()
    train(TINY, tmp_path)
    assert content(tmp_path) == content(clean.path)


def test_a_learning_rate_far_too_large_is_said_so(tmp_path):
    config = override(TINY, {"fit.learning_rate": 1e30})
    with pytest.raises(DivergedError, match=r"^fit, iteration 1: members 0, 1, 2: .* fit\.learning_rate below 1e\+30"):
        train(config, tmp_path)
    assert iterations_on_disk(tmp_path) == 0
    assert len(list(tmp_path.glob("episodes/*.npz"))) == 4, "real episodes are kept"


# ---------------------------------------------------------------- imagination


def in_imagination(clean, ensemble, settings=None):
    state = clean.states[0]._replace(dataset=clean.states[1].dataset)
    return policy_search.improve_policy(
        override(TINY, settings or {}), probe.PROBE, state._replace(iteration=1), ensemble, SILENT, Clock()
    )


@pytest.mark.parametrize("value", [*POISON, 1e20])
def test_an_exploding_member_costs_its_own_rollouts_only(clean, value):
    ensemble = clean.fits[1][0]
    ensemble = ensemble._replace(networks=member_poisoned(ensemble.networks, 1, value, 3))
    policy, baseline, info = in_imagination(clean, ensemble, {"imagine.sampling": "eps_rand"})
    assert 0 < info.diverged < 1
    assert info.rejected_steps == 0
    assert sound((policy, baseline, info.kl, info.improved, info.values[[0, 2]]))
    assert math.isnan(info.values[1])
    # The others outvote it: of three, two are less than 70 %.
    assert info.improved[1] == 0, "a model that explodes vouches for nothing"
    assert info.improved.mean() <= 2 / 3 + 1e-6


@pytest.mark.parametrize("value", [*POISON, 1e20])
def test_where_all_rollouts_explode_no_update_is_made(clean, value):
    ensemble = clean.fits[1][0]
    for k in range(3):
        ensemble = ensemble._replace(networks=member_poisoned(ensemble.networks, k, value, 3))
    policy, baseline, info = in_imagination(clean, ensemble, {"imagine.sampling": "eps_rand"})
    assert (info.diverged, info.rejected_steps, info.updates, info.accepted_updates, info.kl) == (1, 5, 5, 0, 0)
    assert same(policy.layers, clean.states[0].policy.layers)
    assert same(baseline, clean.states[0].baseline)


def test_a_run_with_a_member_that_explodes_on_purpose_goes_on(tmp_path, monkeypatch):
    fit = ensemble_fit.fit

    def explosive(*args):
        ensemble, info = fit(*args)
        return ensemble._replace(networks=jax.tree.map(lambda x: x.at[1].multiply(1e6), ensemble.networks)), info

    monkeypatch.setattr(ensemble_fit, "fit", explosive)
    train(TINY, tmp_path)
    assert iterations_on_disk(tmp_path) == 3
    rows = read_metrics(tmp_path / "metrics.csv")
    assert [row["diverged"] > 0.9 for row in rows] == [True, True, False]
    # 1e6 upon 1e6: its loss is no float32 any more, and it is made anew.
    assert [row["members_reset"] for row in rows] == [0, 0, 1]
    assert all(np.isfinite(row["return_real"]) for row in rows)


def test_a_reward_that_explodes_is_a_diverged_rollout(clean):
    def act(states, key=None):
        return jnp.zeros((*states.shape[:-1], 2))

    still = jax.tree.map(lambda x: 0 * np.asarray(x), clean.fits[1][0])
    still = still._replace(normaliser=still.normaliser._replace(delta_std=np.ones(2, np.float32)))

    def both(starts, scale):
        def reward(state, action, following):
            return jnp.where(state[..., 0] > 0, scale, 1.0)

        simulator = Simulator(still, reward, None, 5)
        return imagine(simulator, act, starts, jax.random.key(0)), returns_per_model(simulator, act, starts)

    compiled = jax.jit(both)
    for value in (*POISON, 1e13, -1e13):
        (rollouts, info), values = compiled(np.array([[1.0, 0.0], [-1.0, 0.0]], np.float32), value)
        assert (float(info.diverged), float(info.mean_return), float(info.steps)) == (0.5, 5, 5)
        assert sound(rollouts)
        assert np.isnan(values).all()
    (_, info), values = compiled(np.array([[1.0, 0.0], [-1.0, 0.0]], np.float32), 0.9e12)
    assert info.diverged == 0
    np.testing.assert_allclose(values, 5 * (0.9e12 + 1) / 2)


def test_the_largest_finite_batch_is_still_one(clean):
    """Every reward just within the bound: advantages, baseline and their squares do not overflow."""
    rng = np.random.default_rng(0)
    rewards = np.where(rng.uniform(size=(200, 100)) < 0.5, -0.99e12, 0.99e12).astype(np.float32)
    states = rng.uniform(-1e6, 1e6, (200, 100, 2)).astype(np.float32)
    rollouts = Trajectories(states, states, rewards, np.ones_like(rewards), states[0], np.ones(100, np.float32))
    config = AdvantageConfig("linear", 0.99, 0.95)
    got = jax.jit(lambda t: linear.advantages_and_value(t, jnp.zeros(8), config))(rollouts)
    assert sound(got)
    assert np.std(got[0]) == pytest.approx(1, rel=1e-3)


# ---------------------------------------------------------------- the improvers


KINDS = [*((name, "linear") for name in IMPROVERS), ("trpo", "network")]
FAST = [("trpo", "linear"), ("vpg", "linear"), ("bptt", "linear")]
BY_KIND = [pytest.param(kind, marks=() if kind in FAST else pytest.mark.slow) for kind in KINDS]


@pytest.fixture(scope="module")
def updates():
    """(improver, baseline) -> initial policy and memory, and a compiled update(policy, memory, poison, mask)."""

    @cache
    def made(kind_of):
        name, kind = kind_of
        config = override(
            Config(task="Probe", improver=name),
            {"advantage.baseline": kind, "ppo.epochs": 2, "ppo.minibatches": 2, "advantage.value_steps": 5},
        )

        settings = PhaseSettings.of(config, cut=False)

        def update(policy, memory, poison, mask):
            def simulate(act, starts, key):
                states = jnp.broadcast_to(starts, (6, *starts.shape)) * (1 + jnp.arange(6.0)[:, None, None])
                actions = act(states, key)
                # In the rollout of number 1, at step 2: in its reward, and in how that depends on the action.
                rewards = -jnp.sum(jnp.square(actions), axis=-1)
                rewards = rewards.at[2, 1].multiply(poison)
                whole = jnp.broadcast_to(mask, rewards.shape)
                info = ImagineInfo(jnp.float32(0), 1 - jnp.mean(mask), jnp.sum(whole))
                return Trajectories(states, actions, rewards, whole, states[-1], mask), info

            starts = np.random.default_rng(0).uniform(-1, 1, (8, 2)).astype(np.float32)
            return IMPROVERS[name](settings, simulate, policy, memory, starts, jax.random.key(3))

        policy = jax.tree.map(jnp.asarray, random_policy(0, 2, 2, (4,)))
        memory = init_memory(settings, policy, init_baseline(config.advantage, 2, jax.random.key(1)))
        compiled = jax.jit(update)
        # Adam has momentum from here on: a step that is refused must not be taken by that.
        policy, memory, (info, _) = compiled(policy, memory, 1.0, np.ones(8, np.float32))
        assert info.accepted
        return policy, memory, compiled

    return made


@pytest.mark.parametrize("value", POISON)
@pytest.mark.parametrize("kind", BY_KIND)
def test_a_gradient_that_is_not_finite_moves_nothing(updates, kind, value):
    policy, memory, update = updates(kind)
    new, after, (info, _) = update(policy, memory, value, np.ones(8, np.float32))
    assert (bool(info.accepted), float(info.kl), float(info.improvement)) == (False, 0, 0)
    assert same(new, policy)
    assert same(after.moments, memory.moments)
    assert sound(after)
    _, _, (info, _) = update(new, after, 1.0, np.ones(8, np.float32))
    assert info.accepted, "and the next one goes on"


@pytest.mark.parametrize("kind", BY_KIND)
def test_without_a_step_that_counts_nothing_moves(updates, kind):
    policy, memory, update = updates(kind)
    new, after, (info, _) = update(policy, memory, 1.0, np.zeros(8, np.float32))
    assert (bool(info.accepted), float(info.kl)) == (False, 0)
    assert same((new, after), (policy, memory))


@pytest.mark.parametrize("kind", [k for k in BY_KIND if not k.values[0][0].startswith("bptt")])
def test_a_baseline_that_is_not_finite_moves_nothing(updates, kind):
    policy, memory, update = updates(kind)
    for value in POISON:
        # Of the network its last array: behind tanh, an infinite weight of the first layer does no harm.
        spoilt = memory._replace(baseline=poisoned(memory.baseline, value, len(jax.tree.leaves(memory.baseline)) - 1))
        new, after, (info, _) = update(policy, spoilt, 1.0, np.ones(8, np.float32))
        assert not info.accepted
        assert same((new, after.moments), (policy, memory.moments))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in IMPROVERS if name != "trpo"])
def test_a_step_out_of_the_finite_numbers_is_not_made(name):
    config = override(Config(task="Probe", improver=name), {"gradient.learning_rate": 1e38, "gradient.max_norm": 1e30})

    def simulate(act, starts, key):
        states = jnp.broadcast_to(starts, (3, *starts.shape))
        actions = act(states, key)
        ones = jnp.ones((3, 4))
        return Trajectories(states, actions, -jnp.sum(actions**2, -1), ones, starts, ones[0]), ImagineInfo(0, 0, 12)

    settings = PhaseSettings.of(config, cut=False)
    policy = jax.tree.map(jnp.asarray, random_policy(0, 2, 2, (4,), scale=5.0))
    memory = init_memory(settings, policy, init_baseline(config.advantage, 2, jax.random.key(1)))
    update = jax.jit(partial(IMPROVERS[name], settings, simulate))
    for _ in range(8):
        starts = np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32)
        policy, memory, (info, _) = update(policy, memory, starts, jax.random.key(0))
        assert sound((policy, memory, info))


# ---------------------------------------------------------------- validation


def test_rollouts_that_all_diverged_improve_nothing():
    """Nothing is counted in them, which is more than -100."""
    config = TINY.validate
    rule = RULES["trpo_mean"]
    lost, some = (ImagineInfo(np.array([-3.0, 0.0]), np.array([0.0, d]), np.array([9.0, 0.0])) for d in (1.0, 0.5))
    evidence = [
        rule.evidence(Evidence(np.zeros(3), policy_phase._last_return(info), lambda: 0.0)) for info in (lost, some)
    ]
    assert not rule.decide(evidence[0], np.array([-100.0]), config)
    assert rule.decide(evidence[1], np.array([-100.0]), config)


# ---------------------------------------------------------------- runs from before the column


def test_a_run_from_before_the_column_goes_on(clean, tmp_path, monkeypatch):
    learn = algorithm.learn

    def earlier(*args):
        state, row = learn(*args)
        del row["members_reset"]
        return state, row

    monkeypatch.setattr(algorithm, "learn", earlier)
    train(override(TINY, {"iterations": 2}), tmp_path)
    old = (tmp_path / "metrics.csv").read_text()
    assert "members_reset" not in old
    monkeypatch.undo()
    train(TINY, tmp_path)
    rows, expected = (read_metrics(path / "metrics.csv") for path in (tmp_path, clean.path))
    assert [row.pop("members_reset") for row in rows] == [None, None, 0]
    assert [row.pop("members_reset") for row in expected] == [0, 0, 0]
    assert str(rows) == str(expected)


def test_no_other_column_is_made_up():
    like = {"a": 1, "members_reset": 0, "b": 2}
    assert list(completed({"a": 1, "b": 2}, like).items()) == [("a", 1), ("members_reset", None), ("b", 2)]
    for row in ({"a": 1}, {"a": 1, "c": 2}, {"b": 1, "a": 2}, like):
        assert completed(row, like) is row
