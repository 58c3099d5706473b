"""What the policy sees: folding the normalisation into the first layer and taking it out again."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from metrpo.policy import gaussian
from metrpo.policy.inputs import Inputs, folded, inputs_of, normalised, unfolded

S, A = 4, 2


def policy(seed=0):
    return jax.tree.map(np.asarray, gaussian.init(jax.random.key(seed), S, A, (8, 8), 1.0))


def states(seed, offset=0.0, scale=1.0, n=200):
    return offset + scale * np.random.default_rng(seed).standard_normal((n, S))


def test_normalised_states_have_mean_0_and_standard_deviation_1():
    rows = states(0) * [1e-3, 1.0, 50.0, 1e3] + [0.0, 5000.0, -3.0, 0.0]
    seen = normalised(inputs_of(rows), rows)
    np.testing.assert_allclose(seen.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(seen.std(0), 1, rtol=1e-4)


def test_dimensions_that_do_not_vary_are_only_shifted():
    rows = states(0)
    rows[:, 1] = 7.25
    rows[:, 2] = 0.0
    inputs = inputs_of(rows)
    np.testing.assert_array_equal(inputs.scale[[1, 2]], 1)
    np.testing.assert_array_equal(normalised(inputs, rows)[:, 1:3], 0)


def test_what_may_not_be_seen_changes_nothing():
    rows = states(0)
    inputs = inputs_of(rows, unseen=(3,))
    raw = folded(policy(), inputs)
    elsewhere = rows + np.array([0, 0, 0, 100.0])
    np.testing.assert_array_equal(gaussian.mean(raw, rows), gaussian.mean(raw, elsewhere))
    there = unfolded(policy(), inputs)
    np.testing.assert_array_equal(there.layers[0][0][3], 0)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 99), offset=st.floats(-100, 100), scale=st.floats(1e-3, 1e3))
def test_a_folded_policy_is_the_same_function_of_raw_states(seed, offset, scale):
    rows = states(seed, offset * scale, scale)
    inputs = inputs_of(rows)
    inside, raw = policy(seed), folded(policy(seed), inputs)
    exact = np.float64(rows)
    expected = gaussian.mean(inside, (exact - inputs.shift) * inputs.scale)
    np.testing.assert_allclose(gaussian.mean(raw, exact), expected, atol=1e-3)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 99), offset=st.floats(-100, 100), scale=st.floats(1e-3, 1e3))
def test_folding_undoes_unfolding(seed, offset, scale):
    rows = states(seed, offset * scale, scale)
    inputs = inputs_of(rows)
    again = unfolded(folded(policy(seed), inputs), inputs)
    for new, old in zip(jax.tree.leaves(again), jax.tree.leaves(policy(seed)), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-4, atol=1e-4)


def test_the_standard_deviation_stays():
    wide = policy()._replace(log_std=np.float32([0.5, -1]))
    inputs = Inputs(np.zeros(S, np.float32), np.ones(S, np.float32))
    for change in (folded, unfolded):
        np.testing.assert_array_equal(change(wide, inputs).log_std, wide.log_std)


@pytest.mark.parametrize("change", [folded, unfolded])
def test_an_identity_changes_nothing(change):
    inputs = Inputs(np.zeros(S, np.float32), np.ones(S, np.float32))
    for new, old in zip(jax.tree.leaves(change(policy(), inputs)), jax.tree.leaves(policy()), strict=True):
        np.testing.assert_array_equal(new, old)
