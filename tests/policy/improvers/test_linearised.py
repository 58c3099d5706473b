"""The mean network's Jacobian products against automatic differentiation, with full and padded chunks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from helpers import random_policy
from metrpo.policy import gaussian
from metrpo.policy.improvers import linearised


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(linearised, "CHUNK", 10)


def setting(hidden, count):
    rng = np.random.default_rng(count)
    policy = jax.tree.map(jnp.asarray, random_policy(1, 4, 2, hidden=hidden))
    states = jnp.asarray(rng.normal(size=(count, 4)), jnp.float32)
    outputs = jnp.asarray(rng.normal(size=(count, 2)), jnp.float32)
    return policy, states, outputs


@pytest.mark.parametrize(("count", "chunks", "size"), [(7, 1, 7), (10, 1, 10), (30, 3, 10), (31, 4, 10)])
def test_chunks_hold_the_batch_features_first_and_nothing_else(count, chunks, size):
    x = np.arange(2.0 * count).reshape(count, 2) + 1
    got = np.asarray(linearised.chunked(jnp.asarray(x)))
    assert got.shape == (chunks, 2, size)
    rows = got.swapaxes(1, 2).reshape(-1, 2)
    np.testing.assert_array_equal(rows[:count], x)
    assert not rows[count:].any()
    assert linearised.chunked(jnp.ones(count)).shape == (chunks, 1, size)


@pytest.mark.parametrize("hidden", [(), (5,), (5, 3), (5, 3, 4)])
@pytest.mark.parametrize("count", [7, 31])
def test_means_and_products_are_those_of_autodiff(hidden, count):
    policy, states, outputs = setting(hidden, count)

    def means(layers):
        return gaussian.mean(policy._replace(layers=layers), states)

    at = linearised.linearise(policy.layers, linearised.chunked(states))
    expected, transpose = jax.vjp(means, policy.layers)
    rows = np.asarray(at.means).swapaxes(1, 2).reshape(-1, 2)[:count]
    np.testing.assert_allclose(rows, expected, atol=1e-5)

    got = linearised.pull_back(at, linearised.chunked(outputs))
    np.testing.assert_allclose(ravel_pytree(got)[0], ravel_pytree(transpose(outputs)[0])[0], atol=1e-4)

    tangent = jax.tree.map(lambda x: jnp.sin(3 * x) + 0.1, policy.layers)
    weights = jnp.abs(outputs)
    forward = jax.jvp(means, (policy.layers,), (tangent,))[1]
    got = linearised.gauss_newton(at, linearised.chunked(weights), tangent)
    (expected,) = transpose(weights * forward)
    np.testing.assert_allclose(ravel_pytree(got)[0], ravel_pytree(expected)[0], rtol=1e-4, atol=1e-3)
