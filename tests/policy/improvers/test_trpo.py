"""TRPO against dense linear algebra, and its promises on any batch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

from helpers import on_host, random_policy, slow_mean
from metrpo.config import TRPOConfig
from metrpo.policy import gaussian
from metrpo.policy.improvers import linearised, trpo
from metrpo.policy.improvers.batch import Batch
from metrpo.policy.improvers.linearised import chunked, linearise

COUNT, STATE, ACTION = 24, 4, 2
CONFIG = TRPOConfig()
improve = on_host(static_argnames=("config", "penalty"))(trpo.improve)


def conjugate_gradient(matrix, target, iterations):
    """Solves with a matrix, from NumPy to NumPy."""
    solve = on_host()(lambda m, t: trpo.conjugate_gradient(lambda v: m @ v, t, iterations))
    return solve(np.float32(matrix), np.float32(target))


def a_batch(seed, policy, share=0.7):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(COUNT, STATE)).astype(np.float32)
    means = np.array([slow_mean(policy, s) for s in states])
    actions = (means + np.exp(policy.log_std) * rng.normal(size=means.shape)).astype(np.float32)
    mask = (rng.uniform(size=COUNT) < share).astype(np.float32)
    return Batch(states, actions, mask * rng.normal(size=COUNT).astype(np.float32), mask)


def slow_surrogate_and_kl(old, new, batch):
    """Both, in float64 NumPy, over the steps that count."""
    chosen = batch.mask > 0
    if not chosen.any():
        return 0.0, 0.0
    s0, s1 = (np.exp(np.asarray(p.log_std, np.float64)) for p in (old, new))
    gains, divergences = [], []
    for state, action, advantage in zip(*(x[chosen] for x in batch[:3]), strict=True):
        m0, m1 = slow_mean(old, state), slow_mean(new, state)
        log_ratio = np.sum(((action - m0) / s0) ** 2 / 2 - ((action - m1) / s1) ** 2 / 2 + np.log(s0) - np.log(s1))
        gains.append(np.exp(log_ratio) * advantage)
        divergences.append(np.sum(np.log(s1 / s0) + (s0**2 + (m0 - m1) ** 2) / (2 * s1**2) - 0.5))
    return np.mean(gains), np.mean(divergences)


def dense_fisher(policy, states, mask):
    """The Hessian of the mean KL at the policy itself, by JAX's second derivatives: independent of Gauss-Newton."""
    flat, unravel = ravel_pytree(policy)
    old_means = gaussian.mean(policy, jnp.asarray(states))

    def mean_kl(parameters):
        new = unravel(parameters)
        divergence = gaussian.kl(old_means, policy.log_std, gaussian.mean(new, jnp.asarray(states)), new.log_std)
        return jnp.sum(mask * divergence) / jnp.sum(mask)

    return np.asarray(jax.jit(jax.hessian(mean_kl))(flat), np.float64)


def surrogate_gradient(policy, batch):
    """The surrogate's gradient at the policy itself, by automatic differentiation."""
    flat, unravel = ravel_pytree(policy)

    def surrogate(parameters):
        p = unravel(parameters)
        means = gaussian.mean(p, jnp.asarray(batch.states))
        log_probability = gaussian.log_probability(means, p.log_std, batch.actions)
        weights = batch.mask * batch.advantages / batch.mask.sum()
        return jnp.sum(weights * jnp.exp(log_probability - jax.lax.stop_gradient(log_probability)))

    return np.asarray(jax.jit(jax.grad(surrogate))(flat), np.float64)


