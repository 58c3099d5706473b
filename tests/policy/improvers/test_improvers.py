"""The ways to improve a policy other than TRPO: gradients by hand, by finite differences and in closed form."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree

import probe
from helpers import linear_ensemble, on_host, random_ensemble, random_policy, slow_mean
from metrpo import policy_phase
from metrpo.config import Config, GradientConfig, PPOConfig
from metrpo.model.imagine import Simulator, imagine
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers import bptt, ppo, vpg
from metrpo.policy.improvers.adam import ascend, init_moments
from metrpo.policy.improvers.batch import Batch
from metrpo.policy.improvers.improver_table import IMPROVERS, init_memory
from metrpo.policy.improvers.settings import PhaseSettings
from metrpo.policy.value import linear
from metrpo.presets import override

KEY = jax.random.key(0)
# Without clipping, the first moment after one step is a tenth of the downhill gradient.
UNCLIPPED = GradientConfig(learning_rate=0.01, max_norm=np.inf)


def by_vpg(policy, batch, config):
    return vpg.improve(policy, init_moments(policy, config), batch, config)


def by_ppo(policy, batch, config, settings, key=KEY):
    return ppo.improve(policy, init_moments(policy, config), batch, settings, config, key)


by_vpg = on_host(static_argnames="config")(by_vpg)
by_ppo = on_host(static_argnames=("config", "settings"))(by_ppo)
climb = on_host(static_argnames="config")(ascend)


def flat(tree):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


def first_moment(moments):
    return optax.tree.get(moments, "mu")


def gradient_behind(moments):
    """The gradient of the first step, as a policy."""
    return jax.tree.map(lambda m: -10 * np.asarray(m), first_moment(moments))


def assert_close(ours, theirs, **tolerance):
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


def assert_same(ours, theirs):
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(x, y)


def by_hand():
    """A linear policy and three steps, with their policy gradient; std is 1/2."""
    layers = ((np.array([[1.0], [2.0]], np.float32), np.array([0.5], np.float32)),)
    policy = Policy(layers, np.log(np.array([0.5], np.float32)))
    states = np.array([[1, 0], [0, 1], [1, -1]], np.float32)
    # mu = 1.5, 2.5, -0.5: (a - mu) / std^2 = 2, -1, 4 and ((a - mu) / std)^2 - 1 = 0, -3/4, 3.
    actions = np.array([[2.0], [2.25], [0.5]], np.float32)
    batch = Batch(states, actions, np.array([1.0, -3.0, 0.5], np.float32), np.ones(3, np.float32))
    weights = [[(1 * 2 + 0.5 * 4) / 3], [(-3 * -1 + 0.5 * -4) / 3]]
    return policy, batch, Policy(((np.array(weights), np.array([7 / 3])),), np.array([(2.25 + 1.5) / 3]))


def with_masked(batch):
    """The batch and, among its steps, two that do not count."""

    def mixed(x, garbage):
        return np.insert(x, [1, 3], garbage, axis=0).astype(np.float32)

    return Batch(*(mixed(x, garbage) for x, garbage in zip(batch, (50.0, -70.0, 1e3, 0.0), strict=True)))


def slow_adam(policy, gradients, rate):
    """Parameters [n] after steps uphill, in float64 NumPy (Kingma and Ba 2015, algorithm 1)."""
    at, m, v = flat(policy).astype(np.float64), 0.0, 0.0
    for t, gradient in enumerate(gradients, 1):
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        at = at + rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
    return at


# ---------------------------------------------------------------- gradient ascent


def test_ascend_is_adam_uphill():
    policy, config = random_policy(0, 2, 1, ()), GradientConfig(learning_rate=0.02, max_norm=1e3)
    new, moments = policy, init_moments(policy, config)
    gradients = [random_policy(n, 2, 1, (), scale=3.0) for n in (1, 2, 3)]
    for gradient in gradients:
        new, moments, made = climb(new, moments, gradient, config)
        assert made
    expected = slow_adam(policy, [flat(g).astype(np.float64) for g in gradients], 0.02)
    np.testing.assert_allclose(flat(new), expected, atol=1e-6)


def test_only_a_long_gradient_is_shortened_to_its_bound():
    """The first step of Adam hardly knows the length; its moments and the second step do."""
    policy, config = random_policy(0, 2, 1, ()), GradientConfig(learning_rate=0.02, max_norm=2.0)
    one, other = (flat(random_policy(n, 2, 1, ())) for n in (1, 2))
    unravel = ravel_pytree(policy)[1]
    long, short = 50 * one / np.linalg.norm(one), 1.5 * other / np.linalg.norm(other)
    new, moments, _ = climb(policy, init_moments(policy, config), unravel(long), config)
    np.testing.assert_allclose(flat(gradient_behind(moments)), long * 2 / 50, rtol=1e-5)
    new, moments, _ = climb(new, moments, unravel(short), config)
    np.testing.assert_allclose(flat(new), slow_adam(policy, [long * 2 / 50, short], 0.02), atol=1e-6)
    assert not np.allclose(flat(new), slow_adam(policy, [long, short], 0.02), atol=1e-3)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_a_gradient_that_is_not_finite_moves_nothing(poison):
    policy, gradient, config = random_policy(0), random_policy(1), GradientConfig(learning_rate=0.1)
    policy, moments, made = climb(policy, init_moments(policy, config), gradient, config)
    assert made
    bad = gradient._replace(log_std=np.array([poison, 1.0], np.float32))
    new, after, made = climb(policy, moments, bad, config)
    assert not made
    assert_same((new, after), (policy, moments))
    better, _, made = climb(new, after, gradient, config)
    assert made
    assert np.all(flat(better) != flat(policy))


# ---------------------------------------------------------------- the score function: VPG and PPO


def test_the_policy_gradient_by_hand():
    policy, batch, expected = by_hand()
    new, moments, info = by_vpg(policy, batch, UNCLIPPED)
    assert_close(gradient_behind(moments), expected, rtol=1e-5)
    np.testing.assert_allclose(flat(new), flat(policy) + 0.01 * np.sign(flat(expected)), atol=1e-6)
    assert info.accepted
    assert info.improvement == 0
    assert info.kl == pytest.approx(slow_kl(policy, new, batch.states), rel=1e-3)


def slow_kl(old, new, states):
    s0, s1 = (np.exp(np.asarray(p.log_std, np.float64)) for p in (old, new))
    return np.mean(
        [
            np.sum(np.log(s1 / s0) + (s0**2 + (slow_mean(old, s) - slow_mean(new, s)) ** 2) / (2 * s1**2) - 0.5)
            for s in states
        ]
    )


def test_masked_steps_count_nothing():
    policy, batch, _ = by_hand()
    dirty, once = with_masked(batch), PPOConfig(epochs=1, minibatches=1)
    assert (len(dirty.mask), dirty.mask.sum()) == (5, 3)
    for improve in (by_vpg, lambda *given: by_ppo(*given, once)):
        new, moments, info = improve(policy, batch, UNCLIPPED)
        assert_close(improve(policy, dirty, UNCLIPPED), (new, moments, info), rtol=1e-4, atol=1e-7)
        nothing = batch._replace(mask=np.zeros(3, np.float32))
        still, _, info = improve(policy, nothing, UNCLIPPED)
        assert_same(still, policy)
        assert (info.kl, info.improvement) == (0, 0)


CASES = list(itertools.product([2.0, -3.0], [0.5, 0.79, 0.81, 1.0, 1.19, 1.21, 2.0]))


def test_the_clipped_surrogate_by_hand():
    """Nothing more is earned above 1.2 where the advantage is positive, nor below 0.8 where it is negative."""
    policy, batch, _ = by_hand()
    state, action = batch.states[:1], batch.actions[:1]

    def surrogate(policy, log_ratio, advantage):
        one = Batch(state, action, advantage[None], jnp.ones(1))
        old = vpg.objective(policy, one._replace(advantages=jnp.ones(1)), 1.0)
        return ppo.clipped_surrogate(policy, one, jax.lax.stop_gradient(old) - log_ratio[None], 0.2)

    advantages, ratios = np.array(CASES, np.float32).T
    both = on_host()(jax.vmap(jax.value_and_grad(surrogate), (None, 0, 0)))
    values, gradients = both(policy, np.log(ratios), advantages)
    for i, (advantage_, ratio) in enumerate(CASES):
        idle = ratio > 1.2 if advantage_ > 0 else ratio < 0.8
        expected = advantage_ * ((1.2 if advantage_ > 0 else 0.8) if idle else ratio)
        assert values[i] == pytest.approx(expected, rel=1e-5)
        slope = gradients.layers[0][1][i, 0]  # of the bias: ratio x A x (a - mu) / std^2
        assert slope == pytest.approx(0 if idle else ratio * advantage_ * 2, rel=1e-5)
        if idle:
            assert not np.any([np.any(x[i]) for x in jax.tree.leaves(gradients)])


def test_the_surrogate_is_a_sum_over_the_steps_that_count():
    policy, batch, _ = by_hand()
    ratios = np.array([0.5, 0.9, 3.0], np.float32)  # 0.5 x 1, 0.9 x -3, 1.2 x 0.5
    log_probability = -0.5 * np.array([1.0, 0.25, 4.0]) - np.log(0.5) - 0.5 * np.log(2 * np.pi)
    old = np.float32(log_probability - np.log(ratios))
    surrogate = on_host()(ppo.clipped_surrogate)
    assert surrogate(policy, batch, old, 0.2) == pytest.approx(0.5 - 2.7 + 0.6, rel=1e-4)
    batch = batch._replace(mask=np.array([1, 0, 1], np.float32))
    assert surrogate(policy, batch, old, 0.2) == pytest.approx(0.5 + 0.6, rel=1e-4)


def test_ppo_of_one_minibatch_and_one_epoch_is_one_step_of_adam():
    policy, batch, gradient = by_hand()
    new, moments, info = by_ppo(policy, batch, UNCLIPPED, PPOConfig(epochs=1, minibatches=1))
    assert_close(gradient_behind(moments), gradient, rtol=1e-4)
    np.testing.assert_allclose(flat(new), slow_adam(policy, [flat(gradient)], 0.01), atol=1e-6)
    assert info.accepted
    assert info.kl == pytest.approx(slow_kl(policy, new, batch.states), rel=1e-3)
    assert 0 < info.improvement < 0.1


def test_an_epoch_takes_every_step_once():
    """With a step size of almost 0, the moments tell which steps each of two minibatches had."""
    policy, _, _ = by_hand()
    rng = np.random.default_rng(0)
    batch = Batch(*(rng.normal(size=shape).astype(np.float32) for shape in ((4, 2), (4, 1), 4)), np.ones(4, np.float32))
    config = GradientConfig(learning_rate=1e-12, max_norm=np.inf)
    each = []
    for n in range(4):
        alone = batch._replace(mask=np.float32(np.arange(4) == n))
        each.append(flat(gradient_behind(by_ppo(policy, alone, config, PPOConfig(epochs=1, minibatches=1))[1])))
    seen = set()
    for key in range(6):
        _, moments, _ = by_ppo(policy, batch, config, PPOConfig(epochs=1, minibatches=2), jax.random.key(key))
        assert optax.tree.get(moments, "count") == 2
        got = -flat(first_moment(moments))
        for order in itertools.permutations(range(4)):
            first, second = ((each[order[i]] + each[order[i + 1]]) / 2 for i in (0, 2))
            if np.allclose(got, 0.09 * first + 0.1 * second, atol=1e-4):
                seen.add(frozenset(order[:2]))
                break
        else:
            pytest.fail("two minibatches that are no division of the batch")
    assert len(seen) > 1, "shuffled by the key"
    _, moments, _ = by_ppo(policy, batch, config, PPOConfig(epochs=3, minibatches=32))
    assert optax.tree.get(moments, "count") == 3 * 4, "minibatches are of one step at least"


def test_ppo_goes_no_further_than_its_clipping():
    """One step in one direction, many times: the ratio stays close to 1.2, without clipping it would run away."""
    policy, batch, _ = by_hand()
    batch = Batch(batch.states[:1], batch.actions[:1], np.ones(1, np.float32), np.ones(1, np.float32))
    many = PPOConfig(epochs=100, minibatches=1)
    new, _, info = by_ppo(policy, batch, GradientConfig(learning_rate=1e-3), many)
    assert info.improvement == pytest.approx(0.2, abs=1e-3)
    mu, std = slow_mean(new, batch.states[0])[0], np.exp(new.log_std[0])
    ratio = np.exp(-0.5 * ((2 - mu) / std) ** 2 + 0.5) * 0.5 / std
    assert 1.2 <= ratio < 1.4


# ---------------------------------------------------------------- backpropagation through the models


def through(act, ensemble, policy, starts, horizon, config=UNCLIPPED, reward=probe.reward):
    """`bptt.improve` on rollouts of `horizon` steps: (policy, moments, infos)."""

    def simulate(act, starts, key):
        return imagine(Simulator(ensemble, reward, None, horizon), act, starts, key)

    def improve(policy, starts):
        return bptt.improve(policy, init_moments(policy, config), act, simulate, starts, config, KEY)

    return on_host()(improve)(policy, starts)


# with 64 bits, model_choice puts int64 model numbers, all below K, into an int32 array
@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("act", [bptt.deterministic, bptt.stochastic])
def test_bptts_gradient_is_that_of_finite_differences(act, members):
    policy, ensemble = random_policy(2, 2, 2, (3,), scale=0.5, std=0.3), random_ensemble(1, members, 2, 2, scale=0.3)
    starts, horizon = np.random.default_rng(3).uniform(-0.7, 0.7, (4, 2)), 5
    with jax.enable_x64(True):
        policy, ensemble = jax.tree.map(lambda x: np.asarray(x, np.float64), (policy, ensemble))
        _, moments, (_, imagined) = through(act, ensemble, policy, starts, horizon)
        parameters, unravel = ravel_pytree(policy)

        def mean_return(parameters):
            simulator = Simulator(ensemble, probe.reward, None, horizon)
            rollouts, _ = imagine(simulator, act(unravel(parameters)), starts, KEY)
            return jnp.sum(rollouts.rewards) / len(starts)

        steps = 1e-6 * np.eye(parameters.size)
        returns = on_host()(jax.vmap(mean_return))(np.concatenate([parameters + steps, parameters - steps]))
    up, down = returns.reshape(2, -1)
    got = gradient_behind(moments)
    np.testing.assert_allclose(flat(got), (up - down) / 2e-6, rtol=1e-5, atol=1e-6)
    assert np.all(np.abs(flat(got.layers)) > 1e-6), "every parameter of the mean matters"
    assert np.all((got.log_std != 0) == (act is bptt.stochastic)), "the noise is felt only where there is some"
    assert imagined.mean_return == pytest.approx(returns.mean(), rel=1e-4)


def closed_form(gain, starts):
    """Mean return of a = gain s in the probe, without clipping, and its gradient in (gain', offset), in float64.

    The return to go from s_t is -s_t' P_t s_t, and an offset d of a_t changes it by -2 d' (gain + B' (I + P) M) s_t.
    """
    closed, p, costs = probe.A + probe.B @ gain, np.zeros((2, 2)), []
    for _ in range(probe.HORIZON):
        costs.append(gain + probe.B.T @ (np.eye(2) + p) @ closed)
        p = closed.T @ (np.eye(2) + p) @ closed + gain.T @ gain
    weights, biases, states = np.zeros((2, 2)), np.zeros(2), starts.astype(np.float64)
    for cost in reversed(costs):
        slopes = -2 * states @ cost.T
        weights, biases = weights + states.T @ slopes / len(starts), biases + slopes.mean(axis=0)
        states = states @ closed.T
    return -np.mean(np.sum(starts @ p * starts, axis=1)), Policy(((weights, biases),), np.zeros(2))


@pytest.mark.parametrize("members", [1, 2])
def test_the_gradient_through_a_linear_system_is_the_closed_form(members):
    gain = np.array([[-0.6, 0.1], [-0.2, -0.4]])
    policy = Policy(((gain.T.astype(np.float32), np.zeros(2, np.float32)),), np.zeros(2, np.float32))
    starts = probe.starts(6).astype(np.float32)
    ensemble = linear_ensemble([(probe.A, probe.B)] * members)
    new, moments, (info, imagined) = through(bptt.deterministic, ensemble, policy, starts, probe.HORIZON)
    value, gradient = closed_form(gain, starts)
    assert imagined.mean_return == pytest.approx(value, rel=1e-5)
    assert_close(gradient_behind(moments), gradient, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(flat(new), slow_adam(policy, [flat(gradient)], 0.01), atol=1e-5)
    assert info.accepted
    assert info.kl > 0


def test_exploding_rollouts_and_a_model_of_nan_move_nothing():
    """From 10,000 a tenfold growth passes the limit of 1e6; from 0.01 it does not; no action is clipped."""
    policy = Policy(((np.array([[1e-5]], np.float32), np.zeros(1, np.float32)),), np.zeros(1, np.float32))
    ensemble = linear_ensemble([(np.array([[10.0]]), np.array([[1.0]]))])
    calm, both = np.array([[0.01]], np.float32), np.array([[0.01], [1e4]], np.float32)
    _, alone, _ = through(bptt.deterministic, ensemble, policy, calm, 3)
    _, moments, (info, imagined) = through(bptt.deterministic, ensemble, policy, both, 3)
    assert (imagined.diverged, bool(info.accepted)) == (0.5, True)
    assert_close(gradient_behind(moments), jax.tree.map(lambda g: g / 2, gradient_behind(alone)), rtol=1e-5)
    broken = linear_ensemble([(np.array([[np.nan]]), np.array([[1.0]]))])
    new, moments, (info, imagined) = through(bptt.deterministic, broken, policy, calm, 3)
    assert (imagined.diverged, bool(info.accepted)) == (1, False)
    assert_same((new, moments), (policy, init_moments(policy, UNCLIPPED)))


# ---------------------------------------------------------------- the table


@pytest.mark.parametrize("name", list(IMPROVERS))
def test_every_improver_comes_close_to_the_optimum_of_the_probe(name):
    """60 updates in the true dynamics come within a fifth of the Riccati return, from 25 times that loss."""
    # 16 steps of PPO an update: at the others' rate rounding alone decides whether they overshoot.
    rate = 0.01 if name == "ppo" else 0.03
    settings = {"imagine.steps": 600, "trpo.max_kl": 0.03, "gradient.learning_rate": rate, "ppo.minibatches": 4}
    config = override(Config(task="Probe", improver=name), {**settings, "ppo.epochs": 4})
    ensemble = linear_ensemble([(probe.A, probe.B)])
    policy = jax.tree.map(jnp.asarray, random_policy(0, 2, 2, (), scale=0.3, std=0.5))
    pool, tests = np.split(np.random.default_rng(0).uniform(-0.7, 0.7, (60 * 30 + 50, 2)).astype(np.float32), [1800])
    settings, simulator = PhaseSettings.of(config, cut=False), Simulator(ensemble, probe.reward, None, probe.HORIZON)
    memory = init_memory(settings, policy, linear.init(2))
    new, after, (info, _) = policy_phase.run_updates(
        settings, simulator, policy, memory, pool.reshape(60, 30, 2), jax.random.key(1)
    )
    optimum = -np.mean(np.sum(tests @ probe.riccati()[0] * tests, axis=1))
    before, reached = (policy_phase.values_of(simulator, p, tests)[0] for p in (policy, new))
    assert before < 20 * optimum
    assert 1.2 * optimum < reached < 0.999 * optimum
    assert np.all(info.accepted)
    # Only the improvers that need a baseline fit one, and only Adam has moments that go on from update to update.
    assert np.any(after.baseline) == (not name.startswith("bptt"))
    if name != "trpo":
        steps = {"ppo": 60 * 4 * 4}.get(name, 60)
        assert optax.tree.get(after.moments, "count") == steps
