"""Stochastic value gradients against finite differences, a closed form, and returns to go."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probe
from helpers import linear_ensemble, random_ensemble, random_policy, slow_delta, slow_mean
from metrpo.baselines import value_gradients
from metrpo.baselines.path_gradient import RealPath, padded, state_value, value_gradient
from metrpo.config import Config
from metrpo.policy.gaussian import Policy
from metrpo.presets import override


def path_of(rng, weights, bias, std, steps, start=None):
    """A real path of the probe under a = s W + b + noise, which stays within the limits; and its noise."""
    states = [rng.uniform(-0.3, 0.3, 2) if start is None else start]
    noise = rng.normal(size=(steps, 2))
    drawn = []
    for t in range(steps):
        drawn.append(states[-1] @ weights + bias + std * noise[t])
        states.append(probe.A @ states[-1] + probe.B @ drawn[-1])
    drawn, states = np.array(drawn), np.array(states)
    assert np.abs(drawn).max() < 1
    rewards = probe.reward(states[:-1], drawn, states[1:])
    path = RealPath(states, drawn, rewards, np.ones(steps))
    return jax.tree.map(lambda x: np.asarray(x, np.float32), path), noise


def realised(weights, bias, std, noise, start, discount):
    """The return of the path with this noise, in float64."""
    state, total = np.array(start, np.float64), 0.0
    for t, n in enumerate(noise):
        action = state @ weights + bias + std * n
        following = probe.A @ state + probe.B @ action
        total += discount**t * probe.reward(state, action, following)
        state = following
    return total


def linear_policy(weights, bias, std):
    return Policy(((np.float32(weights), np.float32(bias)),), np.log(np.float32(std)))


def differences(f, *parameters, h=1e-5):
    """Central finite differences of f(*parameters) with respect to each."""
    gradients = []
    for i, parameter in enumerate(parameters):
        gradient = np.zeros_like(parameter)
        for index in np.ndindex(parameter.shape):
            step = np.zeros_like(parameter)
            step[index] = h
            up, down = list(parameters), list(parameters)
            up[i], down[i] = parameter + step, parameter - step
            gradient[index] = (f(*up) - f(*down)) / (2 * h)
        gradients.append(gradient)
    return gradients


WEIGHTS, BIAS, STD = np.array([[-0.5, 0.2], [-0.1, -0.4]]), np.array([0.05, -0.02]), np.array([0.05, 0.08])


@pytest.mark.parametrize("wrong_by", [0.0, 0.5])
@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_svg_inf_is_the_gradient_of_the_real_paths_return(wrong_by, discount):
    """Also through a model that is off by a constant: the residuals put that right, its derivatives are sound."""
    rng = np.random.default_rng(0)
    path, noise = path_of(rng, WEIGHTS, BIAS, STD, 12)
    model = linear_ensemble([(probe.A, probe.B)])
    *inner, (weights, biases) = model.networks
    model = model._replace(networks=(*inner, (weights, biases + np.float32(wrong_by))))
    got = value_gradient(probe.PROBE, model, linear_policy(WEIGHTS, BIAS, STD), path, discount)

    def value(weights, bias, log_std):
        return realised(weights, bias, np.exp(log_std), noise, path.states[0], discount)

    expected = differences(value, WEIGHTS, BIAS, np.log(STD))
    for ours, theirs in zip((*got.layers[0], got.log_std), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=2e-4)


def expected_return(weights, bias, std, start, steps):
    """E[return] of the linear-Gaussian system, by its mean and covariance."""
    mean, covariance, total = np.array(start, np.float64), np.zeros((2, 2)), 0.0
    closed = probe.A + probe.B @ weights.T
    for _ in range(steps):
        action_mean = mean @ weights + bias
        action_covariance = weights.T @ covariance @ weights + np.diag(std**2)
        mean = probe.A @ mean + probe.B @ action_mean
        covariance = closed @ covariance @ closed.T + probe.B @ np.diag(std**2) @ probe.B.T
        total -= mean @ mean + np.trace(covariance) + action_mean @ action_mean + np.trace(action_covariance)
    return total


def test_svg_inf_is_on_average_the_exact_policy_gradient():
    """Of a linear system with quadratic reward, where the expected return has a closed form."""
    rng, start, steps, count = np.random.default_rng(1), np.array([0.25, -0.2]), 8, 3000
    paths = [path_of(rng, WEIGHTS, BIAS, STD, steps, start)[0] for _ in range(count)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *paths)
    gradient = partial(
        value_gradient,
        probe.PROBE,
        linear_ensemble([(probe.A, probe.B)]),
        linear_policy(WEIGHTS, BIAS, STD),
    )
    got = jax.jit(jax.vmap(lambda path: gradient(path, 1.0)))(stacked)
    expected = differences(
        lambda w, b, s: expected_return(w, b, np.exp(s), start, steps), WEIGHTS, BIAS, np.log(STD), h=1e-4
    )
    for ours, theirs in zip((*got.layers[0], got.log_std), expected, strict=True):
        ours = np.asarray(ours, np.float64)
        error = ours.std(axis=0) / np.sqrt(count)
        assert np.all(np.abs(ours.mean(axis=0) - theirs) < 5 * error + 1e-4)
        assert np.any(np.abs(theirs) > 20 * error), "a gradient of zero would pass"


def test_svg_1_differentiates_one_step_and_the_value_after_it():
    rng = np.random.default_rng(2)
    path, noise = path_of(rng, WEIGHTS, BIAS, STD, 6)
    model = random_ensemble(3, members=1, state_size=2, action_size=2, scale=0.5)
    value, discount = random_policy(4, 3, 1), 0.9
    policy = linear_policy(WEIGHTS, BIAS, STD)
    got = jax.jit(partial(value_gradient, probe.PROBE))(model, policy, path, discount, value)
    states = np.asarray(path.states, np.float64)
    residuals = [
        states[t + 1] - states[t] - slow_delta(model, 0, states[t], np.asarray(path.drawn[t], np.float64))
        for t in range(6)
    ]
    n = model.normaliser

    def total(weights, bias, log_std):
        out = 0.0
        for t in range(6):
            action = states[t] @ weights + bias + np.exp(log_std) * noise[t]
            following = states[t] + slow_delta(model, 0, states[t], action) + residuals[t]
            out += probe.reward(states[t], action, following)
            seen = np.append((following - n.state_mean) * n.state_scale, (t + 1) / 100)
            out += discount * slow_mean(value, seen)[0] if t < 5 else 0.0
        return out

    expected = differences(total, WEIGHTS, BIAS, np.log(STD))
    for ours, theirs in zip((*got.layers[0], got.log_std), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=5e-3, atol=1e-3)


@pytest.mark.parametrize("value", [None, random_policy(4, 3, 1)], ids=["inf", "1"])
def test_what_follows_the_end_of_a_path_counts_nothing(value):
    path, _ = path_of(np.random.default_rng(5), WEIGHTS, BIAS, STD, 6)
    longer = padded(path.states, path.drawn, path.rewards, 11)
    garbage = longer._replace(drawn=longer.drawn.copy())
    garbage.drawn[6:] = 0.7
    model, policy = random_ensemble(3, members=1, state_size=2, action_size=2), linear_policy(WEIGHTS, BIAS, STD)
    gradient = jax.jit(lambda p: value_gradient(probe.PROBE, model, policy, p, 1.0, value))
    expected = gradient(path)
    for got in (gradient(longer), gradient(garbage)):
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_the_value_network_learns_the_returns_to_go():
    rng = np.random.default_rng(6)
    path, _ = path_of(rng, WEIGHTS, BIAS, STD, 12, np.array([0.3, 0.3]))
    config = override(Config("Probe"), {"method": "svg", "svg.value_steps": 4000, "svg.horizon": "1"})
    state = value_gradients.init(config, probe.PROBE)
    normaliser = random_ensemble(0, members=1, state_size=2, action_size=2).normaliser
    settings = value_gradients.PolicySettings(config.svg, config.gradient, config.advantage.discount)
    value, _ = jax.jit(value_gradients._train_value, static_argnums=0)(
        settings, normaliser, state.value, state.value_moments, path
    )
    to_go = np.cumsum(path.rewards[::-1])[::-1]
    got = state_value(value, normaliser, path.states[:-1], jnp.arange(12))
    np.testing.assert_allclose(got, to_go, atol=0.05)