@pytest.mark.parametrize(("hidden", "damping"), [((), 0.0), ((5,), 0.1), ((5, 3), 1e-5)])
def test_fisher_product_is_the_hessian_of_the_mean_kl(hidden, damping):
    policy = random_policy(1, hidden=hidden)
    batch = a_batch(2, policy)
    assert 0 < batch.mask.sum() < COUNT
    flat, unravel = ravel_pytree(policy)
    at = linearise(policy.layers, chunked(jnp.asarray(batch.states)))
    product = trpo.fisher_product(policy, at, chunked(batch.mask), damping)
    eye = jnp.eye(flat.size)
    matrix = jax.jit(jax.vmap(lambda v: ravel_pytree(product(unravel(v)))[0]))(eye)
    expected = dense_fisher(policy, batch.states, batch.mask) + damping * np.eye(flat.size)
    np.testing.assert_allclose(matrix, expected, atol=2e-5 * np.abs(expected).max())


def a_system(seed, size, spread):
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(size, size)))
    return (q * np.geomspace(1, spread, size)) @ q.T, rng.normal(size=size)


@pytest.mark.parametrize(("size", "spread"), [(1, 1.0), (5, 10.0), (12, 100.0)])
def test_conjugate_gradient_solves(size, spread):
    matrix, target = a_system(size, size, spread)
    x, residual = conjugate_gradient(matrix, target, 2 * size)
    np.testing.assert_allclose(x, np.linalg.solve(matrix, target), atol=1e-3)
    np.testing.assert_allclose(residual, 0, atol=1e-3)


@pytest.mark.parametrize("iterations", [1, 3, 8])
def test_an_unfinished_cg_knows_its_residual_and_curvature(iterations):
    matrix, target = a_system(3, 20, 1000.0)
    x, residual = conjugate_gradient(matrix, target, iterations)
    x, residual = x.astype(float), residual.astype(float)
    np.testing.assert_allclose(residual, target - matrix @ x, atol=1e-3)
    assert np.linalg.norm(residual) > 0.01, "the case must be an unfinished one"
    assert x @ (target - residual) == pytest.approx(x @ matrix @ x, rel=1e-3)


def test_conjugate_gradient_one_step_is_steepest_descent():
    matrix, target = a_system(4, 6, 50.0)
    x, _ = conjugate_gradient(matrix, target, 1)
    np.testing.assert_allclose(x, target * (target @ target) / (target @ matrix @ target), rtol=1e-4)


def test_conjugate_gradient_stays_put_once_solved():
    x, residual = conjugate_gradient(2 * np.eye(3), np.ones(3), 50)
    np.testing.assert_array_equal(x, 0.5)
    np.testing.assert_array_equal(residual, 0)
    x, _ = conjugate_gradient(2 * np.eye(3), np.zeros(3), 50)
    np.testing.assert_array_equal(x, 0)


def slow_cg(matrix, target, iterations):
    """Conjugate gradients in float64, from 0."""
    x, residual = np.zeros_like(target), target
    direction = residual
    for _ in range(iterations):
        alpha = residual @ residual / (direction @ matrix @ direction)
        x, before = x + alpha * direction, residual
        residual = residual - alpha * matrix @ direction
        direction = residual + residual @ residual / (before @ before) * direction
    return x


@pytest.mark.parametrize(("iterations", "penalty"), [(60, 0.0), (60, 0.7), (2, 0.0)])
def test_the_step_is_the_natural_gradient_of_length_max_kl(iterations, penalty):
    """Against dense matrices: direction F^-1 g, length sqrt(2 max_kl / x'Fx), shortened by the line search alone.

    Also where the conjugate gradients are not done, and with a penalty, whose slope is that of finite differences.
    """
    policy = random_policy(11, hidden=(3,), scale=4.0 if penalty else 1.0)
    batch = a_batch(12, policy)
    config = TRPOConfig(max_kl=1e-3, cg_iterations=iterations, damping=0.05)
    new, info = improve(policy, batch, config, penalty=penalty)
    flat, unravel = ravel_pytree(policy)
    std = np.exp(policy.log_std)

    def cost(at):
        return penalty * slow_penalty(unravel(at.astype(np.float32)), batch, std)

    exact = np.asarray(flat, np.float64)
    slopes = [(cost(exact + d) - cost(exact - d)) / 2e-2 for d in 1e-2 * np.eye(exact.size)]
    gradient = surrogate_gradient(policy, batch) - np.array(slopes)
    assert (np.abs(slopes).max() > 0.1) == (penalty > 0), "the penalty must matter"
    fisher = dense_fisher(policy, batch.states, batch.mask) + 0.05 * np.eye(flat.size)
    x = np.linalg.solve(fisher, gradient) if iterations > 9 else slow_cg(fisher, gradient, iterations)
    full = x * np.sqrt(2 * config.max_kl / (x @ fisher @ x))
    step = np.asarray(ravel_pytree(new)[0], np.float64) - np.asarray(flat, np.float64)
    assert info.accepted
    assert (info.cg_residual < 1e-3) == (iterations > 9)
    np.testing.assert_allclose(step, full * 0.8 ** int(info.backtracks), atol=2e-3 * np.abs(full).max())


