"""The ways to take a next state from the ensemble, each against one prediction after the other in plain NumPy."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import probe
from helpers import linear_ensemble, on_host, random_ensemble, slow_delta
from metrpo.model.ensemble import Ensemble
from metrpo.model.imagine import Simulator, imagine
from metrpo.model.sampling import SAMPLINGS, Keys

MEMBERS = 3
DRAWN = ("step_rand", "eps_rand")
KEYS = Keys(jax.random.key(1), jax.random.key(2))


@on_host(static_argnames="sampling")
def sample(sampling, ensemble, states, actions, keys=KEYS):
    return SAMPLINGS[sampling].draw(ensemble, states, actions, keys)


@on_host()
def sample_all(ensemble, states, actions, keys=KEYS):
    """{name: next states}"""
    return {name: sampling.draw(ensemble, states, actions, keys) for name, sampling in SAMPLINGS.items()}


@on_host(static_argnames=("sampling", "horizon"))
def imagined(sampling, ensemble, starts, key, horizon=12):
    def act(states, key):
        return 0.3 * jax.random.normal(key, states.shape)

    return imagine(Simulator(ensemble, probe.reward, None, horizon, sampling), act, starts, key)[0]


def some(count, seed=0, state_size=4, action_size=2):
    """States and actions."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, state_size)).astype(np.float32), rng.uniform(-1, 1, (count, action_size)).astype(
        np.float32
    )


def slow_predictions(ensemble, states, actions):
    """[K, N, S]: every model's next state for every state, in float64 NumPy."""
    return np.array(
        [
            [s + slow_delta(ensemble, k, s.astype(float), a) for s, a in zip(states, actions, strict=True)]
            for k in range(ensemble.members)
        ]
    )


def drawn_models(next_states, predictions):
    """[N]: whose prediction each next state is; that of exactly one model."""
    distances = np.abs(predictions - next_states).max(axis=-1)
    assert np.all((distances < 1e-4).sum(axis=0) == 1)
    return distances.argmin(axis=0)


# ---------------------------------------------------------------- a model drawn for each state


