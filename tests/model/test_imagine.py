"""Imagined rollouts: through the true dynamics they are the real ones; bad models poison nothing."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import probe
from helpers import linear_ensemble, on_host, random_ensemble, random_normaliser, random_policy, slow_delta, slow_mean
from metrpo.model import imagine as imagining
from metrpo.model.ensemble import Ensemble
from metrpo.model.imagine import Simulator, imagine, returns_per_model
from metrpo.model.sampling import Keys, model_choice, step_rand
from metrpo.policy import gaussian

KEY = jax.random.key(0)


@on_host(static_argnames=("terminated", "horizon"))
def imagined(ensemble, policy, starts, key, terminated=None, horizon=probe.HORIZON):
    simulator = Simulator(ensemble, probe.reward, terminated, horizon)
    return imagine(simulator, partial(gaussian.sample, policy), starts, key)


@on_host(static_argnames=("reward", "terminated", "horizon"))
def imagined_without_policy(ensemble, starts, key, reward, terminated=None, horizon=10):
    simulator = Simulator(ensemble, reward, terminated, horizon)
    return imagine(simulator, lambda s, k: jnp.zeros((len(s), 1)), starts, key)


@on_host(static_argnames=("terminated", "horizon"))
def returns(ensemble, policy, starts, terminated=None, horizon=probe.HORIZON):
    simulator = Simulator(ensemble, probe.reward, terminated, horizon)
    return returns_per_model(simulator, partial(gaussian.mean, policy), starts)


@on_host(static_argnames=("reward", "terminated", "horizon"))
def returns_without_policy(ensemble, starts, reward, terminated=None, horizon=10):
    return returns_per_model(Simulator(ensemble, reward, terminated, horizon), lambda s: 0 * s, starts)


model_choices = jax.jit(jax.vmap(model_choice, (0, None, None)), static_argnums=(1, 2))


def true_dynamics(members=3, relu=True, seed=0):
    """All members are the probe's real dynamics, under a normaliser that is no identity."""
    normaliser = random_normaliser(np.random.default_rng(seed), 2, 2)
    return linear_ensemble([(probe.A, probe.B)] * members, normaliser, relu)


# ---------------------------------------------------------------- against the real system


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("task", [probe.PROBE, probe.ENDING_PROBE], ids=lambda t: t.name)
def test_through_the_true_dynamics_imagination_is_reality(task, relu):
    """The same actions from the same starts: states, rewards and ends are those of the environment."""
    policy = random_policy(0, 2, 2, std=0.8)
    starts = probe.starts(7).astype(np.float32)
    t, info = imagined(true_dynamics(relu=relu), policy, starts, KEY, task.terminated)
    actions = np.asarray(t.actions)
    assert np.mean(np.abs(actions) > 1) > 0.1, "clipping must matter in this case"
    lengths = []
    for n in range(7):
        states, executed, rewards = probe.rollout(task, n, lambda step, state, n=n: actions[step, n])
        length = len(rewards)
        lengths.append(length)
        np.testing.assert_allclose(t.states[:length, n], states[:-1], atol=1e-4)
        np.testing.assert_allclose(t.rewards[:length, n], rewards, atol=1e-4)
        np.testing.assert_array_equal(t.mask[:, n], np.arange(probe.HORIZON) < length)
        np.testing.assert_array_equal(np.clip(actions[:length, n], -1, 1), executed)
        ended = task.terminated is not None and bool(task.terminated(states[-1]))
        assert t.going_on[n] == (not ended)
        if not ended:
            np.testing.assert_allclose(t.last[n], states[-1], atol=1e-4)
    assert info.steps == sum(lengths)
    assert info.diverged == 0
    assert info.mean_return == pytest.approx(float((t.rewards * t.mask).sum(0).mean()), rel=1e-5)
    assert (min(lengths) < probe.HORIZON) == (task.terminated is not None)


def test_the_mean_policy_without_noise_is_followed_as_in_reality():
    policy = random_policy(1, 2, 2)._replace(log_std=np.full(2, -30, np.float32))
    t, _ = imagined(true_dynamics(), policy, probe.starts(5).astype(np.float32), KEY)
    for n in range(5):
        states, _, rewards = probe.rollout(probe.PROBE, n, lambda _, state: slow_mean(policy, state))
        np.testing.assert_allclose(t.states[:, n], states[:-1], atol=1e-4)
        np.testing.assert_allclose(t.rewards[:, n], rewards, atol=1e-4)


