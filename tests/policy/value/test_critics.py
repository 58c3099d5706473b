"""Critics: what they say, in which units, and their moving average."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from helpers import on_host
from metrpo.policy.value import critics as networks
from metrpo.policy.value.critics import ValueScale, averaged, rescaled, reward_spread, scale_of, valued

KEY = jax.random.key(0)


def spoken(count=2, hidden=(8, 5)):
    """Critics with something to say, as host arrays."""
    fresh = networks.init(KEY, count, 5, hidden)
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: (np.asarray(x) + 0.5 * rng.normal(size=x.shape)).astype(np.float32), fresh)


def slow(critic, x):
    h = np.asarray(x, np.float64)
    for weights, biases in critic[:-1]:
        h = h @ weights + biases
        h = (h - h.mean()) / np.sqrt(h.var() + 1e-5)
        h = h / (1 + np.exp(-h))
    return (h @ critic[-1][0] + critic[-1][1])[0]


def test_outputs_are_those_of_a_slow_network():
    critics, rng = spoken(), np.random.default_rng(1)
    states, actions = rng.normal(size=(4, 6, 3)).astype(np.float32), rng.normal(size=(4, 6, 2)).astype(np.float32)
    said = on_host()(networks.outputs)(critics, states, actions)
    assert said.shape == (2, 4, 6)
    x = np.concatenate([states, actions], axis=-1)
    expected = [[[slow(critic, x[t, n]) for n in range(6)] for t in range(4)] for critic in critics]
    np.testing.assert_allclose(said, expected, rtol=1e-4, atol=1e-4)


def test_fresh_critics_say_the_middle_and_differ_in_what_they_will_learn():
    critics = networks.init(KEY, 2, 5, (8,))
    assert not np.asarray(networks.outputs(critics, np.ones((3, 3)), np.ones((3, 2)))).any()
    assert not np.array_equal(critics[0][0][0], critics[1][0][0])


@pytest.mark.parametrize(("middle", "width"), [(0.0, 2.0), (-300.0, 7.0)])
def test_other_units_change_nothing_of_what_critics_value(middle, width):
    critics, rng = spoken(), np.random.default_rng(2)
    states, actions = rng.normal(size=(6, 3)).astype(np.float32), rng.normal(size=(6, 2)).astype(np.float32)
    old, new = (ValueScale(*map(np.float32, x)) for x in ((5.0, 3.0, 0, 0), (middle, width, 0, 0)))
    before = valued(old, networks.outputs(critics, states, actions))
    after = valued(new, networks.outputs(rescaled(critics, old, new), states, actions))
    np.testing.assert_allclose(after, before, rtol=1e-4)


def test_the_scale_is_of_what_rewards_add_up_to():
    scale = scale_of(np.array([-1.0, 3.0, -1.0, 3.0]), 0.9, ends=False)
    np.testing.assert_allclose(scale, [10, 0.25 * 20, -50, 70])


def test_where_episodes_end_critics_begin_at_nothing():
    scale = scale_of(np.full(100, 2.0), 0.5, ends=True)
    np.testing.assert_allclose(scale, [0, 0.25 * 4, -4, 8])


def test_the_spread_of_rewards_is_read_off_their_scale():
    assert reward_spread(scale_of(np.array([-1.0, 3.0, -1.0, 3.0]), 0.9, ends=False), 0.9) == pytest.approx(2)
    assert reward_spread(scale_of(np.full(100, 2.0), 0.5, ends=True), 0.5) == pytest.approx(2)


@pytest.mark.parametrize("reward", [0.0, -3.0, 5.0])
def test_rewards_that_never_varied_have_a_scale(reward):
    scale = scale_of(np.full(10, reward), 0.9, ends=False)
    assert np.isfinite(scale).all()
    assert scale.width > 0
    assert scale.lowest < scale.middle < scale.highest


def test_the_moving_average_of_critics_that_stand_still():
    """After n steps the difference is (1 - rate)^n of the first one."""
    critics, targets = spoken(), jax.tree.map(np.zeros_like, spoken())
    for _ in range(10):
        targets = averaged(targets, critics, 0.1)
    for slow_one, fast in zip(jax.tree.leaves(targets), jax.tree.leaves(critics), strict=True):
        np.testing.assert_allclose(slow_one, fast * (1 - 0.9**10), rtol=1e-5)
