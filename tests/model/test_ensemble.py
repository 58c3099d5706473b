"""The ensemble's networks and normaliser against slow NumPy versions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import (
    linear_ensemble,
    member,
    on_host,
    random_ensemble,
    random_normaliser,
    random_transitions,
    slow_delta,
)
from metrpo.history import History
from metrpo.model import ensemble as ensembles
from metrpo.types import Transitions

predict, predict_delta = on_host()(ensembles.predict), on_host()(ensembles.predict_delta)


@pytest.mark.parametrize("activation", ["relu", "silu"])
@pytest.mark.parametrize("hidden", [(), (8,), (8, 6)])
def test_prediction_is_each_members_own_network(hidden, activation):
    rng = np.random.default_rng(0)
    ensemble = random_ensemble(1, members=3, hidden=hidden)._replace(activation=ensembles.Activation(activation))
    states, actions = rng.normal(size=(3, 5, 4)).astype(np.float32), rng.normal(size=(3, 5, 2)).astype(np.float32)
    delta = predict_delta(ensemble, states, actions)
    expected = [[slow_delta(ensemble, k, states[k, b], actions[k, b]) for b in range(5)] for k in range(3)]
    np.testing.assert_allclose(delta, expected, atol=1e-5)
    np.testing.assert_allclose(predict(ensemble, states, actions), states + expected, atol=1e-5)
    assert ensemble.members == 3


@pytest.mark.parametrize("learned", [0, 1, 2])
def test_of_a_history_only_the_newest_observation_is_predicted_and_the_rest_is_shifted(learned):
    layout, rng = History(3, 2, 1), np.random.default_rng(0)
    size, outputs = layout.state_size, layout.observation_size + learned  # with two more, as many as a state of N = 2
    networks = random_ensemble(1, 3, size, 1, (8, outputs)).networks[:2]
    n = random_normaliser(rng, size, 1)
    n = n._replace(delta_mean=n.delta_mean[:outputs], delta_std=n.delta_std[:outputs])
    ensemble = ensembles.Ensemble(networks, n, ensembles.Carried(layout.carried))
    states, actions = rng.normal(size=(3, 5, size)).astype(np.float32), rng.normal(size=(3, 5, 1)).astype(np.float32)
    found = predict(ensemble, states, actions)
    assert found.shape == (3, 5, size + learned)
    for k, b in np.ndindex(3, 5):
        changes = slow_delta(ensemble, k, states[k, b], actions[k, b])
        newest = states[k, b, :2] + changes[:2]
        np.testing.assert_allclose(found[k, b, :2], newest, atol=1e-5)
        np.testing.assert_allclose(found[k, b, size:], changes[2:], atol=1e-5)
        (_, o1, o2), a1 = states[k, b, :6].reshape(3, 2), states[k, b, 6]
        np.testing.assert_array_equal(found[k, b, 2:size], [*states[k, b, :2], *o1, *actions[k, b], a1])
        assert not np.isin(o2, found[k, b]).any(), "the oldest is forgotten"


def test_a_state_may_be_as_long_as_an_observation_and_what_is_learned_besides():
    """Two observations of one number and an action are three, as are one observation, reward and end."""
    layout, rng = History(2, 1, 1), np.random.default_rng(0)
    networks, n = random_ensemble(1, 1, 3, 1, ()).networks, random_normaliser(rng, 3, 1)
    ensemble = ensembles.Ensemble(networks, n, ensembles.Carried(layout.carried))
    state, action = np.array([[[1.0, 2.0, 3.0]]], np.float32), np.array([[[0.5]]], np.float32)
    changes = slow_delta(ensemble, 0, state[0, 0], action[0, 0])
    expected = [1.0 + changes[0], 1.0, 0.5, changes[1], changes[2]]
    np.testing.assert_allclose(predict(ensemble, state, action)[0, 0], expected, atol=1e-5)


@pytest.mark.parametrize("relu", [False, True])
def test_a_linear_system_can_be_written_as_an_ensemble(relu):
    """Whatever the normaliser: the tests of imagination stand on this."""
    rng = np.random.default_rng(2)
    matrices = [(rng.normal(size=(4, 4)), rng.normal(size=(4, 2))) for _ in range(2)]
    ensemble = linear_ensemble(matrices, random_normaliser(rng, 4, 2), relu)
    states, actions = rng.normal(size=(2, 6, 4)).astype(np.float32), rng.normal(size=(2, 6, 2)).astype(np.float32)
    expected = [s @ a.T + u @ b.T for (a, b), s, u in zip(matrices, states, actions, strict=True)]
    np.testing.assert_allclose(predict(ensemble, states, actions), expected, atol=1e-4)


def test_a_member_alone_predicts_as_in_the_ensemble():
    rng = np.random.default_rng(3)
    ensemble = random_ensemble(4)
    states, actions = rng.normal(size=(3, 5, 4)).astype(np.float32), rng.normal(size=(3, 5, 2)).astype(np.float32)
    together = predict(ensemble, states, actions)
    for k in range(3):
        alone = predict(member(ensemble, k), states[k : k + 1], actions[k : k + 1])
        np.testing.assert_allclose(alone[0], together[k], atol=1e-6)


def test_fresh_members_are_xavier_uniform_and_differ():
    networks = jax.device_get(ensembles.init(jax.random.key(0), 4, 30, 10, (50,)))
    assert [(w.shape, b.shape) for w, b in networks] == [((4, 40, 50), (4, 1, 50)), ((4, 50, 30), (4, 1, 30))]
    for weights, biases in networks:
        bound = np.sqrt(6 / (weights.shape[1] + weights.shape[2]))
        assert not np.any(biases)
        assert 0.98 * bound < np.abs(weights).max() <= bound
        assert np.std(weights) == pytest.approx(bound / np.sqrt(3), rel=0.05)
        correlations = np.corrcoef(np.asarray(weights).reshape(4, -1))
        assert np.abs(correlations[~np.eye(4, dtype=bool)]).max() < 0.1


def test_a_member_does_not_depend_on_how_many_there_are():
    five = ensembles.init(jax.random.key(7), 5, 3, 2, (6,))
    two = ensembles.init(jax.random.key(7), 2, 3, 2, (6,))
    assert jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a[:2], b), five, two))


def test_normaliser_is_the_mean_and_std_of_the_rows():
    rng = np.random.default_rng(5)
    scales = np.array([0.5, 2.0, 30.0, 4.0])
    train = Transitions(
        (rng.normal(size=(500, 4)) * scales + 100).astype(np.float32),
        rng.uniform(-1, 1, size=(500, 2)).astype(np.float32),
        (rng.normal(size=(500, 4)) * scales - 3).astype(np.float32),
        500,
    )
    n = ensembles.normaliser_of(train, 0.1, 0.1)
    np.testing.assert_allclose(n.state_mean, train.states.mean(0, dtype=np.float64), rtol=1e-5)
    np.testing.assert_allclose(n.action_mean, train.actions.mean(0, dtype=np.float64), atol=1e-6)
    np.testing.assert_allclose(n.delta_mean, train.deltas.mean(0, dtype=np.float64), rtol=1e-5)
    np.testing.assert_allclose(n.state_scale, 1 / train.states.std(0, dtype=np.float64), rtol=1e-4)
    np.testing.assert_allclose(n.action_scale, 1 / train.actions.std(0, dtype=np.float64), rtol=1e-4)
    np.testing.assert_allclose(n.delta_std, train.deltas.std(0, dtype=np.float64), rtol=1e-4)


def test_normaliser_never_divides_by_less_than_the_floor():
    rng = np.random.default_rng(6)
    x = (rng.normal(size=(400, 3)) * [0.0, 0.01, 1.0]).astype(np.float32)
    n = ensembles.normaliser_of(Transitions(x, x[:, :2], x, 400), 0.25, 0.25)
    np.testing.assert_allclose(1 / n.state_scale[1:], [0.25, x[:, 2].std()], rtol=1e-4)
    assert n.state_scale[0] == 0, "what does not vary is not seen"
    np.testing.assert_allclose(1 / n.action_scale, 0.25, rtol=1e-6)
    np.testing.assert_allclose(n.delta_std, [0.25, 0.25, x[:, 2].std()], rtol=1e-4)


def test_unseen_dimensions_are_predicted_but_have_no_influence():
    rng = np.random.default_rng(8)
    train = random_transitions(rng, 50)
    normaliser = ensembles.normaliser_of(train, 0.1, 0.1, unseen=(0, 2))
    ensemble = random_ensemble(9)._replace(normaliser=normaliser)
    states, actions = rng.normal(size=(3, 5, 4)).astype(np.float32), rng.normal(size=(3, 5, 2)).astype(np.float32)
    moved = states + np.array([1000.0, 0.0, -50.0, 0.0], np.float32)
    deltas = np.asarray(predict_delta(ensemble, states, actions))
    np.testing.assert_array_equal(predict_delta(ensemble, moved, actions), deltas)
    assert np.all(np.ptp(deltas, axis=1) > 1e-3), "every dimension, unseen ones too, is predicted from the others"
    seen = states + np.array([0.0, 1.0, 0.0, 0.0], np.float32)
    assert not np.allclose(predict_delta(ensemble, seen, actions), deltas)
    # What normalises the prediction of an unseen dimension is its own spread.
    np.testing.assert_allclose(normaliser.delta_std, train.deltas.std(0), rtol=1e-4)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-5), ("bfloat16", 1e-2)])
def test_products_and_gradients_are_those_of_rounded_operands(dtype, tolerance):
    """The products of bfloat16 numbers are exact in float32, so only rounding may show: the operands', and that of the
    gradient, which has the weights' type."""
    rng = np.random.default_rng(0)
    x, weights = rng.normal(size=(3, 7, 5)).astype(np.float32), rng.normal(size=(3, 5, 4)).astype(np.float32)
    rounded = [np.asarray(jnp.asarray(a, dtype), np.float64) for a in (x, weights)]
    given = (jnp.asarray(x), jnp.asarray(weights, dtype))
    got, pull_back = jax.vjp(ensembles._product, *given)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, np.einsum("kbi,kio->kbo", *rounded), rtol=1e-5, atol=1e-5)
    slope = jnp.asarray(rng.normal(size=got.shape), dtype).astype(jnp.float32)
    to_x, to_weights = pull_back(slope)
    assert to_weights.dtype == dtype
    np.testing.assert_allclose(to_x, np.einsum("kbo,kio->kbi", slope, rounded[1]), rtol=1e-5, atol=1e-5)
    expected = np.einsum("kbi,kbo->kio", rounded[0], slope)
    np.testing.assert_allclose(np.asarray(to_weights, np.float32), expected, rtol=tolerance, atol=tolerance)


def test_bfloat16_products_change_predictions_only_a_little():
    ensemble = jax.tree.map(jnp.asarray, random_ensemble(hidden=(16, 16)))
    rng = np.random.default_rng(1)
    states, actions = (rng.normal(size=(3, 50, n)).astype(np.float32) for n in (4, 2))
    exact = np.asarray(predict_delta(ensemble, states, actions))
    same, coarse = (
        np.asarray(
            predict_delta(ensemble._replace(networks=ensembles.with_products(ensemble.networks, t)), states, actions)
        )
        for t in ("float32", "bfloat16")
    )
    np.testing.assert_array_equal(same, exact)
    difference = np.sqrt(np.mean((coarse - exact) ** 2) / np.mean(exact**2))
    assert 1e-4 < difference < 0.02