def test_actions_are_recorded_as_drawn_from_the_policy():
    policy = random_policy(2, 2, 2, std=2.0)
    starts = np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32)
    t, _ = imagined(true_dynamics(1), policy, starts, KEY)
    means = gaussian.mean(policy, np.asarray(t.states))
    z = (np.asarray(t.actions) - means) / np.exp(policy.log_std)
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    for x, y in ((z[1:], z[:-1]), (z[:, 1:], z[:, :-1]), (z[..., 0], z[..., 1])):
        assert abs(np.corrcoef(x.ravel(), y.ravel())[0, 1]) < 0.03
    np.testing.assert_allclose(
        t.rewards[:-1], probe.reward(t.states[:-1], np.clip(t.actions[:-1], -1, 1), t.states[1:]), atol=1e-4
    )


def test_returns_in_the_true_dynamics_are_the_real_returns():
    policy = random_policy(3, 2, 2)
    for task in (probe.PROBE, probe.ENDING_PROBE):
        real = [
            probe.rollout(task, n, lambda _, state: slow_mean(policy, state))[2].sum(dtype=np.float64) for n in range(6)
        ]
        got = returns(true_dynamics(2), policy, probe.starts(6).astype(np.float32), terminated=task.terminated)
        np.testing.assert_allclose(got, np.mean(real), rtol=1e-4)


# ---------------------------------------------------------------- each model alone


@pytest.mark.parametrize("terminated", [None, probe.beyond])
def test_returns_per_model_are_those_of_a_slow_loop(terminated):
    ensemble = random_ensemble(5, members=3, state_size=2, action_size=2, scale=0.3)
    policy = random_policy(6, 2, 2, scale=2.0)
    starts = np.random.default_rng(0).uniform(-0.7, 0.7, (5, 2)).astype(np.float32)
    slow = np.zeros((3, 5))
    for k in range(3):
        for n, state in enumerate(starts.astype(float)):
            for _ in range(12):
                action = np.clip(slow_mean(policy, state), -1, 1)
                following = state + slow_delta(ensemble, k, state, action)
                slow[k, n] += probe.reward(state, action, following)
                state = following
                if terminated is not None and terminated(state):
                    break
    got = returns(ensemble, policy, starts, terminated=terminated, horizon=12)
    np.testing.assert_allclose(got, slow.mean(1), rtol=1e-3)
    assert len(np.unique(np.round(slow.mean(1), 2))) == 3, "the models must differ"


def test_the_last_step_is_followed_by_a_discounted_value():
    ensemble, policy = random_ensemble(5, members=2, state_size=2, action_size=2, scale=0.3), random_policy(6, 2, 2)
    starts = np.random.default_rng(0).uniform(-0.7, 0.7, (5, 2)).astype(np.float32)
    slow = np.zeros((2, 5))
    for k in range(2):
        for n, state in enumerate(starts.astype(float)):
            for t in range(4):
                action = np.clip(slow_mean(policy, state), -1, 1)
                following = state + slow_delta(ensemble, k, state, action)
                slow[k, n] += 0.9**t * probe.reward(state, action, following)
                state = following
                if probe.beyond(state):
                    break
            else:
                slow[k, n] += 0.9**4 * 7 * state[1]
    act, after = partial(gaussian.mean, policy), lambda states: 7 * states[..., 1]
    got = jax.jit(lambda simulator, s: returns_per_model(simulator, act, s, 0.9, after))
    simulator = Simulator(ensemble, probe.reward, probe.beyond, 4)
    np.testing.assert_allclose(got(simulator, starts), slow.mean(1), rtol=1e-3)


def growing(factors):
    """Members s' = factor s, of one dimension."""
    return linear_ensemble([(np.array([[f]]), np.zeros((1, 1))) for f in factors])


def plain(state, action, next_state):
    return next_state[..., 0]


def squared(state, action, next_state):
    return -(next_state[..., 0] ** 2)


def large(next_state):
    return next_state[..., 0] > 50


def test_a_diverged_model_has_no_value_and_spoils_no_other():
    starts = np.array([[0.0], [0.5], [1.0]], np.float32)
    got = returns_without_policy(growing([1.0, 10.0, np.nan, 0.5]), starts, plain)
    assert got[0] == pytest.approx(0.5 * 10)
    assert np.isnan(got[1])
    assert np.isnan(got[2])
    assert got[3] == pytest.approx(0.5 * (1 - 0.5**10), rel=1e-5)
    # One rollout that explodes among others that do not is enough; one that stays below the limit is not.
    assert np.isnan(returns_without_policy(growing([10.0]), np.array([[0.0], [1.0]], np.float32), plain, None, 6)[0])
    below = returns_without_policy(growing([10.0]), np.array([[0.0], [0.99]], np.float32), plain, None, 6)
    assert below[0] == pytest.approx(0.99 * 1_111_110 / 2, rel=1e-5)


