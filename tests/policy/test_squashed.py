"""The squashed Gaussian: its density, and its mean as a plain policy."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import on_host, slow_mean
from metrpo.policy import gaussian, squashed
from metrpo.policy.inputs import Inputs
from metrpo.policy.squashed import LOG_STD, Actor

S, A = 3, 2


def actor(seed=0, scale=1.0):
    rng = np.random.default_rng(seed)
    shapes = [((S, 8), 8), ((8, 2 * A), 2 * A)]
    return Actor(
        tuple(
            ((scale * rng.normal(size=w)).astype(np.float32), rng.normal(size=b).astype(np.float32)) for w, b in shapes
        )
    )


def test_log_probabilities_are_those_of_a_squashed_gaussian():
    states = np.random.default_rng(1).normal(size=(500, S)).astype(np.float32)
    a = actor(scale=0.4)
    actions, log_probs = on_host()(squashed.sample)(a, states, jax.random.key(0))
    means, log_std = (x.astype(np.float64) for x in squashed.moments(a, states))
    assert np.abs(actions).max() <= 1
    before = np.arctanh(np.clip(actions.astype(np.float64), -1 + 1e-9, 1 - 1e-9))
    z = (before - means) / np.exp(log_std)
    expected = -0.5 * z**2 - log_std - 0.5 * math.log(2 * math.pi) - np.log1p(-(np.tanh(before) ** 2))
    inside = np.abs(actions).max(axis=1) < 0.999  # beyond, arctanh has lost the digits
    assert inside.sum() > 100
    np.testing.assert_allclose(log_probs[inside], expected.sum(-1)[inside], rtol=1e-3, atol=1e-3)


def test_the_entropy_estimate_is_the_densitys_entropy():
    """Of one action with mean 0.5 and std e^-0.5: by the trapezoid rule, on a grid of 20,001 points."""
    layers = ((np.zeros((S, 2), np.float32), np.array([0.5, -0.5], np.float32)),)
    _, log_probs = squashed.sample(Actor(layers), jnp.zeros((200_000, S)), jax.random.key(0))
    u = np.linspace(-6, 7, 20_001)
    density = np.exp(-0.5 * ((u - 0.5) / math.exp(-0.5)) ** 2) / (math.exp(-0.5) * math.sqrt(2 * math.pi))
    log_density = np.log(density) - np.log(1 - np.tanh(u) ** 2)
    expected = -np.trapezoid(density * log_density, u)
    assert np.trapezoid(density, u) == pytest.approx(1, abs=1e-6)
    assert float(-log_probs.mean()) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("x", [-60.0, -5.0, 0.0, 5.0, 60.0])
def test_the_slope_of_tanh_is_finite_far_out_and_so_is_its_gradient(x):
    value, gradient = jax.value_and_grad(squashed.log_slope)(x)
    expected = 2 * (math.log(2) - abs(x) - math.log1p(math.exp(-2 * abs(x))))
    assert float(value) == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert float(gradient) == pytest.approx(-2 * math.tanh(x), abs=1e-5)


def test_log_stds_are_bounded():
    _, log_std = squashed.moments(actor(scale=50.0), np.ones((100, S), np.float32) * np.linspace(-9, 9, 100)[:, None])
    assert (log_std.min(), log_std.max()) == LOG_STD


@pytest.mark.parametrize("normalise", [False, True])
def test_the_mean_is_a_plain_policy_of_raw_states(normalise):
    inputs = Inputs(np.array([1, -2, 50], np.float32), np.array([0.5, 3, 0], np.float32)) if normalise else None
    states = np.random.default_rng(2).normal(size=(20, S)).astype(np.float32)
    seen = (states - inputs.shift) * inputs.scale if normalise else states
    a = actor()
    policy = squashed.mean_policy(a, inputs, states)
    means, log_std = squashed.moments(a, seen)
    np.testing.assert_allclose([slow_mean(policy, s) for s in states], np.tanh(means), atol=1e-5)
    np.testing.assert_allclose(policy.log_std, log_std.mean(axis=0), rtol=1e-5)
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(policy))


def test_numpy_and_jax_draw_from_the_same_density():
    a, state = actor(), np.full(S, 0.3, np.float32)
    rng = np.random.default_rng(0)
    drawn = np.arctanh([squashed.draw(a, state, rng.standard_normal(A)) for _ in range(4000)])
    means, log_std = squashed.moments(a, state)
    np.testing.assert_allclose(drawn.mean(0), means, atol=0.2 * np.exp(log_std).max())
    np.testing.assert_allclose(drawn.std(0), np.exp(log_std), rtol=0.1)


def test_kl_is_that_of_the_gaussians_before_the_tanh():
    states = np.random.default_rng(3).normal(size=(9, S)).astype(np.float32)
    one, other = actor(scale=0.3), actor(1, scale=0.3)
    np.testing.assert_allclose(squashed.kl(one, one, states), 0, atol=1e-6)
    expected = gaussian.kl(*squashed.moments(one, states), *squashed.moments(other, states))
    np.testing.assert_allclose(squashed.kl(one, other, states), expected, rtol=1e-4)