@pytest.mark.parametrize("sampling", DRAWN)
@pytest.mark.parametrize("count", [9, 10])
def test_each_next_state_is_one_models_all_drawn_equally_often(sampling, count):
    ensemble = random_ensemble(0, MEMBERS)
    states, actions = some(count)
    predictions = slow_predictions(ensemble, states, actions)
    many = jax.random.split(jax.random.key(3), 1000)
    drawn = on_host(static_argnames="sampling")(
        lambda sampling: jax.vmap(
            lambda key: SAMPLINGS[sampling].draw(ensemble, jnp.asarray(states), jnp.asarray(actions), Keys(key, key))
        )(many)
    )(sampling)
    models = np.array([drawn_models(x, predictions) for x in drawn])
    for n in range(count):
        assert stats.chisquare(np.bincount(models[:, n], minlength=MEMBERS)).pvalue > 1e-4
    # In groups as equal as they can be.
    assert max(np.bincount(m, minlength=MEMBERS).max() for m in models) == -(-count // MEMBERS)


@pytest.mark.parametrize(("sampling", "its"), [("step_rand", 0), ("eps_rand", 1)])
def test_step_rand_uses_the_steps_key_and_eps_rand_the_episodes(sampling, its):
    ensemble, (states, actions) = random_ensemble(1, MEMBERS), some(20, 1)
    before, other = sample(sampling, ensemble, states, actions), jax.random.key(7)
    by_step = sample(sampling, ensemble, states, actions, KEYS._replace(step=other))
    by_episode = sample(sampling, ensemble, states, actions, KEYS._replace(episode=other))
    assert [not np.array_equal(before, x) for x in (by_step, by_episode)] == [its == 0, its == 1]


def imagined_models(sampling, key, count=10, horizon=12, members=MEMBERS):
    """[T - 1, N]: whose prediction each imagined step is, of models that no step can confuse."""
    matrices = [(0.9 * probe.A + 0.05 * k * np.eye(2), (0.2 + 0.3 * k) * np.eye(2)) for k in range(members)]
    ensemble = linear_ensemble(matrices)
    bias = np.array([[[k, -k]] for k in range(members)], np.float32)
    ensemble = ensemble._replace(networks=((ensemble.networks[0][0], bias),))
    starts = np.random.default_rng(0).uniform(-1, 1, (count, 2)).astype(np.float32)
    t = imagined(sampling, ensemble, starts, jax.random.key(key), horizon)
    assert np.all(t.mask == 1)
    states = np.asarray(t.states, np.float64)
    actions = np.clip(np.asarray(t.actions, np.float64), -1, 1)
    following = [states[:-1] @ a.T + actions[:-1] @ b.T + bias[k, 0] for k, (a, b) in enumerate(matrices)]
    return drawn_models(states[1:].reshape(-1, 2), np.array(following).reshape(members, -1, 2)).reshape(-1, count)


def test_eps_rand_keeps_an_episodes_model_step_rand_draws_anew():
    whole = imagined_models("eps_rand", 0)
    np.testing.assert_array_equal(whole, np.broadcast_to(whole[0], whole.shape))
    assert set(whole[0]) == {0, 1, 2}, "not one model for all episodes"
    assert not np.array_equal(whole[0], imagined_models("eps_rand", 1)[0])
    anew = imagined_models("step_rand", 0)
    assert len({tuple(step) for step in anew}) == len(anew), "not the same models in two steps"
    assert min(len(set(episode)) for episode in anew.T) > 1
    # Drawn independently of the step before: it is kept in a third of the steps.
    kept = anew[1:] == anew[:-1]
    assert stats.binomtest(int(kept.sum()), kept.size, 1 / MEMBERS).pvalue > 1e-4


def test_each_episodes_model_is_drawn_equally_often():
    models = np.array([imagined_models("eps_rand", key)[0] for key in range(200)])
    for n in (0, 4, 9):
        assert stats.chisquare(np.bincount(models[:, n], minlength=MEMBERS)).pvalue > 1e-4
    table = stats.contingency.crosstab(models[1:, 0], models[:-1, 0]).count
    assert stats.chi2_contingency(table).pvalue > 1e-4


# ---------------------------------------------------------------- no draw: one model, mean, median


@pytest.mark.parametrize("members", [3, 4])
def test_samplings_without_a_draw_are_numpys(members):
    ensemble, (states, actions) = random_ensemble(members, members), some(7, members)
    predictions = slow_predictions(ensemble, states, actions)
    got = sample_all(ensemble, states, actions)
    again = sample_all(ensemble, states, actions, Keys(jax.random.key(8), jax.random.key(9)))
    for name, slow in {
        "one_model": predictions[0],
        "model_mean": np.mean(predictions, axis=0),
        "model_med": np.median(predictions, axis=0),
    }.items():
        np.testing.assert_allclose(got[name], slow, atol=1e-4)
        np.testing.assert_array_equal(got[name], again[name])


def test_the_median_is_taken_in_each_dimension_alone():
    """Three models whose order differs between dimensions."""
    shifts = np.array([[0.0, 5.0], [1.0, 0.0], [9.0, 1.0]], np.float32)
    ensemble = Ensemble(((np.zeros((3, 4, 2), np.float32), shifts[:, None]),), linear_ensemble([(probe.A, probe.B)])[1])
    states, actions = some(4, state_size=2)
    got = sample_all(ensemble, states, actions)
    for name, shift in {"model_med": (1, 1), "model_mean": (10 / 3, 2), "one_model": (0, 5)}.items():
        np.testing.assert_allclose(got[name] - states, np.broadcast_to(shift, states.shape), atol=1e-5)


def test_of_one_model_every_sampling_is_its_prediction():
    ensemble, (states, actions) = random_ensemble(4, 1), some(6, 4)
    expected = slow_predictions(ensemble, states, actions)[0]
    for got in sample_all(ensemble, states, actions).values():
        np.testing.assert_allclose(got, expected, atol=1e-4)


# ---------------------------------------------------------------- a normal distribution of the predictions


def test_model_mean_std_draws_from_the_predictions_normal():
    ensemble, (states, actions) = random_ensemble(2, 5), some(2, 2)
    predictions, draws = slow_predictions(ensemble, states, actions), 4000
    many = jax.random.split(jax.random.key(4), draws)
    drawn = on_host()(
        jax.vmap(
            lambda key: SAMPLINGS["model_mean_std"].draw(
                ensemble, jnp.asarray(states), jnp.asarray(actions), KEYS._replace(step=key)
            )
        )
    )(many)
    mean, std = predictions.mean(axis=0), predictions.std(axis=0)
    z = ((drawn - mean) / std).reshape(draws, -1)
    assert z.shape == (draws, 8)
    # Of K = 5 predictions, a standard deviation with K - 1 below would be 12 % larger; of 4000 draws one errs by 1.1 %.
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=4.5 / np.sqrt(draws))
    np.testing.assert_allclose(z.std(axis=0), 1, atol=4.5 / np.sqrt(2 * draws))
    for column in z.T:
        assert stats.kstest(column, "norm").pvalue > 1e-4
    # Independently for every dimension of every state.
    assert np.abs(np.corrcoef(z.T) - np.eye(8)).max() < 4.5 / np.sqrt(draws)


