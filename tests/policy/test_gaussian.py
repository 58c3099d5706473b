"""The Gaussian policy against SciPy and slow NumPy versions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from helpers import on_host, random_policy, slow_mean
from metrpo.policy import gaussian

kl, log_probability = on_host()(gaussian.kl), on_host()(gaussian.log_probability)
numbers = st.floats(-3, 3, width=32)
vectors = hnp.arrays(np.float32, 3, elements=numbers)
log_stds = hnp.arrays(np.float32, 3, elements=st.floats(-1.5, 1.5, width=32))


@pytest.mark.parametrize("hidden", [(), (7,), (6, 5, 4)])
def test_mean_is_the_tanh_network_with_a_linear_end(hidden):
    policy = random_policy(3, hidden=hidden)
    states = 2 * np.random.default_rng(0).normal(size=(2, 5, 4)).astype(np.float32)
    expected = np.array([[slow_mean(policy, s) for s in row] for row in states])
    np.testing.assert_allclose(gaussian.mean(policy, states), expected, atol=1e-5)


def test_mean_stays_in_the_library_of_its_input():
    policy = random_policy(1)
    states = np.random.default_rng(0).normal(size=(6, 4))
    on_host = gaussian.mean(policy, states)
    on_device = gaussian.mean(jax.tree.map(jnp.asarray, policy), jnp.asarray(states, jnp.float32))
    assert isinstance(on_host, np.ndarray)
    assert isinstance(on_device, jax.Array)
    np.testing.assert_allclose(on_host, on_device, atol=1e-5)
    assert gaussian.mean(policy, states[0]).shape == (2,)


@given(vectors, vectors, log_stds)
@settings(max_examples=50, deadline=None)
def test_log_probability_is_scipys(means, actions, log_std):
    expected = stats.norm.logpdf(actions.astype(float), means, np.exp(log_std.astype(float))).sum()
    np.testing.assert_allclose(log_probability(means, log_std, actions), expected, rtol=1e-4, atol=1e-4)


@given(vectors, log_stds, vectors, log_stds)
@settings(max_examples=50, deadline=None)
def test_kl_is_the_integral_of_its_definition(old_means, old_log_std, means, log_std):
    """KL is the old policy's mean of log(old / new); 40 Gauss-Hermite nodes integrate the quadratic exactly."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    weights = weights / weights.sum()
    expected = 0.0
    for m0, l0, m1, l1 in zip(*(x.astype(float) for x in (old_means, old_log_std, means, log_std)), strict=True):
        x = m0 + np.exp(l0) * nodes
        expected += weights @ (stats.norm.logpdf(x, m0, np.exp(l0)) - stats.norm.logpdf(x, m1, np.exp(l1)))
    got = float(kl(old_means, old_log_std, means, log_std))
    assert got == pytest.approx(expected, rel=1e-3, abs=1e-4)
    assert got >= -1e-5


def test_kl_with_itself_is_zero_and_with_others_not_symmetric():
    zero, one = np.zeros(2, np.float32), np.ones(2, np.float32)
    assert kl(one, one, one, one) == 0
    # N(0, 1) against N(0, e^2) in two dimensions: log(sigma) + 1 / (2 sigma^2) - 1/2 each
    assert kl(zero, zero, zero, one) == pytest.approx(2 * (1 + np.exp(-2) / 2 - 0.5), rel=1e-5)
    assert kl(zero, one, zero, zero) == pytest.approx(2 * (-1 + np.exp(2) / 2 - 0.5), rel=1e-5)


def test_samples_have_the_policys_mean_and_standard_deviation():
    policy = random_policy(5)
    states = np.random.default_rng(0).normal(size=(1, 4)).astype(np.float32).repeat(20_000, axis=0)
    z = (np.asarray(gaussian.sample(policy, states, jax.random.key(0))) - slow_mean(policy, states[0])) / np.exp(
        policy.log_std
    )
    for column in z.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(z.T)[0, 1]) < 0.03


def test_fresh_policies_are_xavier_uniform_with_the_initial_std():
    policy = gaussian.init(jax.random.key(0), 40, 30, (50,), 0.25)
    assert [w.shape for w, _ in policy.layers] == [(40, 50), (50, 30)]
    for weights, biases in policy.layers:
        bound = np.sqrt(6 / sum(weights.shape))
        assert not np.any(biases)
        assert 0.98 * bound < np.abs(weights).max() <= bound
        assert np.std(weights) == pytest.approx(bound / np.sqrt(3), rel=0.05)
    np.testing.assert_allclose(np.exp(policy.log_std), 0.25, rtol=1e-6)
    assert policy.log_std.shape == (30,)
    other = gaussian.init(jax.random.key(1), 40, 30, (50,), 0.25)
    assert not np.allclose(policy.layers[0][0], other.layers[0][0])


def test_reset_std_changes_nothing_else():
    policy = random_policy(2)
    reset = gaussian.reset_std(policy, 0.5)
    np.testing.assert_allclose(np.exp(reset.log_std), 0.5, rtol=1e-6)
    assert jax.tree.all(jax.tree.map(np.array_equal, reset.layers, policy.layers))