def slow_penalty(policy, batch, std):
    """The squared excess of mean actions beyond 0.9 over the std, summed over actions: its mean over the steps."""
    states = batch.states[batch.mask > 0]
    means = np.array([slow_mean(policy, s) for s in states])
    return np.mean(np.sum(np.maximum(np.abs(means) - 0.9, 0) ** 2 / std, axis=1))


@pytest.mark.parametrize("seed", range(5))
def test_the_penalty_is_taken_from_the_surrogate(seed):
    policy = random_policy(seed, hidden=(5,), scale=4.0)
    batch = a_batch(seed + 1, policy)
    new, info = improve(policy, batch, CONFIG, penalty=0.5)
    std = np.exp(policy.log_std)  # of the policy that acted, in both
    before, after = (
        slow_surrogate_and_kl(policy, p, batch)[0] - 0.5 * slow_penalty(p, batch, std) for p in (policy, new)
    )
    assert slow_penalty(policy, batch, std) > 0.1, "the case must be one that pays"
    assert info.accepted
    assert after - before == pytest.approx(float(info.improvement), rel=0.02, abs=2e-4)


def test_the_penalty_alone_leads_saturated_means_back():
    """Where no action is better than another, clipped means still come back to the limits, and stay there."""
    policy = gaussian.Policy(((np.zeros((1, 1), np.float32), np.float32([3.0])),), np.zeros(1, np.float32))
    states = np.zeros((64, 1), np.float32)

    def after(updates, penalty):
        now = policy
        for _ in range(updates):
            means = np.array([slow_mean(now, s) for s in states])
            batch = Batch(states, means.astype(np.float32), np.zeros(64, np.float32), np.ones(64, np.float32))
            now, _ = improve(now, batch, TRPOConfig(max_kl=0.05), penalty=penalty)
        return float(now.layers[0][1][0])

    assert after(5, 0.0) == 3.0, "no gradient, no step"
    assert 0.5 < after(40, 0.05) < 0.95, "steps of a fixed length end near the limit, not on it"


def test_a_gaussian_bandit_moves_as_the_closed_form_says():
    """No state, one action, std 1: F is 1 for the mean, g the mean of z A; the first try lands on KL = max_kl."""
    policy = gaussian.Policy(((np.zeros((1, 1), np.float32), np.zeros(1, np.float32)),), np.zeros(1, np.float32))
    actions = np.array([[-1.0], [1.0], [-1.0], [1.0]], np.float32)
    batch = Batch(np.zeros((4, 1), np.float32), actions, actions[:, 0], np.ones(4, np.float32))
    new, info = improve(policy, batch, TRPOConfig(max_kl=0.02, damping=0.0, max_backtracks=2))
    # z^2 - 1 = 0 for every action: the gradient of log_std vanishes, and the mean goes up by sqrt(2 max_kl).
    tries = int(info.backtracks)
    assert info.accepted
    assert tries <= 1, "float32 may put the full step a hair beyond max_kl"
    assert float(new.layers[0][1][0]) == pytest.approx(0.2 * 0.8**tries, rel=1e-4)
    assert float(new.log_std[0]) == pytest.approx(0, abs=1e-6)
    assert float(info.kl) == pytest.approx(0.02 * 0.64**tries, rel=1e-4)