@pytest.mark.parametrize("reward", [plain, squared])
def test_what_a_model_does_after_the_end_does_not_count(reward):
    """1 -> 10 -> 100 ends there; beyond, the model explodes and its squares overflow."""
    value = returns_without_policy(growing([10.0]), np.ones((1, 1), np.float32), reward, large, 45)
    assert value[0] == (110 if reward is plain else -10_100)


# ---------------------------------------------------------------- bad models


def test_exploding_rollouts_are_masked_whole_and_counted():
    """Growing tenfold a step: 1 and 100 pass the limit of 1e6 within 10 steps, 1e-5 and 0 do not."""
    starts = np.array([[0.0], [1e-5], [1.0], [100.0], [-1.0]], np.float32)
    t, info = imagined_without_policy(growing([10.0, 10.0]), starts, KEY, plain)
    assert imagining.EXPLODED == 1e6
    np.testing.assert_array_equal(t.mask, np.broadcast_to([1, 1, 0, 0, 0], (10, 5)))
    assert info.diverged == pytest.approx(3 / 5)
    assert info.steps == 20
    assert info.mean_return == pytest.approx(1e-5 * 11_111_111_110 / 2, rel=1e-4)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(t))
    # Until they diverge they are followed, then they stand still.
    np.testing.assert_allclose(t.states[:, 2, 0], [*(10.0 ** np.arange(6)), *[1e5] * 4], rtol=1e-5)


def nan_beyond(state, action, next_state):
    return jnp.where(next_state[..., 0] > 5, jnp.nan, 1.0)


def test_a_reward_that_is_no_number_masks_its_rollout():
    starts = np.array([[0.001], [1.0], [3.0]], np.float32)
    t, info = imagined_without_policy(growing([1.5]), starts, KEY, nan_beyond)
    np.testing.assert_array_equal(t.mask, np.broadcast_to([1, 0, 0], (10, 3)))
    assert info.diverged == pytest.approx(2 / 3)
    assert (info.steps, info.mean_return) == (10, 10)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(t))


def test_only_rollouts_that_meet_a_model_of_nan_are_masked():
    """One of two models is broken: a rollout of 2 steps survives with probability 1/4."""
    t, info = imagined_without_policy(growing([1.0, np.nan]), np.ones((400, 1), np.float32), KEY, plain, horizon=2)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(t))
    alive = np.asarray(t.mask[0])
    np.testing.assert_array_equal(t.mask[1], alive)
    assert float(info.diverged) == pytest.approx(1 - alive.mean())
    assert stats.binomtest(int(alive.sum()), 400, 0.25).pvalue > 1e-3
    assert (info.mean_return, info.steps) == (2, 2 * alive.sum())


def test_when_all_rollouts_diverge_the_numbers_stay_finite():
    t, info = imagined_without_policy(growing([np.nan]), np.ones((4, 1), np.float32), KEY, plain)
    assert not np.any(t.mask)
    assert (info.mean_return, info.diverged, info.steps) == (0, 1, 0)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(t))


def test_a_rollout_that_ends_before_it_explodes_counts():
    """1 -> 10 -> 100 ends there; 1e-9 never ends; what follows the end is no divergence."""
    starts = np.array([[1.0], [1e-9], [20.0]], np.float32)
    t, info = imagined_without_policy(growing([10.0]), starts, KEY, plain, large)
    np.testing.assert_array_equal(t.mask.sum(0), [2, 10, 1])
    np.testing.assert_array_equal(t.mask[:, 0], [1, 1] + [0] * 8)
    assert info.diverged == 0
    assert info.steps == 13
    assert info.mean_return == pytest.approx((110 + 1e-9 * 11_111_111_110 + 200) / 3, rel=1e-4)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(t))


# ---------------------------------------------------------------- the choice of the model


