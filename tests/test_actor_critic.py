"""Whole runs of the actor-critic on the probe: compilations, resuming, its files and what it learns."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import probe
from counted_run import run
from helpers import linear_ensemble
from metrpo import algorithm, budget, external, training
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.errors import ConfigError
from metrpo.policy import squashed
from metrpo.policy.inputs import normalised
from metrpo.presets import override, preset
from metrpo.run import derived_files, directory
from metrpo.run.clock import Clock
from metrpo.run.files import atomic_write
from metrpo.run.metrics import read_metrics
from metrpo.run.policy_export import export
from metrpo.run.policy_file import load_policy
from metrpo.stages import actor_critic_search
from metrpo.stages.ensemble_fit import ensemble_of
from metrpo.stages.state import inputs_for
from metrpo.training import train

SMALL = override(
    Config(task="Probe", iterations=4, evaluation_episodes=1, deterministic=True, improver="actor-critic"),
    {
        "actor_critic.batch_size": 8,
        "actor_critic.block": 10,
        "actor_critic.branch_steps": 4,
        "actor_critic.critic_hidden": (4,),
        "actor_critic.horizon": 2,
        "actor_critic.random_steps": 40,
        "actor_critic.real_batch": 8,
        "actor_critic.updates_per_step": 0.5,
        "advantage.discount": 0.9,
        "collect.max_train": 200,
        "collect.max_validation": 50,
        "collect.piece": 5,
        "collect.steps": 20,
        "ensemble.hidden": (4,),
        "ensemble.members": 2,
        "fit.batch_size": 20,
        "fit.max_steps": 10,
        "policy.hidden": (4,),
        "policy.normalise": True,
        "trust_reward": True,
        "validate.real_episodes": 0,
        "validate.rule": "no_early",
        "validate.starts": 2,
    },
)


@pytest.fixture(scope="module", autouse=True)
def _probe_is_a_task():
    with probe.registered(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(derived_files, "draw_curve", lambda rows, path, *_: atomic_write(path, "drawn"))
        yield


@pytest.fixture(scope="module")
def small():
    jax.clear_caches()
    return run(SMALL)


def equal(one, other):
    return jax.tree.all(jax.tree.map(np.array_equal, one, other))


def test_nothing_compiles_after_the_second_iteration(small):
    assert small.counts[0] > 5, "the count must see compilations"
    assert small.counts[2:] == [0, 0]


def test_an_iteration_makes_an_update_for_each_real_step_that_it_collects(small):
    assert [row["real_steps"] for row in small.rows] == [40, 60, 80, 100]
    assert [row["updates"] for row in small.rows] == [20, 10, 10, 10]


def test_whole_episodes_that_bring_more_steps_than_asked_for_bring_more_updates():
    class Told(Progress):
        def __init__(self):
            self.heard = []

        def stage(self, name, total=None):
            self.heard.append((name, total))

        def update(self, done, note=""):
            self.heard.append(done)

    told, config = Told(), override(SMALL, {"collect.steps": 21, "iterations": 2})
    state = training.init(config)
    for steps, updates in ((40, 20), (40, 20)):
        state, row = training.step(config, state, told)
        assert (row["real_steps"] - 40 * (state.iteration - 1), row["updates"]) == (steps, updates)
    begun = told.heard.index(("improve", 20))
    assert told.heard[begun + 1 : begun + 3] == [10, 20], "the bar is full when all is done"


def test_episodes_are_whole_but_those_of_random_actions():
    """A policy that never saw the rest of an episode fails there: Hopper-v5 hopped for 250 steps of 1,000 and fell."""
    config = override(SMALL, {"collect.steps": 5, "actor_critic.random_steps": 20, "iterations": 2})
    first = training.init(config)
    after, _ = training.step(config, first)
    for state, lengths in ((first, [5, 5, 5, 5]), (after, [probe.HORIZON])):
        assert [len(e.rewards) for e in algorithm.collect(config, probe.PROBE, state)] == lengths
    longer = override(config, {"collect.steps": 3000})
    assert [budget.longest_episode(c, 1) for c in (config, longer)] == [1000, 3000]


def test_a_log_alone_is_learned_from_as_if_the_settings_steps_were_new():
    assert actor_critic_search.updates_for(SMALL, 0) == 10
    assert actor_critic_search.updates_for(SMALL, 400) == 200
    assert actor_critic_search.updates_for(SMALL, 1) == 10, "a block at least"


def test_rows_say_what_was_learned(small):
    for row in small.rows:
        for name in ("critic_loss", "value", "entropy", "entropy_weight", "actor_gradient_norm", "saturated", "kl"):
            assert np.isfinite(row[name]), name
        assert row["rejected_steps"] == 0
        assert 0 <= row["saturated"] <= 1
        assert row["kl"] > 0
    assert len({tuple(row) for row in small.rows}) == 1, "the same columns in every row"
    weights = [float(np.exp(s.baseline.log_entropy_weight)) for s in small.states[1:]]
    assert weights == [row["entropy_weight"] for row in small.rows]


def test_a_step_leaves_its_state_as_it_was_and_can_be_repeated(small):
    before = jax.tree.map(np.array, small.states[2])
    again, _ = training.step(SMALL, small.states[2])
    assert equal(before, small.states[2])
    assert equal(again, small.states[3])


def test_all_that_updates_hand_on_goes_on_in_the_next_iteration(small):
    one, two = (s.baseline for s in small.states[2:4])
    counts = [int(x.moments.entropy[0].count) for x in (one, two)]
    assert counts == [30, 40], "updates that Adam has seen"
    for before, after in zip(jax.tree.leaves(one.critics), jax.tree.leaves(two.critics), strict=True):
        assert not np.array_equal(before, after)


def test_by_a_vote_the_policy_waits_and_the_learner_goes_on(small, monkeypatch):
    guarded = override(SMALL, {"validate.rule": "ensemble", "validate.threshold": 1.0})
    votes = iter(([0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [2.0, 0.0], [1.0, 1.0], [1.0, 2.0], [1.0, 1.0], [2.0, 2.0]))
    seen = []

    def values(config, simulator, policies, starts, key):
        seen.append(policies)
        return [np.array(next(votes)), np.array(next(votes))]

    monkeypatch.setattr(actor_critic_search, "_values", values)
    done = run(guarded)
    assert [row["accepted_updates"] for row in done.rows] == [20, 0, 0, 10]
    assert [row["fraction_improved"] for row in done.rows] == [1.0, 0.5, 0.5, 1.0]
    assert [row["return_imagined"] for row in done.rows] == [1.0, 1.0, 1.0, 2.0], "of the policy that is handed over"
    first = done.states[1].policy
    assert equal(first, done.states[2].policy)
    assert equal(first, done.states[3].policy)
    assert not equal(first, done.states[4].policy)
    assert all(equal(old, first) for old, _ in seen[1:]), "each is held against the one that was accepted last"
    for voted, unvoted in zip(done.states, small.states, strict=True):
        assert equal(voted.baseline, unvoted.baseline), "the learner is the same with and without a vote"


@pytest.mark.parametrize("rule", ["real", "trpo_mean"])
def test_a_rule_that_asks_more_than_the_models_is_refused(rule):
    with pytest.raises(ConfigError, match=f"expected ensemble, one_model or no_early with .* got {rule}"):
        training.init(override(SMALL, {"validate.rule": rule}))


def test_a_run_that_was_resumed_is_the_run_that_never_stopped(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(override(SMALL, {"iterations": 3}), whole)
    train(override(SMALL, {"iterations": 1}), parts)
    train(override(SMALL, {"iterations": 3}), parts)
    for name in ("metrics.csv", "policy.npz", "checkpoints/iteration-00003.npz", "checkpoints/iteration-00002.npz"):
        assert (whole / name).read_bytes() == (parts / name).read_bytes(), name
    _policy_acts_as_the_actor_does(whole)


def test_its_steps_one_at_a_time_are_the_loop_byte_for_byte(tmp_path):
    whole, steps = tmp_path / "whole", tmp_path / "steps"
    train(override(SMALL, {"iterations": 2}), whole)
    external.begin(override(SMALL, {"iterations": 2}), steps)
    for _ in range(2):
        external.collect(steps)
        external.improve(steps)
    for name in ("policy.npz", "checkpoints/iteration-00002.npz"):
        assert (whole / name).read_bytes() == (steps / name).read_bytes(), name


@pytest.mark.parametrize(
    "settings",
    [{"learn_reward": True}, {"history": 2}, {"actor_critic.horizon": 0}, {"validate.rule": "one_model"}],
)
def test_it_learns_rewards_sees_the_past_and_does_without_imagined_steps(settings, tmp_path):
    train(override(SMALL, {"iterations": 2, **settings}), tmp_path)
    row = read_metrics(tmp_path / "metrics.csv")[-1]
    assert np.isfinite(row["return_real"])
    assert row["rejected_steps"] == 0


def _policy_acts_as_the_actor_does(run_dir):
    policy = load_policy(run_dir)
    state = training.init(SMALL)
    with directory.RunDirectory(run_dir, override(SMALL, {"iterations": 3})) as run:
        state = run.load(state)
    seen = np.random.default_rng(0).uniform(-1, 1, (9, 2)).astype(np.float32)
    inputs = inputs_for(SMALL, probe.PROBE, state.dataset)
    means, _ = squashed.moments(squashed.on_host(state.baseline.actor), normalised(inputs, seen))
    np.testing.assert_allclose(policy(seen), np.tanh(means), atol=1e-5)
    space: dict = {}
    exec(export(run_dir).read_text().replace('__name__ == "__main__"', "True"), space)  # it checks itself
    np.testing.assert_allclose(space["act"](seen), policy(seen), atol=1e-6)


def test_it_acts_at_random_first_and_then_by_the_actor(small):
    def actions(state):
        act = actor_critic_search.explorer(SMALL, probe.PROBE, state)(np.random.default_rng(0))
        return np.array([act(np.zeros(2)) for _ in range(300)])

    first, later = actions(small.states[0]), actions(small.states[1])
    assert np.abs(first).max() < 1
    np.testing.assert_allclose(np.quantile(first, [0.1, 0.5, 0.9]), [-0.8, 0, 0.8], atol=0.12)
    actor = squashed.on_host(small.states[1].baseline.actor)
    seen = normalised(inputs_for(SMALL, probe.PROBE, small.states[1].dataset), np.zeros(2))
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(later, [squashed.draw(actor, seen, rng.standard_normal(2)) for _ in range(300)])


@pytest.mark.parametrize("iteration", [0, 1])
def test_noise_may_last_for_steps_and_actions_are_spread_as_ever(small, iteration):
    config, state = override(SMALL, {"collect.noise_correlation": 0.9}), small.states[iteration]
    explore = actor_critic_search.explorer(config, probe.PROBE, state)
    episodes = np.arctanh([_acted(explore(np.random.default_rng(seed)), 60) for seed in range(200)])
    means, stds = episodes.mean(axis=(0, 1)), episodes.std(axis=(0, 1))
    z = (episodes - means) / stds
    assert np.mean(z[:, :-1] * z[:, 1:]) == pytest.approx(0.9, abs=0.03)
    assert np.mean(z[:, 0] ** 2) == pytest.approx(1.0, abs=0.2), "from the first step on"
    plain = actor_critic_search.explorer(SMALL, probe.PROBE, state)
    usual = np.arctanh(_acted(plain(np.random.default_rng(0)), 4000))
    np.testing.assert_allclose((means, stds), (usual.mean(axis=0), usual.std(axis=0)), atol=0.1)


def _acted(act, steps):
    return np.array([act(np.zeros(2)) for _ in range(steps)])


def test_real_steps_are_those_of_the_dataset_with_rewards_and_ends(small):
    data, ensemble = small.states[1].dataset, linear_ensemble([(probe.A, probe.B)])
    states, actions, deltas, _ = data.train
    steps = actor_critic_search._real_steps(probe.PROBE, ensemble, data)
    np.testing.assert_array_equal(steps.following, states + deltas)
    np.testing.assert_allclose(steps.rewards, probe.reward(states, actions, states + deltas), rtol=1e-5)
    assert set(steps.going_on) == {1.0}
    ending = dataclasses.replace(probe.PROBE, terminated=lambda following: following[..., 0] > 0)
    going_on = actor_critic_search._real_steps(ending, ensemble, data).going_on
    np.testing.assert_array_equal(going_on, steps.following[:, 0] <= 0)
    assert 0 < going_on.mean() < 1


def test_models_are_trusted_as_far_as_they_agree_on_most_of_the_held_out_steps(small):
    data = small.states[1].dataset
    ensemble = linear_ensemble([(probe.A * factor, probe.B) for factor in (0.9, 1.1)])
    apart = np.abs(0.1 * data.validation.states @ probe.A.T).mean(axis=1)

    def trusted(trust, agreement=0.0):
        config = override(SMALL, {"actor_critic.trust": trust, "actor_critic.agreement": agreement})
        return actor_critic_search._trusted(config, ensemble, data, np.random.default_rng(0))

    assert np.quantile(apart, 0.85) < float(trusted(1.0)) <= apart.max() * 1.001
    assert float(trusted(2.0)) == pytest.approx(2 * float(trusted(1.0)))
    assert trusted(0.0) is None
    assert trusted(0.0, agreement=0.5) is None
    assert float(trusted(1.0, agreement=0.5)) == 0.5
    assert float(trusted(1.0, agreement=1e-4)) == float(trusted(1.0))


def test_what_it_learns_does_not_depend_on_the_unit_of_rewards(small):
    before, after = small.states[:2]
    state = before._replace(dataset=after.dataset)
    ensemble = ensemble_of(SMALL, probe.PROBE, after.networks, after.dataset.train)

    def learned(task):
        return actor_critic_search.improve_policy(SMALL, task, state, ensemble, Progress(), Clock())[:2]

    larger = dataclasses.replace(probe.PROBE, reward=lambda *step: 64 * probe.reward(*step))
    (policy, learner), (same, other) = learned(probe.PROBE), learned(larger)
    assert not equal(policy, state.policy)
    for one, two in zip(jax.tree.leaves(policy), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-5)
    assert float(other.log_entropy_weight - learner.log_entropy_weight) == pytest.approx(np.log(64), rel=1e-4)


def test_without_a_discount_it_is_refused():
    with pytest.raises(ConfigError, match=r"advantage\.discount: expected less than 1"):
        training.init(override(SMALL, {"advantage.discount": 1.0}))


def test_pieces_of_episodes_are_validated_on_and_only_whole_ones_are_started_from(small):
    data = small.states[1].dataset
    assert len(data.starts) == 2, "episodes of 20 steps"
    assert data.validation.size + data.train.size == 40
    assert data.validation.size % 5 == 0
    assert data.validation.size > 0


@pytest.mark.slow
def test_it_finds_the_optimum_of_a_linear_system():
    config = override(
        preset("Probe", "fast", "actor-critic"),
        {
            "actor_critic.critic_hidden": (32, 32),
            "actor_critic.critic_learning_rate": 1e-3,
            "actor_critic.random_steps": 100,
            "actor_critic.target_rate": 0.02,
            "actor_critic.updates_per_step": 5.0,
            "advantage.discount": 0.95,
            "collect.max_train": 1000,
            "collect.max_validation": 500,
            "collect.piece": 10,
            "collect.steps": 100,
            "ensemble.hidden": (16,),
            "ensemble.members": 3,
            "gradient.learning_rate": 1e-3,
            "iterations": 4,
            "policy.hidden": (16,),
            "trust_reward": True,
        },
    )
    state = training.train(config)
    assert probe.real_return(state.policy) > 1.1 * probe.optimum()


def test_the_system_is_the_actor_critic():
    config = preset("Probe", "fast", "actor-critic")
    assert (config.improver, config.method, config.policy.normalise) == ("actor-critic", "model-based", True)
    assert algorithm.init(config, probe.PROBE).policy.layers[-1][0].shape == (2, 2)