@given(
    seed=st.integers(0, 2**31 - 1),
    scale=st.sampled_from([0.1, 1.0, 4.0]),
    std=st.sampled_from([0.02, 0.7, 5.0]),
    size=st.sampled_from([1e-3, 1.0, 1e3]),
    share=st.sampled_from([0.1, 0.7, 1.0]),
    config=st.sampled_from([CONFIG, TRPOConfig(max_kl=1e-4, cg_iterations=3), TRPOConfig(max_kl=0.5, damping=0.01)]),
)
@settings(max_examples=120, deadline=None)
def test_an_accepted_step_improves_within_the_trust_region(seed, scale, std, size, share, config):
    policy = random_policy(seed, hidden=(5,), scale=scale, std=std)
    batch = a_batch(seed + 1, policy, share)
    batch = batch._replace(advantages=(size * batch.advantages).astype(np.float32))
    new, info = improve(policy, batch, config)
    if not info.accepted:
        assert jax.tree.all(jax.tree.map(np.array_equal, new, policy))
        assert (info.kl, info.improvement) == (0, 0)
        return
    before, _ = slow_surrogate_and_kl(policy, policy, batch)
    after, divergence = slow_surrogate_and_kl(policy, new, batch)
    spread = float(np.abs(batch.advantages).max())
    assert divergence <= config.max_kl * 1.01 + 1e-6
    assert divergence == pytest.approx(float(info.kl), rel=0.02, abs=2e-5)
    assert after - before > -1e-4 * spread
    assert after - before == pytest.approx(float(info.improvement), rel=0.02, abs=2e-4 * spread)
    assert 0 <= info.backtracks < config.max_backtracks


def test_most_steps_on_plain_batches_are_accepted():
    """Else the property above would hold for an optimiser that never moves."""
    infos = []
    for seed in range(20):
        policy = random_policy(seed, hidden=(5,))
        infos.append(improve(policy, a_batch(seed, policy, 1.0), CONFIG)[1])
    assert sum(bool(i.accepted) for i in infos) >= 18
    assert np.mean([float(i.kl) for i in infos if i.accepted]) > 0.4 * CONFIG.max_kl


def test_the_line_search_gives_up_after_its_tries():
    """With so wide a trust region the quadratic model is far off, so that the full step fails and shorter ones pass."""
    policy = random_policy(0, hidden=(5,))
    batch = a_batch(1, policy)
    one_try = TRPOConfig(max_kl=50.0, max_backtracks=1)
    new, info = improve(policy, batch, one_try)
    assert not info.accepted
    assert info.backtracks == 0
    assert jax.tree.all(jax.tree.map(np.array_equal, new, policy))
    many, info = improve(policy, batch, TRPOConfig(max_kl=50.0, max_backtracks=60))
    assert info.accepted
    assert 0 < info.backtracks < 60
    assert not np.array_equal(many.log_std, policy.log_std)


def test_every_try_of_the_line_search_counts():
    """Where the first n tries fail, n + 1 are enough and n are not."""
    policy = random_policy(0, hidden=(5,))
    batch = a_batch(1, policy)
    failing = int(improve(policy, batch, TRPOConfig(max_kl=50.0, max_backtracks=60))[1].backtracks)
    for tries in (failing, failing + 1):
        info = improve(policy, batch, TRPOConfig(max_kl=50.0, max_backtracks=tries))[1]
        assert (info.accepted, info.backtracks) == (tries > failing, tries - 1)