def test_model_mean_std_draws_anew_in_every_step():
    """Of models that never move in the mean, each step is the noise."""
    networks = ((np.zeros((2, 4, 2), np.float32), np.array([[[0.1, 0.1]], [[-0.1, -0.1]]], np.float32)),)
    ensemble = Ensemble(networks, linear_ensemble([(probe.A, probe.B)]).normaliser)
    t = imagined("model_mean_std", ensemble, np.zeros((50, 2), np.float32), jax.random.key(5), 41)
    noise = np.diff(t.states, axis=0) / 0.1
    assert stats.kstest(noise.ravel(), "norm").pvalue > 1e-4
    assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 4.5 / np.sqrt(noise.size)


@on_host()
def gradients(ensemble, states, actions):
    """{name: gradient of a sum over the next states, with respect to states and actions}"""

    def total(name, states, actions):
        return jnp.sum(jnp.sin(SAMPLINGS[name].draw(ensemble, states, actions, KEYS)))

    return {name: jax.grad(partial(total, name), (0, 1))(states, actions) for name in SAMPLINGS}


def test_every_sampling_of_equal_models_is_their_prediction():
    """The standard deviation is 0 there, where a square root has no slope."""
    one = random_ensemble(3, 1)
    # Of two equal predictions the mean is exact, so that no rounding makes the variance positive.
    two = one._replace(networks=jax.tree.map(lambda x: np.repeat(x, 2, axis=0), one.networks))
    states, actions = some(5, 3)
    expected = slow_predictions(one, states, actions)[0]
    for got in sample_all(two, states, actions).values():
        np.testing.assert_allclose(got, expected, atol=1e-4)
    got = gradients(two, states, actions)
    for name in SAMPLINGS:
        for ours, alone in zip(got[name], got["one_model"], strict=True):
            assert np.any(alone)
            np.testing.assert_allclose(ours, alone, atol=1e-4)


# with 64 bits, model_choice puts int64 model numbers, all below K, into an int32 array
def test_gradients_are_those_of_finite_differences():
    ensemble, (states, actions) = random_ensemble(6, MEMBERS), some(3, 6)
    with jax.enable_x64(True):
        ensemble, states, actions = jax.tree.map(lambda x: np.asarray(x, np.float64), (ensemble, states, actions))
        got = gradients(ensemble, states, actions)
        inputs = np.concatenate([states, actions], axis=1)
        for index in np.ndindex(inputs.shape):
            step = np.zeros(inputs.shape)
            step[index] = 1e-6
            up, down = (sample_all(ensemble, x[:, :4], x[:, 4:]) for x in (inputs + step, inputs - step))
            for name in SAMPLINGS:
                slope = (np.sin(up[name]).sum() - np.sin(down[name]).sum()) / 2e-6
                assert np.concatenate(got[name], axis=1)[index] == pytest.approx(slope, abs=1e-6)
