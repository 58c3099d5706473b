"""One update of the actor-critic against slow versions, finite differences and closed forms on a linear system."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probe
from helpers import linear_ensemble, on_host
from metrpo.config import Config
from metrpo.model.imagine import ImagineInfo, Simulator
from metrpo.policy import squashed
from metrpo.policy.improvers import actor_critic
from metrpo.policy.improvers.actor_critic import (
    Steps,
    UpdateSettings,
    actor_gradient,
    expanded,
    of_real,
    soft_returns,
    update,
)
from metrpo.policy.squashed import Actor
from metrpo.policy.value import critics as networks
from metrpo.policy.value.critics import ValueScale, valued
from metrpo.policy_phase import simulate
from metrpo.presets import override
from metrpo.types import Trajectories

KEY = jax.random.key(0)
CONFIG = override(
    Config(task="Probe", improver="actor-critic"),
    {
        "advantage.discount": 0.9,
        "actor_critic.critic_hidden": (6,),
        "actor_critic.horizon": 4,
        "actor_critic.critic_steps": 3,
        "gradient.max_norm": 1e6,
    },
)
SETTINGS = UpdateSettings.of(CONFIG)
WIDE = ValueScale(*map(np.float32, (1.0, 8.0, -1e6, 1e6)))


def learner(settings=SETTINGS, seed=0):
    """One whose critics have something to say."""
    fresh = actor_critic.init(settings, jax.random.key(seed), 2, 2, (5,))
    rng = np.random.default_rng(seed)

    def moved(x):
        return jnp.asarray(x + 0.3 * rng.normal(size=x.shape), jnp.float32)

    critics, targets = (jax.tree.map(moved, fresh.critics) for _ in range(2))
    return fresh._replace(critics=critics, targets=targets, scale=WIDE)


def simulator(members=1, ends=None, horizon=4):
    ensemble = linear_ensemble([(probe.A + 0.05 * k, probe.B) for k in range(members)])
    return Simulator(ensemble, probe.reward, ends, horizon)


def starts(count=6):
    return np.random.default_rng(5).uniform(-0.7, 0.7, (count, 2)).astype(np.float32)


def real_steps(count=5, ends=0.0):
    """Steps of the linear system itself."""
    rng = np.random.default_rng(7)
    states, actions = (rng.uniform(-0.7, 0.7, (count, 2)).astype(np.float32) for _ in range(2))
    following = (states @ probe.A.T + actions @ probe.B.T).astype(np.float32)
    rewards = probe.reward(states, actions, following).astype(np.float32)
    return Steps(states, actions, rewards, following, np.full(count, 1.0 - ends, np.float32))


# ---------------------------------------------------------------- value expansion


def rollouts_of(seed=0, steps=4, count=7):
    """Episodes that go on, stand still after two steps, end at some step (the last one included), or have diverged."""
    rng = np.random.default_rng(seed)
    lives = np.array([9, 9, 1, 2, 3, 4, 0])[:count]  # steps that count; 9: goes on
    mask = (np.arange(steps)[:, None] < lives).astype(np.float32)
    moves = (np.arange(steps)[:, None] < np.array([9, 2, 9, 9, 9, 9, 9])[:count]).astype(np.float32)

    def draw(*shape):
        return rng.normal(size=shape).astype(np.float32)

    shape = steps, count
    return Trajectories(
        draw(*shape, 2), draw(*shape, 2), draw(*shape), mask, draw(count, 2), (lives == 9) * 1.0, draw(*shape), moves
    )


def slow_return(r, start, n, weight, discount, after):
    """The soft return of episode n from `start` on, one step after the other."""
    total, factor = 0.0, 1.0
    steps = len(r.rewards)
    if r.mask[start, n] == 0:
        return 0.0
    for t in range(start, steps):
        total += factor * r.rewards[t, n]
        goes_on = r.mask[t + 1, n] if t + 1 < steps else r.going_on[n]
        if not goes_on:
            return total
        factor *= discount
        if t + 1 < steps and not r.trusted[t + 1, n]:
            break
        if t + 1 < steps:
            total -= factor * weight * r.noted[t + 1, n]
    return total + factor * after[n]


def test_soft_returns_are_those_of_a_slow_version():
    r, after = rollouts_of(), np.arange(7, dtype=np.float32) + 3
    got, first = on_host()(lambda r, after: soft_returns(r, 0.3, 0.9, after))(r, after)
    expected = np.array([[slow_return(r, t, n, 0.3, 0.9, after) for n in range(7)] for t in range(4)])
    counts = r.trusted > 0
    np.testing.assert_allclose(got[counts], expected[counts], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(first, expected[0] - 0.3 * r.noted[0], rtol=1e-5, atol=1e-6)


def test_an_episode_that_never_moves_is_worth_the_state_that_it_stands_in():
    r, after = rollouts_of()._replace(trusted=np.zeros((4, 7), np.float32)), np.arange(7, dtype=np.float32)
    np.testing.assert_array_equal(soft_returns(r, 0.3, 0.9, after)[1], after)


def test_targets_are_valued_by_the_least_of_the_target_critics():
    r, one = rollouts_of(1), learner()
    last = (r.last, np.zeros_like(r.last), np.full(7, 0.4, np.float32))
    lessons = expanded(SETTINGS, one, r, last)
    for got, given in zip(
        (lessons.states, lessons.actions, lessons.mask), (r.states, r.actions, r.mask * r.trusted), strict=True
    ):
        np.testing.assert_array_equal(got, given[:3].reshape(21, *given.shape[2:]))
    got, counts = np.asarray(lessons.targets).reshape(3, 7), r.trusted[:3] > 0
    said = np.asarray(valued(WIDE, networks.outputs(one.targets, *last[:2]))).min(axis=0)
    weight = math.exp(float(one.log_entropy_weight))
    expected = [[slow_return(r, t, n, weight, 0.9, said - weight * 0.4) for n in range(7)] for t in range(3)]
    np.testing.assert_allclose(got[counts], np.array(expected)[counts], rtol=1e-4, atol=1e-5)


def test_what_no_return_can_be_is_no_target():
    r, one = rollouts_of(2), learner()
    low = one._replace(scale=WIDE._replace(highest=np.float32(-50.0)))
    last = (r.last, np.zeros_like(r.last), np.zeros(7, np.float32))
    free, bound = (np.asarray(expanded(SETTINGS, x, r, last).targets) for x in (one, low))
    assert free.max() > -50
    assert bound.max() == -50


@pytest.mark.parametrize("ends", [0.0, 1.0])
def test_of_real_steps_the_reward_is_known_and_the_least_of_the_target_critics_follows(ends):
    one, real = learner(), real_steps(ends=ends)
    lessons = of_real(SETTINGS, one, real, KEY)
    actions, log_probs = squashed.sample(one.actor, real.following, KEY)
    said = np.asarray(valued(WIDE, networks.outputs(one.targets, real.following, actions))).min(axis=0)
    after = said - math.exp(float(one.log_entropy_weight)) * np.asarray(log_probs)
    np.testing.assert_allclose(lessons.targets, real.rewards + 0.9 * (1 - ends) * after, rtol=1e-5)
    np.testing.assert_array_equal(lessons.states, real.states)
    np.testing.assert_array_equal(lessons.actions, real.actions)
    np.testing.assert_array_equal(lessons.mask, np.ones(5))


# ---------------------------------------------------------------- the actor's gradient


@pytest.mark.parametrize(("terminal", "ends"), [("mean", None), ("min", None), ("mean", probe.beyond)])
def test_the_actors_gradient_is_that_of_finite_differences(terminal, ends):
    settings = UpdateSettings.of(override(CONFIG, {"actor_critic.terminal": terminal}))
    with jax.enable_x64(True):
        one = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), learner(settings))
        sim = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), simulator(2, ends))
        begin = jnp.asarray(starts(), jnp.float64)

        def objective(actor):
            """The mean soft return, put together again from the episodes alone."""
            _, (r, (states, actions, log_probs), _) = actor_gradient(
                settings, partial(simulate, sim), one._replace(actor=actor), begin, KEY
            )
            weight = jnp.exp(one.log_entropy_weight)
            said = valued(one.scale, networks.outputs(one.critics, states, actions))
            after = (said.mean(0) if terminal == "mean" else said.min(0)) - weight * log_probs
            powers = 0.9 ** jnp.arange(4.0)[:, None]
            steps = (powers * r.mask * (r.rewards - weight * r.noted)).sum(0)
            return jnp.mean(steps + 0.9**4 * r.going_on * after) / one.scale.width

        gradient, (r, *_) = jax.jit(
            lambda actor: actor_gradient(settings, partial(simulate, sim), one._replace(actor=actor), begin, KEY)
        )(one.actor)
        assert ends is None or 0 < r.mask.mean() < 1, "some episodes must end"
        rng = np.random.default_rng(0)
        way = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), one.actor)
        along = sum(float(jnp.sum(g * w)) for g, w in zip(*map(jax.tree.leaves, (gradient, way)), strict=True))
        value = jax.jit(objective)

        def moved(step):
            return float(value(jax.tree.map(lambda x, w: x + step * w, one.actor, way)))

        up, down = moved(1e-6), moved(-1e-6)
    assert along == pytest.approx((up - down) / 2e-6, rel=1e-4)
    assert abs(along) > 1e-3


# ---------------------------------------------------------------- closed forms on the linear system


def steady(gain=0.5):
    """An actor whose noise is tiny: a = tanh(-gain s), the networks being linear."""
    weights = np.concatenate([-gain * np.eye(2), np.zeros((2, 2))], axis=1).astype(np.float32)
    return Actor(((weights, np.array([0, 0, -9, -9], np.float32)),))


def test_expansion_is_the_known_return_of_a_linear_system():
    one = learner()._replace(actor=steady(), log_entropy_weight=jnp.float32(-30))
    none = jax.tree.map(jnp.zeros_like, one.critics)
    one = one._replace(critics=none, targets=none, scale=WIDE._replace(middle=np.float32(0)))
    _, (r, last, _) = jax.jit(partial(actor_gradient, SETTINGS, partial(simulate, simulator())))(one, starts(), KEY)
    got = np.asarray(expanded(SETTINGS, one, r, last).targets)[: len(starts())]
    states, total = starts().astype(np.float64), 0.0
    for t in range(4):
        actions = np.tanh(-0.5 * states)
        after = states @ probe.A.T + actions @ probe.B.T
        total, states = total + 0.9**t * probe.reward(states, actions, after), after
    np.testing.assert_allclose(got, total, atol=0.05)  # the noise has std e^-5
    assert np.abs(total).min() > 0.1


@pytest.fixture(scope="module")
def compiled():
    return jax.jit(partial(update, SETTINGS, partial(simulate, simulator(2))))


def test_an_update_averages_the_targets_and_weighs_the_entropy(compiled):
    """Adam's first steps are of its step size: down where the entropy is above its target (std 1: it is), else up."""
    one = learner()
    new, info, imagined = compiled(one, starts(), real_steps(), KEY)
    assert info.accepted
    assert float(imagined.diverged) == 0
    moved = jax.tree.map(lambda old, to: old + 0.02 * (to - old), one.targets, new.critics)
    for got, expected in zip(jax.tree.leaves(new.targets), jax.tree.leaves(moved), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    assert float(info.entropy) > -2
    assert float(new.log_entropy_weight - one.log_entropy_weight) == pytest.approx(-3e-4, rel=1e-2)
    (first, (weights, biases)) = one.actor.layers
    calm = Actor((first, (weights, biases.at[2:].set(-9.0))))
    still, info, _ = compiled(one._replace(actor=calm), starts(), real_steps(), KEY)
    assert float(info.entropy) < -2
    assert float(still.log_entropy_weight - one.log_entropy_weight) == pytest.approx(3e-4, rel=1e-2)


def test_updates_learn_the_value_and_improve_the_policy(compiled):
    """Of a linear system: the critic's loss falls, and the actor comes to steer against the state."""
    one = learner()
    losses = []
    for i in range(600):
        one, info, _ = compiled(one, starts(), real_steps(), jax.random.fold_in(KEY, i))
        losses.append(float(info.critic_loss))
    assert np.mean(losses[-50:]) < 0.3 * np.mean(losses[:5])
    means = np.tanh(squashed.moments(one.actor, starts(32))[0])
    assert np.mean(np.sum(means * starts(32), axis=1)) < -0.02


def test_without_imagined_steps_it_is_soft_actor_critic():
    """The critics learn from real steps alone, the actor from what critics say of its actions in the starts."""
    settings = UpdateSettings.of(override(CONFIG, {"actor_critic.horizon": 0}))
    one, sim = learner(settings), partial(simulate, simulator(2, horizon=0))
    gradient, (_, (states, *_), _) = jax.jit(partial(actor_gradient, settings, sim))(one, starts(), KEY)
    np.testing.assert_array_equal(states, starts())

    def objective(actor):
        drawn, log_probs = squashed.sample(actor, jnp.asarray(starts()), jax.random.fold_in(KEY, actor_critic._LAST))
        said = valued(WIDE, networks.outputs(one.critics, starts(), drawn)).min(axis=0)
        return jnp.mean(said - jnp.exp(one.log_entropy_weight) * log_probs) / WIDE.width

    for got, expected in zip(*map(jax.tree.leaves, (gradient, jax.grad(objective)(one.actor))), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-6)
    new, info, _ = jax.jit(partial(update, settings, sim))(one, starts(), real_steps(), KEY)
    said = np.asarray(networks.outputs(one.critics, *real_steps()[:2]))
    lessons = of_real(settings, one, real_steps(), jax.random.fold_in(KEY, actor_critic._REAL))
    aims = (np.asarray(lessons.targets) - WIDE.middle) / WIDE.width
    assert info.accepted
    assert float(info.critic_loss) == pytest.approx(float(np.mean(np.square(said - aims))), rel=1e-4)
    assert not np.array_equal(new.actor.layers[0][0], one.actor.layers[0][0])


# ---------------------------------------------------------------- what is not finite


@pytest.fixture(scope="module")
def poisoned():
    def spoilt(poison, act, begin, key):
        rollouts, info = simulate(simulator(2), act, begin, key)
        return rollouts._replace(rewards=rollouts.rewards.at[1, 2].multiply(poison)), info

    compiled = jax.jit(lambda poison, *given: update(SETTINGS, partial(spoilt, poison), *given))
    return lambda one, poison: compiled(poison, one, starts(), real_steps(), KEY)


def test_an_update_with_a_finite_factor_is_accepted(poisoned):
    assert poisoned(learner(), 1.0)[1].accepted


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_update_that_is_not_finite_changes_nothing(value, poisoned):
    one = learner()
    new, info, _ = poisoned(one, value)
    assert not info.accepted
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(info))
    for got, before in zip(jax.tree.leaves(new), jax.tree.leaves(one), strict=True):
        np.testing.assert_array_equal(got, before)


def test_without_a_step_that_counts_nothing_moves():
    def nothing(act, begin, key):
        rollouts, info = simulate(simulator(2), act, begin, key)
        none = jnp.zeros_like(rollouts.mask)
        return rollouts._replace(mask=none, going_on=none[0]), ImagineInfo(info.mean_return, info.diverged, 0.0)

    one = learner()
    new, info, _ = jax.jit(partial(update, SETTINGS, nothing))(one, starts(), real_steps(), KEY)
    assert not info.accepted
    for got, before in zip(jax.tree.leaves(new), jax.tree.leaves(one), strict=True):
        np.testing.assert_array_equal(got, before)