def test_the_first_try_that_passes_is_taken():
    """Against a line search in NumPy along the same step."""
    found = set()
    for seed in range(8):
        policy, config = random_policy(seed, hidden=(5,)), TRPOConfig(max_kl=0.5)
        batch = a_batch(seed + 1, policy)
        new, info = improve(policy, batch, config)
        flat, unravel = ravel_pytree(policy)
        full = (ravel_pytree(new)[0] - flat) / 0.8**info.backtracks
        start, _ = slow_surrogate_and_kl(policy, policy, batch)
        tries = [
            slow_surrogate_and_kl(policy, unravel(flat + 0.8**i * full), batch) for i in range(info.backtracks + 1)
        ]
        passes = [gain > start and divergence <= config.max_kl for gain, divergence in tries]
        assert passes == [False] * int(info.backtracks) + [True]
        found.add(int(info.backtracks))
    assert found >= {0, 1, 2, 3}


def test_a_gain_that_overflows_is_none():
    """One action lies so far out that its ratio is infinite after any step, though the policy moves by max_kl only."""
    policy = gaussian.Policy(((np.zeros((1, 1), np.float32), np.zeros(1, np.float32)),), np.zeros(1, np.float32))
    actions = np.array([[1e6], [1.0], [-1.0], [0.5]], np.float32)
    advantages = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    batch = Batch(np.zeros((4, 1), np.float32), actions, advantages, np.ones(4, np.float32))
    new, info = improve(policy, batch, CONFIG)
    assert np.isfinite(info.cg_residual), "it must be the gain that is not finite"
    assert not info.accepted
    assert (info.kl, info.improvement) == (0, 0)
    assert jax.tree.all(jax.tree.map(np.array_equal, new, policy))


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_after_one_iteration_residual_and_step_are_those_of_steepest_descent(size):
    """x = a g: residual |g - a F g| / |g|, and a step as long as F says, whatever the unit of the advantages."""
    policy = random_policy(11, hidden=(3,))
    batch = a_batch(12, policy)
    batch = batch._replace(advantages=(size * batch.advantages).astype(np.float32))
    gradient = surrogate_gradient(policy, batch)
    image = (dense_fisher(policy, batch.states, batch.mask) + 0.05 * np.eye(gradient.size)) @ gradient
    left = gradient - image * (gradient @ gradient) / (gradient @ image)
    config = TRPOConfig(max_kl=1e-3, cg_iterations=1, damping=0.05)
    new, info = improve(policy, batch, config)
    assert info.accepted
    assert float(info.cg_residual) == pytest.approx(np.linalg.norm(left) / np.linalg.norm(gradient), rel=1e-3)
    full = gradient * np.sqrt(2 * config.max_kl / (gradient @ image))
    step = ravel_pytree(new)[0] - ravel_pytree(policy)[0]
    np.testing.assert_allclose(step, full * 0.8 ** int(info.backtracks), atol=2e-3 * np.abs(full).max())


