"""Diagnostics against known answers: exact, useless and slightly wrong models of a linear system."""

import jax
import numpy as np
import pytest

from helpers import linear_ensemble, random_policy
from metrpo.model.diagnostics import HORIZONS, _starts, diagnose
from metrpo.types import Episode
from metrpo.world import dataset

A = np.array([[1.0, 0.1], [-0.1, 1.0]])
B = np.array([[0.1, 0.0], [0.0, 0.2]])
LENGTH = 40


def episode(rng, length=LENGTH):
    states, actions = [rng.normal(size=2)], rng.uniform(-1, 1, (length, 2))
    for action in actions:
        states.append(A @ states[-1] + B @ action)
    return Episode(np.array(states, np.float32), actions.astype(np.float32), np.zeros(length, np.float32), False)


def transitions(*episodes):
    return dataset.append(dataset.empty(2, 2).train, list(episodes), 10_000)


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    return transitions(*(episode(rng) for _ in range(3))), transitions(*(episode(rng) for _ in range(6)))


def of(matrices, data, horizon=LENGTH):
    held_out, train = data
    policy = random_policy(state_size=2, action_size=2)
    return diagnose(linear_ensemble(matrices), policy, held_out, train, horizon, jax.random.key(0))


def test_exact_models_make_no_error_and_equal_ones_agree(data):
    found = of([(A, B)] * 3, data)
    assert list(found.errors) == [*HORIZONS, LENGTH]
    assert all(error.max() < 1e-4 for error in found.errors.values())
    assert found.disagreement_real < 1e-6
    assert found.disagreement_imagined < 1e-6


def test_a_model_that_predicts_no_change_has_an_error_of_one(data):
    found = of([(np.eye(2), 0 * B)], data)
    for error in found.errors.values():
        np.testing.assert_allclose(error, 1, rtol=1e-5)


def test_errors_are_those_of_a_slow_rollout(data):
    """Two members, one of them wrong in the second dimension only."""
    wrong = A + np.array([[0.0, 0.0], [0.0, 0.01]])
    held_out, _ = data
    found = of([(A, B), (wrong, B)], data)
    rows, follow = _starts(held_out, held_out.states.shape[1], LENGTH)
    for k, error in found.errors.items():
        squares, still = [], []
        for row in rows[follow >= k]:
            for matrix in (A, wrong):
                state = real = held_out.states[row].astype(np.float64)
                for t in range(k):
                    state = matrix @ state + B @ held_out.actions[row + t]
                    real = A @ real + B @ held_out.actions[row + t]
                squares.append((state - real) ** 2)
                still.append((held_out.states[row] - real) ** 2)
        np.testing.assert_allclose(error, np.sqrt(np.mean(squares, 0) / np.mean(still, 0)), rtol=2e-3, atol=1e-5)
    assert found.errors[LENGTH][1] > 4 * found.errors[1][1] > 0


def test_predictions_never_run_over_the_end_of_an_episode(data):
    held_out, _ = data
    rows, follow = _starts(held_out, held_out.states.shape[1], LENGTH)
    assert len(rows) == 100
    np.testing.assert_array_equal(follow, LENGTH - rows % LENGTH)
    assert (rows % LENGTH == 0).sum() >= 50, "whole episodes are predicted, too"


def test_an_error_over_more_steps_than_any_episode_is_unknown(data):
    found = of([(A, B)], data, horizon=100)
    assert np.isnan(found.errors[100]).all()
    row = found.row()
    assert np.isnan(row["error_T"])
    assert row["error_25"] < 1e-4
    assert list(row)[:5] == ["error_1", "error_5", "error_10", "error_25", "error_T"]
    assert row["error_5_1"] == found.errors[5][1]


def test_imagined_states_beyond_the_data_are_counted(data):
    assert of([(0.5 * np.eye(2), 0 * B)], data).outside == 0
    away = of([(3 * np.eye(2), 0 * B)], data)
    assert away.outside > 0.9
    # Nor does an explosion become a sound number.
    assert np.isfinite(list(of([(1e9 * np.eye(2), 0 * B)], data).errors.values())).all()
    assert of([(np.nan * A, B)], data).outside == 1


def test_disagreement_grows_with_the_length_of_imagination(data):
    found = of([(A, B), (1.1 * A, B)], data)
    assert found.disagreement_imagined > found.disagreement_real > 0
