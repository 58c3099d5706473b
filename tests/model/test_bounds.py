"""Bounds of imagination: what lies within is left alone, what lies beyond is brought back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import probe
from helpers import linear_ensemble
from metrpo.model.bounds import bounded, bounds_of
from metrpo.model.imagine import Simulator, imagine, returns_per_model
from metrpo.types import Transitions


def data(learned=0):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 3, (50, 2)).astype(np.float32)
    states[:2] = [[-1, -1], [3, 3]]
    deltas = rng.uniform(-1, 1, (50, 2 + learned)).astype(np.float32)
    deltas[:2] = [[-1], [1]]
    return Transitions(states, np.zeros((50, 1), np.float32), deltas, 50)


def test_bounds_are_the_datas_range_and_a_margin():
    bounds = bounds_of(data(1), 0.25)
    np.testing.assert_allclose(bounds.lowest, [-2, -2])
    np.testing.assert_allclose(bounds.highest, [4, 4])
    np.testing.assert_allclose(bounds.least, [-1.5] * 3)
    np.testing.assert_allclose(bounds.most, [1.5] * 3)


def test_what_lies_within_is_left_alone_and_what_lies_beyond_comes_back():
    bounds = bounds_of(data(1), 0.25)
    states = np.array([[0, 0], [0, 0], [3.5, 0], [0, 0]], np.float32)
    predicted = np.array([[1, -1, 0.5], [9, -9, 9], [4.7, 0, -9], [np.nan, 0, 0]], np.float32)
    got = np.asarray(bounded(bounds, states, predicted))
    np.testing.assert_allclose(got[:3], [[1, -1, 0.5], [1.5, -1.5, 1.5], [4, 0, -1.5]])
    assert np.isnan(got[3, 0]), "what diverged must be seen to have"


def test_a_position_that_models_do_not_see_goes_on_without_bounds():
    bounds = bounds_of(data(), 0.25, unseen=(0,))
    got = np.asarray(bounded(bounds, np.full((1, 2), 90.0), np.full((1, 2), 99.0)))
    np.testing.assert_allclose(got, [[91.5, 4]])


def test_what_is_carried_over_goes_on_without_bounds():
    """Of three states the last is carried over, so that the data hold the changes of two, and a reward."""
    known = data(1)
    wider = known._replace(states=np.concatenate([known.states, known.states[:, :1]], axis=1))
    bounds = bounds_of(wider, 0.25, carried=(0,))
    np.testing.assert_array_equal(bounds.least, [-1.5, -1.5, -np.inf, -1.5])
    got = np.asarray(bounded(bounds, np.zeros((1, 3), np.float32), np.full((1, 4), 3.0, np.float32)))
    np.testing.assert_allclose(got, [[1.5, 1.5, 3.0, 1.5]])


def test_a_model_that_explodes_keeps_a_finite_return():
    ensemble = linear_ensemble([(30 * probe.A, probe.B)])
    starts = np.full((3, 2), 0.5, np.float32)
    free = Simulator(ensemble, probe.reward, None, 30)
    held = Simulator(ensemble, probe.reward, None, 30, bounds=bounds_of(data(), 0.25))
    assert np.isnan(returns_per_model(free, jnp.zeros_like, starts)).all()
    assert np.isfinite(returns_per_model(held, jnp.zeros_like, starts)).all()


def test_an_episode_stands_still_from_the_first_step_on_in_which_members_disagree_too_much():
    members = [(np.eye(2) * factor, np.zeros((2, 2))) for factor in (0.9, 1.1)]
    starts = np.array([[1, 1], [0.2, 0.2]], np.float32)  # members disagree by a tenth of the state
    simulator = Simulator(linear_ensemble(members), probe.reward, None, 3, trusted=jnp.float32(0.05))
    imagined, info = imagine(simulator, lambda states, key: jnp.zeros_like(states), starts, jax.random.key(0))
    np.testing.assert_array_equal(imagined.trusted, [[0, 1], [0, 1], [0, 1]])
    np.testing.assert_array_equal(imagined.going_on, [1, 1])
    np.testing.assert_array_equal(imagined.last[0], starts[0])
    assert not np.array_equal(imagined.last[1], starts[1])
    assert float(info.steps) == 3
    growing = [(np.eye(2) * factor, np.zeros((2, 2))) for factor in (1.9, 2.1)]
    wider = Simulator(linear_ensemble(growing), probe.reward, probe.beyond, 3, trusted=jnp.float32(0.06))
    imagined, _ = imagine(wider, lambda states, key: jnp.zeros_like(states), starts * 1.2, jax.random.key(0))
    np.testing.assert_array_equal(imagined.trusted[:, 1], [1, 1, 0])
    np.testing.assert_array_equal(imagined.going_on, [1, 0])
