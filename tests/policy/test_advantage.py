"""Returns, advantages and the baseline against slow NumPy versions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import on_host
from metrpo.config import AdvantageConfig
from metrpo.policy import advantage
from metrpo.policy.value import linear
from metrpo.types import Trajectories

T, N, S = 12, 5, 3
discounted_returns, gae, standardise, features, fit_baseline = (
    on_host()(f)
    for f in (
        advantage.discounted_returns,
        advantage.gae,
        advantage.standardise,
        linear.features,
        linear.fit,
    )
)


class Traced(AdvantageConfig):
    """Of traced numbers, which have no range that could be checked."""

    def __post_init__(self):
        pass


@on_host(static_argnames="cut")
def advantages_and_baseline(trajectories, baseline, discount, gae_lambda, ridge, cut=False):
    """Compiled once for all discounts: the config would hold them fast."""
    config = Traced("linear", discount, gae_lambda, ridge)
    return linear.advantages_and_value(trajectories, baseline, config, cut=cut)


seeds = st.integers(0, 2**31 - 1)
shares = st.sampled_from([0.0, 0.3, 0.9, 0.99, 1.0])


def a_batch(seed):
    """Rewards, values and a mask with whole, terminated, one-step and diverged (all 0) episodes."""
    rng = np.random.default_rng(seed)
    rewards, values = rng.normal(size=(2, T, N)).astype(np.float32)
    lengths = rng.permutation([T, 0, 1, *rng.integers(1, T + 1, N - 3)])
    mask = (np.arange(T)[:, None] < lengths).astype(np.float32)
    return rng, rewards, values, mask, lengths


def slow_returns(rewards, lengths, discount):
    out = np.zeros((T, N))
    for n in range(N):
        for t in range(lengths[n]):
            out[t, n] = sum(discount ** (i - t) * float(rewards[i, n]) for i in range(t, lengths[n]))
    return out


def slow_gae(rewards, values, lengths, discount, gae_lambda):
    """The definition: lambda-weighted sums of TD errors, the value behind the last step being 0."""
    out = np.zeros((T, N))
    for n in range(N):
        v = [*values[: lengths[n], n].astype(float), 0.0]
        error = [float(rewards[t, n]) + discount * v[t + 1] - v[t] for t in range(lengths[n])]
        for t in range(lengths[n]):
            out[t, n] = sum((discount * gae_lambda) ** (i - t) * error[i] for i in range(t, lengths[n]))
    return out


def slow_features(states):
    out = np.zeros((T, N, 2 * S + 4))
    for t in range(T):
        for n in range(N):
            o = np.clip(states[t, n].astype(float), -10, 10)
            out[t, n] = [*o, *(o**2), t / 100, (t / 100) ** 2, (t / 100) ** 3, 1]
    return out


def slow_ridge(feature, targets, mask, ridge):
    x, y = feature[mask > 0], targets[mask > 0]
    return np.linalg.solve(x.T @ x + ridge * np.eye(x.shape[1]), x.T @ y)


def slow_standardise(x, mask):
    chosen = x[mask > 0]
    return np.where(mask > 0, (x - chosen.mean()) / (chosen.std() + 1e-8), 0.0)


@given(seeds, shares)
@settings(max_examples=25, deadline=None)
def test_discounted_returns(seed, discount):
    _, rewards, _, mask, lengths = a_batch(seed)
    got = discounted_returns(rewards, mask, discount)
    np.testing.assert_allclose(got, slow_returns(rewards, lengths, discount), atol=1e-5)


@given(seeds, shares, shares)
@settings(max_examples=40, deadline=None)
def test_gae(seed, discount, gae_lambda):
    _, rewards, values, mask, lengths = a_batch(seed)
    got = gae(rewards, values, mask, discount, gae_lambda)
    np.testing.assert_allclose(got, slow_gae(rewards, values, lengths, discount, gae_lambda), atol=2e-5)


def test_gae_known_answers():
    rewards = np.array([[1.0], [2.0], [4.0]], np.float32)
    values = np.array([[0.5], [0.25], [8.0]], np.float32)
    ones = np.ones((3, 1), np.float32)
    # lambda 1: the return minus the value; lambda 0: the TD error; terminated after two steps: no value beyond
    np.testing.assert_allclose(gae(rewards, values, ones, 1.0, 1.0)[:, 0], [6.5, 5.75, -4.0])
    np.testing.assert_allclose(gae(rewards, values, ones, 0.5, 0.0)[:, 0], [0.625, 5.75, -4.0])
    ended = np.array([[1.0], [1.0], [0.0]], np.float32)
    np.testing.assert_allclose(gae(rewards, values, ended, 1.0, 1.0)[:, 0], [2.5, 1.75, 0.0])


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_features(seed):
    states = 8 * np.random.default_rng(seed).normal(size=(T, N, S)).astype(np.float32)
    np.testing.assert_allclose(features(states), slow_features(states), rtol=1e-5, atol=1e-6)


@given(seeds, st.sampled_from([1e-5, 1e-2, 10.0]))
@settings(max_examples=25, deadline=None)
def test_baseline_is_ridge_regression_on_the_steps_that_count(seed, ridge):
    rng, _, _, mask, _ = a_batch(seed)
    feature = slow_features(rng.normal(size=(T, N, S)))
    # More rows than columns are sure to count, so that the fit is determined.
    mask[:, :2] = 1
    targets = rng.normal(size=(T, N)) + feature @ rng.normal(size=feature.shape[-1])
    weights = fit_baseline(feature.astype(np.float32), targets.astype(np.float32), mask, ridge)
    slow = slow_ridge(feature, targets, mask, ridge)
    residual = np.linalg.norm((targets - feature @ slow)[mask > 0])
    # t, t^2, t^3 are nearly collinear over 12 steps: float32 finds other weights, of as good a fit.
    np.testing.assert_allclose((feature @ weights)[mask > 0], (feature @ slow)[mask > 0], atol=0.05 + 0.01 * residual)


def test_the_baseline_recovers_values_linear_in_its_features():
    rng = np.random.default_rng(0)
    states = rng.normal(size=(100, 50, S)).astype(np.float32)
    feature = np.asarray(features(states), np.float64)
    truth = rng.normal(size=2 * S + 4)
    mask = np.ones((100, 50), np.float32)
    targets = (feature @ truth).astype(np.float32)
    weights = fit_baseline(feature.astype(np.float32), targets, mask, 1e-5)
    np.testing.assert_allclose(weights, truth, atol=0.02)
    np.testing.assert_allclose(feature @ weights, targets, atol=1e-3)


def test_a_strong_ridge_shrinks_the_baseline():
    rng = np.random.default_rng(1)
    feature, targets = np.ones((T, N, 1), np.float32), rng.normal(size=(T, N)).astype(np.float32) + 3
    got = fit_baseline(feature, targets, np.ones((T, N), np.float32), 60.0)
    assert float(got[0]) == pytest.approx(targets.sum() / (T * N + 60), rel=1e-4)


@pytest.mark.parametrize("constant", [0.0, 2.0])
def test_collinear_columns_do_not_break_the_fit(constant):
    """A constant state repeats the column of ones; a zero state is an empty column."""
    states = np.full((T, N, S), constant, np.float32)
    feature = features(states)
    ones = np.ones((T, N), np.float32)
    weights = fit_baseline(feature, 5 * ones, ones, 1e-5)
    np.testing.assert_allclose(feature @ weights, 5.0, atol=1e-2)


def test_a_fit_that_fails_gives_the_zero_baseline():
    feature = np.ones((T, N, 4), np.float32)
    targets = np.full((T, N), np.nan, np.float32)
    assert not np.any(fit_baseline(feature, targets, np.ones((T, N), np.float32), 1e-5))


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_standardise(seed):
    _, x, _, mask, _ = a_batch(seed)
    got = np.asarray(standardise(10 + 3 * x, mask))
    np.testing.assert_allclose(got, slow_standardise(10 + 3 * x.astype(float), mask), atol=1e-4)
    chosen = got[mask > 0]
    assert chosen.mean() == pytest.approx(0, abs=1e-4)
    assert chosen.std() == pytest.approx(1, abs=1e-3)


def test_standardise_of_nothing_and_of_equals_is_zero():
    zeros, ones = np.zeros((T, N), np.float32), np.ones((T, N), np.float32)
    assert not np.any(standardise(ones, zeros))
    assert not np.any(standardise(7 * ones, ones))
    single = zeros.copy()
    single[3, 2] = 1
    assert not np.any(standardise(7 * ones, single)), "the mean over one step is that step"


@pytest.mark.parametrize("size", [1e-8, 1e-3, 1e4])
def test_standardise_makes_one_of_any_spread_but_of_rounding(size):
    """Advantages of +-size become +-1, but for those that differ by 1e-8 only, which are not blown up."""
    signs = np.where((np.arange(T)[:, None] + np.arange(N)) % 2, 1.0, -1.0)
    got = standardise((size * signs).astype(np.float32), np.ones((T, N), np.float32))
    np.testing.assert_allclose(got, signs * size / (size + 1e-8), rtol=1e-4)


@given(seeds, shares, shares)
@settings(max_examples=25, deadline=None)
def test_each_batch_is_judged_by_the_previous_fit(seed, discount, gae_lambda):
    rng, rewards, _, mask, lengths = a_batch(seed)
    mask[:, :2], lengths[:2] = 1, T
    states = rng.normal(size=(T, N, S)).astype(np.float32)
    baseline = rng.normal(size=2 * S + 4).astype(np.float32)
    trajectories = Trajectories(states, np.zeros((T, N, 1), np.float32), rewards, mask)
    got, refitted = advantages_and_baseline(trajectories, baseline, discount, gae_lambda, 1e-5)
    feature = slow_features(states)
    slow = slow_gae(rewards, feature @ baseline.astype(float), lengths, discount, gae_lambda)
    np.testing.assert_allclose(got, slow_standardise(slow, mask), atol=1e-3)
    # The new fit is to this batch's returns and knows nothing of the old one.
    expected = feature @ slow_ridge(feature, slow_returns(rewards, lengths, discount), mask, 1e-5)
    np.testing.assert_allclose((feature @ refitted)[mask > 0], expected[mask > 0], atol=0.1)
    _, again = advantages_and_baseline(trajectories, 0 * baseline, discount, gae_lambda, 1e-5)
    np.testing.assert_array_equal(refitted, again)


def test_masked_steps_have_no_influence():
    rng, rewards, _, mask, _ = a_batch(4)
    states = rng.normal(size=(T, N, S)).astype(np.float32)
    baseline = rng.normal(size=2 * S + 4).astype(np.float32)
    actions = np.zeros((T, N, 1), np.float32)
    clean = advantages_and_baseline(Trajectories(states, actions, rewards, mask), baseline, 0.9, 0.8, 1e-5)
    off = mask == 0
    dirty_states = np.where(off[..., None], 1e5, states).astype(np.float32)
    dirty = Trajectories(dirty_states, actions, np.where(off, -1e6, rewards).astype(np.float32), mask)
    for ours, theirs in zip(advantages_and_baseline(dirty, baseline, 0.9, 0.8, 1e-5), clean, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_first_baseline_predicts_zero():
    assert linear.init(S).shape == (2 * S + 4,)
    assert not np.any(linear.init(S))


# ---------------------------------------------------------------- episodes that are cut off


@given(seeds, shares, shares)
@settings(max_examples=25, deadline=None)
def test_what_follows_a_cut_is_one_more_value(seed, discount, gae_lambda):
    """The value after the last step is that of a step more, which itself earns what it is worth."""
    rng, rewards, values, mask, lengths = a_batch(seed)
    after = (rng.normal(size=N) * (lengths == T)).astype(np.float32)
    got = gae(rewards, values, mask, discount, gae_lambda, after)
    longer = [np.concatenate([x, y[None]]) for x, y in ((rewards, after), (values, after), (mask, lengths == T))]
    expected = gae(*(x.astype(np.float32) for x in longer), discount, gae_lambda)
    np.testing.assert_allclose(got, expected[:-1], atol=1e-4)


def test_the_value_at_the_cut_is_that_of_the_endless_episode():
    """A reward of 1 for ever is worth 1 / (1 - discount), though every episode shows 5 steps of it only."""
    rng, discount = np.random.default_rng(0), 0.9
    states = rng.normal(size=(6, 40, 2)).astype(np.float32)
    ones = np.ones((5, 40), np.float32)
    endless = Trajectories(states[:5], np.zeros((5, 40, 1), np.float32), ones, ones, states[5], ones[0])
    cut = advantages_and_baseline
    baseline = np.zeros(8, np.float32)
    for _ in range(60):
        _, baseline = cut(endless, baseline, discount, 1.0, 1e-5, cut=True)
    np.testing.assert_allclose(features(states)[:1] @ baseline, 10.0, rtol=0.02)
    baseline = np.zeros(8, np.float32)
    ending = endless._replace(going_on=0 * ones[0])
    for _ in range(3):
        _, baseline = cut(ending, baseline, discount, 1.0, 1e-5, cut=True)
    # All steps look alike without time: on average (1 + ... ) over 5, 4, 3, 2, 1 steps to go.
    left = np.mean([(1 - discount**n) / (1 - discount) for n in range(1, 6)])
    np.testing.assert_allclose(np.mean(features(states)[:5] @ baseline), left, rtol=0.01)


def test_without_time_states_alone_make_the_features():
    states = np.random.default_rng(0).normal(size=(4, 3, 2)).astype(np.float32)
    with_time = features(states)
    timeless = on_host(static_argnames="timeless")(linear.features)(states, timeless=True)
    np.testing.assert_array_equal(timeless[..., 4:7], 0)
    np.testing.assert_array_equal(np.delete(timeless, range(4, 7), -1), np.delete(with_time, range(4, 7), -1))