def test_a_single_step_says_what_it_says_twice():
    """Means over the steps that count, be it one."""
    policy = random_policy(3, hidden=(5,))
    batch = a_batch(4, policy, 1.0)
    twice = Batch(*(x[[0, 0]] for x in batch))
    once = Batch(*(x[:2] for x in batch))._replace(mask=np.array([1, 0], np.float32))
    config = TRPOConfig(damping=0.1)
    assert improve(policy, once, config)[1].accepted
    for ours, theirs in zip(*(jax.tree.leaves(improve(policy, b, config)) for b in (once, twice)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_batch_in_chunks_says_what_it_says_whole(monkeypatch):
    """24 steps at once, and as two chunks of 10 and a padded one; few iterations, for they magnify rounding."""
    policy, config = random_policy(3, hidden=(5,)), TRPOConfig(damping=0.1, cg_iterations=1)
    batch = a_batch(4, policy)
    whole = improve(policy, batch, config)
    monkeypatch.setattr(linearised, "CHUNK", 10)
    in_chunks = on_host()(lambda policy, batch: trpo.improve(policy, batch, config))(policy, batch)
    assert in_chunks[1].accepted
    for ours, theirs in zip(jax.tree.leaves(in_chunks), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-5)


def test_a_gradient_of_the_size_of_rounding_is_not_followed_all_the_way():
    """The curvature along it has a floor: the step shrinks with the advantages instead of having length `max_kl`."""
    policy = random_policy(0, hidden=(5,))
    batch = a_batch(1, policy, 1.0)
    moved = []
    for size in (1.0, 1e-9):
        new, _ = improve(policy, batch._replace(advantages=np.float32(size) * batch.advantages), CONFIG)
        moved.append(np.linalg.norm(ravel_pytree(new)[0] - ravel_pytree(policy)[0]))
    assert moved[0] > 0.01
    assert moved[1] < 0.01 * moved[0]


@pytest.mark.parametrize("poison", ["advantages", "actions", "states"])
def test_nan_leaves_the_policy_as_it_is(poison):
    policy = random_policy(0, hidden=(5,))
    batch = a_batch(1, policy, 1.0)
    getattr(batch, poison)[3] = np.nan
    new, info = improve(policy, batch, CONFIG)
    assert not info.accepted
    assert jax.tree.all(jax.tree.map(np.array_equal, new, policy))
    assert (info.kl, info.improvement) == (0, 0)


@pytest.mark.parametrize("nothing", ["advantages", "mask"])
def test_a_batch_that_says_nothing_leaves_the_policy_as_it_is(nothing):
    policy = random_policy(0, hidden=(5,))
    batch = a_batch(1, policy)
    getattr(batch, nothing)[:] = 0
    new, info = improve(policy, batch, CONFIG)
    assert not info.accepted
    assert (info.kl, info.improvement, info.cg_residual) == (0, 0, 0)
    assert jax.tree.all(jax.tree.map(np.array_equal, new, policy))


def test_masked_steps_have_no_influence():
    policy = random_policy(3, hidden=(5,))
    batch = a_batch(4, policy)
    off = batch.mask == 0
    dirty = Batch(
        np.where(off[:, None], 1e5, batch.states).astype(np.float32),
        np.where(off[:, None], -3e3, batch.actions).astype(np.float32),
        np.where(off, 1e6, batch.advantages).astype(np.float32),
        batch.mask,
    )
    clean, info = improve(policy, batch, CONFIG)
    assert info.accepted
    for ours, theirs in zip(
        jax.tree.leaves(improve(policy, dirty, CONFIG)), jax.tree.leaves((clean, info)), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    # and the means are over the steps that count: leaving the others out gives the same
    # (well damped, for sums in another order lead elsewhere where F is nearly singular).
    kept, damped = Batch(*(x[~off] for x in batch)), TRPOConfig(damping=1.0)
    clean, _ = improve(policy, batch, damped)
    for ours, theirs in zip(jax.tree.leaves(improve(policy, kept, damped)[0]), jax.tree.leaves(clean), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("every", [2, 3])
def test_every_nth_step_makes_the_fisher_matrix_and_all_steps_the_rest(every):
    """Against a dense solve with the Fisher matrix of every n-th step and the gradient of all of them."""
    policy = random_policy(5, hidden=(3,))
    batch = a_batch(6, policy)
    config = TRPOConfig(max_kl=1e-3, cg_iterations=60, damping=0.05, fisher_every=every)
    new, info = improve(policy, batch, config)
    flat, _ = ravel_pytree(policy)
    gradient = surrogate_gradient(policy, batch)
    fisher = dense_fisher(policy, batch.states[::every], batch.mask[::every]) + 0.05 * np.eye(flat.size)
    x = np.linalg.solve(fisher, gradient)
    full = x * np.sqrt(2 * config.max_kl / (x @ fisher @ x))
    step = np.asarray(ravel_pytree(new)[0], np.float64) - np.asarray(flat, np.float64)
    assert info.accepted
    np.testing.assert_allclose(step, full * 0.8 ** int(info.backtracks), atol=2e-3 * np.abs(full).max())
    of_all, _ = improve(policy, batch, TRPOConfig(max_kl=1e-3, cg_iterations=60, damping=0.05))
    assert not np.allclose(ravel_pytree(of_all)[0] - flat, step, atol=1e-2 * np.abs(full).max())
