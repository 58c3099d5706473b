"""Members that also predict how far off they are."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from metrpo.config import FitConfig
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble, mean_and_spread, predict, predict_delta
from metrpo.model.fit import fit
from metrpo.model.imagine import Simulator, returns_per_model
from metrpo.model.sampling import SAMPLINGS, Keys
from metrpo.types import Transitions

KEY = jax.random.key(0)


def noise_of(first):
    """The standard deviation of a system's noise, by its first state: 0.06 to 0.4."""
    return 0.15 * np.exp(first)


def a_system(size, seed=0):
    """Transitions of a linear system whose noise depends on the state."""
    rng = np.random.default_rng(seed)
    states, actions = rng.uniform(-1, 1, (size, 2)), rng.uniform(-1, 1, (size, 1))
    noise = noise_of(states[:, :1]) * rng.normal(size=(size, 2))
    deltas = 0.5 * states @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + actions + noise
    return Transitions(*(x.astype(np.float32) for x in (states, actions, deltas)), np.int32(size))


@pytest.fixture(scope="module")
def fitted():
    train, validation = a_system(4000), a_system(1000, seed=1)
    normaliser = ensembles.normaliser_of(train, 0.1, 0.1)
    networks = ensembles.init(KEY, 2, 2, 1, (32, 32), probabilistic=True)
    config = FitConfig(learning_rate=3e-3, batch_size=100, validate_every=5, max_passes=60, patience=60)
    return fit(Ensemble(networks, normaliser), train, validation, config, KEY)[0]


def held_out(count=2000):
    data = a_system(count, seed=2)
    return (np.stack([x] * 2) for x in data[:3]), data.states[:, 0]


def test_the_spread_is_as_wide_as_the_errors_where_they_are_made(fitted):
    (states, actions, deltas), first = held_out()
    _, log_spread = mean_and_spread(fitted, states, actions)
    spread = np.exp(log_spread) * fitted.normaliser.delta_std
    errors = predict_delta(fitted, states, actions) - deltas
    for where in (first < -0.5, np.abs(first) < 0.2, first > 0.5):
        assert np.std(errors[:, where] / spread[:, where]) == pytest.approx(1.0, abs=0.2)
        assert np.median(spread[:, where]) == pytest.approx(np.median(noise_of(first[where])), rel=0.25)


def test_with_a_key_it_draws_around_the_mean(fitted):
    state, action = np.array([0.5, 0.1], np.float32), np.array([0.2], np.float32)
    states, actions = (np.broadcast_to(x, (2, 4000, x.size)) for x in (state, action))
    mean = np.asarray(predict(fitted, states, actions))
    drawn = np.asarray(predict(fitted, states, actions, KEY))
    spread = np.exp(mean_and_spread(fitted, states, actions)[1]) * fitted.normaliser.delta_std
    assert np.ptp(mean, axis=1).max() < 1e-6
    assert stats.kstest(((drawn - mean) / spread).ravel(), "norm").pvalue > 1e-3
    np.testing.assert_array_equal(drawn, predict(fitted, states, actions, KEY))
    others = np.asarray(predict(fitted, states, actions, jax.random.key(1)))
    assert abs(np.corrcoef((drawn - mean).ravel(), (others - mean).ravel())[0, 1]) < 0.05


@pytest.mark.parametrize("sampling", ["step_rand", "eps_rand", "one_model"])
def test_what_takes_one_models_word_draws_with_its_spread_anew_in_each_step(fitted, sampling):
    states, actions = np.full((4000, 2), 0.5, np.float32), np.zeros((4000, 1), np.float32)
    draw = SAMPLINGS[sampling].draw
    now, then = (draw(fitted, states, actions, Keys(KEY, KEY, jax.random.key(i))) for i in (1, 2))
    for drawn in (now, then):
        np.testing.assert_allclose(np.std(drawn, axis=0), noise_of(0.5), rtol=0.3)
    assert abs(np.corrcoef(now[:, 0], then[:, 0])[0, 1]) < 0.2


@pytest.mark.parametrize("sampling", ["model_mean", "model_med"])
def test_what_asks_all_models_takes_their_means(fitted, sampling):
    states, actions = np.full((10, 2), 0.5, np.float32), np.zeros((10, 1), np.float32)
    drawn = SAMPLINGS[sampling].draw(fitted, states, actions, Keys(KEY, KEY, KEY))
    assert np.ptp(drawn, axis=0).max() < 1e-6


def test_gradients_go_through_the_mean_alone(fitted):
    def total(states, key):
        return jnp.sum(predict(fitted, states, np.zeros((2, 3, 1), np.float32), key))

    states = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (2, 3, 2)), jnp.float32)
    np.testing.assert_allclose(jax.grad(total)(states, KEY), jax.grad(total)(states, None), rtol=1e-5, atol=1e-6)


def test_the_mean_learns_what_it_would_learn_without_a_spread():
    train, validation = a_system(300), a_system(100, seed=1)
    normaliser = ensembles.normaliser_of(train, 0.1, 0.1)
    config = FitConfig(learning_rate=0.01, batch_size=20, validate_every=2, max_passes=6, patience=99)
    probabilistic = ensembles.init(KEY, 2, 2, 1, (8, 8), probabilistic=True)
    *inner, (weights, biases) = probabilistic
    plain = (*inner, (weights[..., :2], biases[..., :2]))
    for settings in (config, replace(config, loss_units="std")):
        (ours, info), (theirs, its) = (
            fit(Ensemble(networks, normaliser), train, validation, settings, KEY) for networks in (probabilistic, plain)
        )
        np.testing.assert_allclose(info.validation_loss, its.validation_loss, rtol=1e-4)
        np.testing.assert_allclose(ours.networks[0][0], theirs.networks[0][0], atol=1e-4)
        np.testing.assert_allclose(ours.networks[-1][0][..., :2], theirs.networks[-1][0], atol=1e-4)
        assert not np.allclose(ours.networks[-1][0][..., 2:], weights[..., 2:], atol=1e-2), "the spread learned"


def test_a_return_is_of_noisy_episodes_where_there_is_a_key(fitted):
    simulator = Simulator(fitted, lambda states, actions, following: following[..., 0], None, 1)
    starts = np.full((4000, 2), 0.5, np.float32)

    def returns(key):
        return np.asarray(
            returns_per_model(simulator, lambda states: jnp.zeros((*states.shape[:2], 1)), starts, key=key)
        )

    means, noisy = returns(None), [returns(jax.random.key(i)) for i in range(2)]
    np.testing.assert_array_equal(means, returns(None))
    for one in noisy:
        assert not np.array_equal(one, means)
        np.testing.assert_allclose(one, means, atol=5 * noise_of(0.5) / np.sqrt(4000))


def test_others_have_no_spread_and_no_noise():
    normaliser = ensembles.normaliser_of(a_system(100), 0.1, 0.1)
    plain = Ensemble(ensembles.init(KEY, 2, 2, 1, (8,)), normaliser)
    states, actions = np.ones((2, 5, 2), np.float32), np.zeros((2, 5, 1), np.float32)
    assert mean_and_spread(plain, states, actions)[1] is None
    np.testing.assert_array_equal(predict(plain, states, actions, KEY), predict(plain, states, actions))