@pytest.mark.parametrize(("count", "members"), [(12, 3), (13, 5), (3, 5), (7, 1)])
def test_model_choice_is_uniform_for_every_state(count, members):
    draws = 3000
    slots, models = jax.device_get(model_choices(jax.random.split(KEY, draws), count, members))
    table = np.array([np.bincount(column, minlength=members) for column in models.T])
    assert table.shape == (count, members)
    for row in table:
        assert members == 1 or stats.chisquare(row).pvalue > 1e-4
    # The groups are those of the models, every state in exactly one, none larger than its share.
    group = -(-count // members)
    assert slots.shape == (draws, members, group)
    for slot, model in zip(slots[:50], models[:50], strict=True):
        assert sorted(slot[slot < count]) == list(range(count))
        for k in range(members):
            assert np.all(model[slot[k][slot[k] < count]] == k)
    assert np.bincount(models[0], minlength=members).max() <= group


@pytest.mark.parametrize(("count", "members"), [(12, 3), (13, 5), (2, 3)])
def test_models_are_drawn_uniformly_and_anew_at_every_step(count, members):
    """Member k adds 1 to dimension k: the states tell who was drawn."""
    networks = ((np.zeros((members, members + 1, members), np.float32), np.eye(members, dtype=np.float32)[:, None]),)
    ensemble = Ensemble(networks, linear_ensemble([(np.eye(members), np.zeros((members, 1)))]).normaliser)
    horizon = 3000
    t, _ = imagined_without_policy(ensemble, np.zeros((count, members), np.float32), KEY, plain, horizon=horizon)
    steps = np.diff(np.asarray(t.states), axis=0)
    assert np.all(steps.sum(-1) == 1)
    drawn = steps.argmax(-1)
    for n in range(count):
        assert stats.chisquare(np.bincount(drawn[:, n], minlength=members)).pvalue > 1e-4
    for lag in (1, 2, 7):
        for n, m in ((0, 0), (count - 1, count - 1), (0, 1)):
            table = np.histogram2d(drawn[lag:, n], drawn[:-lag, m], bins=members)[0]
            assert stats.chi2_contingency(table).pvalue > 1e-4


@pytest.mark.parametrize(("count", "members"), [(12, 3), (13, 5), (3, 5), (6, 1)])
def test_step_rand_is_compute_all_then_pick(count, members):
    ensemble = random_ensemble(0, members=members)
    rng = np.random.default_rng(count)
    states, actions = rng.normal(size=(count, 4)).astype(np.float32), rng.normal(size=(count, 2)).astype(np.float32)
    _, models = model_choice(KEY, count, members)
    everything = np.array([[s + slow_delta(ensemble, k, s, a) for s, a in zip(states, actions, strict=True)]
                           for k in range(members)])  # fmt: skip
    picked = everything[np.asarray(models), np.arange(count)]
    np.testing.assert_allclose(jax.jit(step_rand)(ensemble, states, actions, Keys(KEY, KEY)), picked, atol=1e-5)


def test_the_sampling_stands_in_the_table():
    assert imagining.SAMPLINGS["step_rand"].draw is step_rand


# ---------------------------------------------------------------- exploration by disagreement


def slow_disagreement(ensemble, state, action):
    deltas = np.array([slow_delta(ensemble, k, state, action) for k in range(ensemble.members)])
    return (deltas.std(axis=0) / ensemble.normaliser.delta_std).mean()


def test_disagreement_is_the_spread_of_the_predictions():
    ensemble = random_ensemble(0, members=4)
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(5, 4)).astype(np.float32), rng.uniform(-1, 1, (5, 2)).astype(np.float32)
    got = jax.jit(imagining.disagreement)(ensemble, states, actions)
    expected = [slow_disagreement(ensemble, s, a) for s, a in zip(states, actions, strict=True)]
    np.testing.assert_allclose(got, expected, rtol=1e-4)
    assert np.abs(jax.jit(imagining.disagreement)(true_dynamics(), states[:, :2], actions)).max() < 1e-4


def test_curiosity_adds_disagreement_to_rewards_and_values():
    ensemble = random_ensemble(1, members=3, state_size=2, action_size=2, scale=0.3)
    policy, starts = random_policy(2, 2, 2), probe.starts(4).astype(np.float32)
    act = partial(gaussian.sample, policy)
    plainly, curiously = (Simulator(ensemble, probe.reward, None, 6, disagreement=c) for c in (0.0, 0.5))
    run = jax.jit(lambda simulator: imagine(simulator, act, starts, KEY))
    (plain, _), (curious, info) = run(plainly), run(curiously)
    np.testing.assert_array_equal(plain.states, curious.states)
    spread = [
        [slow_disagreement(ensemble, s, np.clip(a, -1, 1)) for s, a in zip(*row, strict=True)]
        for row in zip(np.asarray(plain.states), np.asarray(plain.actions), strict=True)
    ]
    np.testing.assert_allclose(curious.rewards - plain.rewards, 0.5 * np.array(spread), atol=1e-4)
    assert float(info.mean_return) == pytest.approx(float(curious.rewards.sum(0).mean()), rel=1e-4)
    mean = partial(gaussian.mean, policy)
    value = jax.jit(lambda simulator: returns_per_model(simulator, mean, starts))
    expected = np.zeros(3)
    for k in range(3):
        for state in starts.astype(float):
            for _ in range(6):
                action = np.clip(slow_mean(policy, state), -1, 1)
                expected[k] += 0.5 * slow_disagreement(ensemble, state, action) / len(starts)
                state = state + slow_delta(ensemble, k, state, action)
    np.testing.assert_allclose(value(curiously) - value(plainly), expected, atol=1e-4)
