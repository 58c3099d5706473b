"""The value network: closed forms that it must learn, its units, its minibatches, and devices that share the work."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import probe
from helpers import linear_ensemble, on_host, random_policy
from metrpo import devices, policy_phase, training
from metrpo.config import AdvantageConfig, Config
from metrpo.policy import advantage
from metrpo.policy.improvers.improver_table import batch_of, init_memory
from metrpo.policy.improvers.settings import PhaseSettings
from metrpo.policy.value import linear, network
from metrpo.policy.value.value_table import VALUE_FUNCTIONS, init_baseline
from metrpo.presets import override
from metrpo.run.checkpoint import load_state, save_state
from metrpo.types import Trajectories

KEY = jax.random.key(0)
N, T, E, S = 500, 5, 100, 2
"""Rows, and batches of T steps of E episodes, always of the same shape: compiling takes longer than all else here."""
QUICK = AdvantageConfig("network", 0.9, 0.95, value_hidden=(24,), value_batch_size=100, value_learning_rate=1e-2)
predict, fit = on_host()(network.predict), on_host(static_argnames="config")(network.fit)
advantages_and_value = on_host(static_argnames=("config", "cut"))(network.advantages_and_value)
gae = on_host()(advantage.gae)
ONES = np.ones(N, np.float32)


def fresh(size=S, config=QUICK):
    return jax.device_get(network.init(KEY, size, config))


def explained(predicted, truth):
    """1 - the share of the truth's variance that is missed."""
    return 1 - np.mean(np.square(predicted - truth)) / np.var(truth)


def fitted(x, targets, mask=ONES, times=10, start=None):
    """The network after `times` fits to the same batch."""
    now = start or fresh(x.shape[-1] - 1)
    for i in range(times):
        now = fit(now, x, targets.astype(np.float32), mask, QUICK, jax.random.fold_in(KEY, i))
    return now


def rows(seed):
    return np.random.default_rng(seed).normal(size=(N, S + 1)).astype(np.float32)


def a_batch(seed):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(T + 1, E, S)).astype(np.float32)
    ones = np.ones((T, E), np.float32)
    rewards = rng.normal(size=(T, E)).astype(np.float32)
    return Trajectories(states[:-1], np.zeros((T, E, 1), np.float32), rewards, ones, states[-1], ones[0])


def timed(states, timeless=False):
    """The network's inputs, [T, N, S] -> [T, N, S + 1]."""
    time = np.zeros(len(states)) if timeless else np.arange(len(states)) / 100
    return np.concatenate([states, np.broadcast_to(time[:, None, None], (*states.shape[:2], 1))], -1).astype(np.float32)


def assert_same(ours, theirs):
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(x, y)


# ---------------------------------------------------------------- the network


@pytest.mark.parametrize("hidden", [(), (8,), (64, 32)])
def test_the_first_network_predicts_zero(hidden):
    now = fresh(config=dataclasses.replace(QUICK, value_hidden=hidden))
    assert [w.shape for w, _ in now.layers] == list(zip((3, *hidden), (*hidden, 1), strict=True))
    assert not np.any(predict(now, 100 * rows(0)))


def test_prediction_is_the_network_in_its_units():
    now = fitted(rows(1), 7 * np.sin(rows(1)[:, 0]) + 30)
    x = 20 * rows(2)
    for one, got in zip(x[:50], predict(now, x)[:50], strict=True):
        hidden = np.clip((one.astype(float) - now.input_mean) * now.input_scale, -10, 10)
        for weights, biases in now.layers[:-1]:
            hidden = np.tanh(hidden @ weights + biases)
        weights, biases = now.layers[-1]
        assert got == pytest.approx((hidden @ weights + biases)[0] * now.target_std + now.target_mean, abs=1e-3)


@pytest.mark.parametrize("timeless", [False, True])
def test_inputs_are_the_states_and_the_time(timeless):
    states = rows(3).reshape(20, -1, 3)
    got = network.inputs(states, timeless)
    np.testing.assert_allclose(got, timed(states, timeless), atol=1e-6)


@pytest.mark.parametrize(("shift", "scale"), [(0, 1), (5000, 800), (-3, 1e-3)])
def test_a_curved_function_is_learned_whatever_its_units(shift, scale):
    z = rows(4).astype(float)
    truth = shift + scale * (np.sin(2 * z[:, 0]) + z[:, 1] * z[:, 2])
    x = (z * [1.0, 50.0, 1e-3] + [0.0, 300.0, 0.0]).astype(np.float32)
    assert explained(predict(fitted(x, truth, times=20), x), truth) > 0.95
    # The linear baseline's features hold neither.
    feature = np.concatenate([z, z**2, np.ones((N, 1))], 1)
    assert explained(feature @ np.linalg.lstsq(feature, truth, rcond=None)[0], truth) < 0.3


def test_predictions_move_and_stretch_with_the_targets_at_once():
    """Returns that a better policy shifts and stretches are predicted as before: not Adam, the units follow them."""
    x = rows(5)
    now = fitted(x, np.sin(x[:, 0]) + x[:, 1])
    before = predict(now, x)
    grown = fitted(x, 5000 + 700 * (np.sin(x[:, 0]) + x[:, 1]), times=1, start=now)
    np.testing.assert_allclose(predict(grown, x), 5000 + 700 * before, atol=0.3 * 700)
    assert explained(predict(grown, x), 5000 + 700 * before) > 0.99


@given(st.integers(0, 2**31 - 1), st.floats(0.01, 1.0))
@settings(max_examples=15, deadline=None)
def test_steps_that_do_not_count_teach_nothing(seed, share):
    rng = np.random.default_rng(seed)
    mask = (rng.uniform(size=N) < share).astype(np.float32)
    mask[rng.integers(N)] = 1
    x, targets = rows(seed), rng.normal(size=N).astype(np.float32)
    off = mask == 0
    dirty = np.where(off[:, None], 1e30, x).astype(np.float32), np.where(off, np.inf, targets).astype(np.float32)
    clean = fitted(x, targets, mask, times=1)
    assert_same(fitted(*dirty, mask, times=1), clean)
    assert np.any(clean.layers[0][0] != fresh().layers[0][0])
    np.testing.assert_allclose(clean.target_mean, targets[~off].mean(), atol=1e-5)
    np.testing.assert_allclose(clean.target_std, max(targets[~off].std(), 1e-4 * abs(clean.target_mean)), atol=1e-5)
    np.testing.assert_allclose(clean.input_mean, x[~off].mean(0), atol=1e-5)


def test_every_step_that_counts_is_drawn_equally_often():
    """Equal inputs, targets 0 and 1: the network can only learn the mean of what is drawn."""
    x, targets = np.zeros((N, S + 1), np.float32), (np.arange(N) % 4 == 0).astype(np.float32)
    mask = (np.arange(N) < 21).astype(np.float32)  # 6 of these 21 are 1
    got = [predict(fitted(x, targets, mask, times=n), x)[0] for n in range(20, 40)]
    np.testing.assert_allclose(np.mean(got), 6 / 21, atol=0.02)


@pytest.mark.parametrize("what", ["nothing", "a target that is no number", "an endless state"])
def test_a_fit_that_fails_leaves_the_network_as_it_is(what):
    x, mask = rows(6), ONES.copy()
    targets = x[:, 0].copy()
    before = fitted(x, targets, times=2)
    if what == "nothing":
        mask *= 0
    elif what == "an endless state":
        x[7, 1] = np.inf
    else:
        targets[7] = np.nan
    assert_same(fitted(x, targets, mask, times=1, start=before), before)


@pytest.mark.parametrize("constant", [0.0, 3.0, -1e4])
def test_equal_targets_and_equal_inputs_are_not_divided_by_zero(constant):
    x, targets = np.full((N, S + 1), constant, np.float32), np.full(N, constant, np.float32)
    now = fitted(x, targets, times=3)
    np.testing.assert_allclose(predict(now, x), targets, rtol=1e-3)
    # An input that never varied says nothing, whatever it does later.
    np.testing.assert_array_equal(predict(now, x + 1), predict(now, x))


def test_learning_goes_on_from_fit_to_fit_and_depends_on_its_key():
    x = rows(7)
    truth = np.tanh(2 * x[:, 0]) * x[:, 1]
    once, often = (1 - explained(predict(fitted(x, truth, times=n), x), truth) for n in (1, 20))
    assert once > 5 * often
    now = fitted(x, truth, times=3)
    assert int(now.moments[0].count) == 3 * QUICK.value_steps
    one, other = (fit(now, x, truth, ONES, QUICK, jax.random.key(k)) for k in (1, 2))
    assert np.any(one.layers[0][0] != other.layers[0][0])


# ---------------------------------------------------------------- advantages under it


@pytest.mark.parametrize("cut", [False, True])
def test_a_batch_is_judged_by_the_network_before_it_teaches_it(cut):
    rng, batch = np.random.default_rng(0), a_batch(1)
    mask = (np.arange(T)[:, None] < rng.integers(0, 2 * T, E)).astype(np.float32)
    batch = batch._replace(mask=mask, going_on=mask[-1] * (rng.uniform(size=E) < 0.7).astype(np.float32))
    now = fitted(rows(2), rows(2)[:, 0] * 3 + 1)
    got, refitted = advantages_and_value(batch, now, QUICK, KEY, cut=cut)
    x = timed(batch.states, timeless=cut)
    values = predict(now, x)
    after = batch.going_on * predict(now, timed(batch.last[None], timeless=True))[0] * cut
    slow = gae(batch.rewards, values, mask, 0.9, 0.95, after)
    counts = mask > 0
    standard = np.where(counts, (slow - slow[counts].mean()) / slow[counts].std(), 0)
    np.testing.assert_allclose(got, standard, atol=1e-4)
    expected = fit(now, x.reshape(N, -1), (values + slow).reshape(N), mask.reshape(N), QUICK, KEY)
    for ours, theirs in zip(jax.tree.leaves(refitted), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-3, rtol=2e-3)


def learned(batch_of_time, updates):
    """The network after so many updates, each on a batch of its own that is cut."""
    now = fresh()
    for i in range(updates):
        _, now = advantages_and_value(batch_of_time(i), now, QUICK, jax.random.fold_in(KEY, i), cut=True)
    return now


@pytest.mark.parametrize("ending", [False, True])
def test_the_value_at_the_cut_is_that_of_the_endless_episode(ending):
    """A reward of 1 for ever is worth 1 / (1 - discount), though every episode shows 5 steps of it only."""

    def batch(i):
        now = a_batch(i)
        return now._replace(rewards=now.mask, going_on=now.going_on * (not ending))

    def left(value):
        """Lambda-returns with 5, 4, ... 1 steps to go, nothing behind, all states being worth `value`."""
        out = [1.0]
        while len(out) < T:
            out.append(1 + 0.9 * (0.05 * value + 0.95 * out[-1]))
        return np.mean(out)

    expected = 10.0
    if ending:  # all steps look alike without time: worth their mean
        for _ in range(100):
            expected = left(expected)
    values = predict(learned(batch, 40), timed(batch(99).states, timeless=True))
    np.testing.assert_allclose(np.mean(values), expected, rtol=0.03)
    np.testing.assert_allclose(values, np.mean(values), rtol=0.15)


K = 0.2
M = probe.A - K * probe.B
"""The probe under the policy a = -K s."""


def test_a_linear_systems_value_is_learned_from_first_steps():
    """Of the value -s' P s, P = M'M + K^2 I + discount M'PM, a fourth lies behind the cut."""
    p = np.zeros((2, 2))
    for _ in range(1000):
        p = M.T @ M + K**2 * np.eye(2) + 0.9 * M.T @ p @ M

    def batch(i):
        states = [np.random.default_rng(i).uniform(-0.7, 0.7, (E, 2))]
        for _ in range(T):
            states.append(states[-1] @ M.T)
        s = np.array(states, np.float32)
        rewards = -np.square(s[1:]).sum(-1) - K**2 * np.square(s[:-1]).sum(-1)
        return a_batch(i)._replace(states=s[:-1], rewards=rewards, last=s[-1])

    seen = batch(99)
    truth = -np.einsum("tni,ij,tnj->tn", seen.states, p, seen.states)
    shown = np.mean(0.9 ** np.arange(T) @ seen.rewards)
    assert np.mean(truth[0]) < 1.25 * shown < 0
    values = predict(learned(batch, 60), timed(seen.states, timeless=True))
    assert explained(values, truth) > 0.97
    np.testing.assert_allclose(np.mean(values), np.mean(truth), rtol=0.05)


def test_time_tells_what_is_left_of_an_episode_that_is_not_cut():
    """A reward of 1 in each of 200 steps: worth 200 - t, which no state shows; the last states are of no use then."""
    config, ones = dataclasses.replace(QUICK, discount=1.0, gae_lambda=1.0), np.ones((200, 10), np.float32)
    states = np.random.default_rng(0).normal(size=(200, 10, S)).astype(np.float32)
    batch, now = Trajectories(states, 0 * states, ones, ones, np.full((10, S), np.nan, np.float32)), fresh()
    for i in range(15):
        _, now = advantages_and_value(batch, now, config, jax.random.fold_in(KEY, i))
    left = np.repeat(200.0 - np.arange(200)[:, None], 10, 1)
    assert explained(predict(now, timed(states)), left) > 0.99


# ---------------------------------------------------------------- devices

DEVICES = 4


def share(now, x, targets, mask, key):
    return network.fit(now, x, targets, mask, QUICK, key)


together = on_host()(jax.vmap(share, (None, 0, 0, 0, None), axis_name=devices.AXIS))


def shared(x, targets, mask, times):
    """The network as every device has it after `times` fits, each to its own share of the rows."""
    shares = [np.reshape(a, (DEVICES, -1, *a.shape[1:])).astype(np.float32) for a in (x, targets, mask)]
    now = fresh()
    for i in range(times):
        everywhere = together(now, *shares, jax.random.fold_in(KEY, i))
        for leaf in jax.tree.leaves(everywhere):
            assert np.ptp(leaf, axis=0).max() == 0, "devices differ"
        now = jax.tree.map(lambda leaf: leaf[0], everywhere)
    return now


def test_devices_learn_one_network_from_all_their_shares():
    """Each device sees its own quarter of the line only; the network holds all of it, in units of all of it."""
    x = rows(8)
    x = x[np.argsort(x[:, 0])]
    truth = np.sin(2 * x[:, 0])
    now, whole = shared(x, truth, ONES, 15), fitted(x, truth, times=15)
    for name in ("input_mean", "input_scale", "target_mean", "target_std"):
        np.testing.assert_allclose(getattr(now, name), getattr(whole, name), atol=1e-4)
    assert min(explained(predict(n, x), truth) for n in (now, whole)) > 0.9


def test_a_devices_say_is_its_share_of_the_steps_that_count():
    """Devices with 10, 20, 30 and 0 steps that count, targets 1, 0, 0 and none: the mean of all steps is learned."""
    x, mask = np.zeros((N, S + 1)), np.zeros((DEVICES, N // DEVICES))
    for device, count in enumerate((10, 20, 30, 0)):
        mask[device, :count] = 1
    now = shared(x, np.arange(N) < N // DEVICES, mask.reshape(-1), 20)
    np.testing.assert_allclose(now.target_mean, 1 / 6, atol=1e-5)
    np.testing.assert_allclose(predict(now, x.astype(np.float32)), 1 / 6, atol=0.01)


# ---------------------------------------------------------------- within the loop


def test_the_setting_chooses_the_baseline(monkeypatch):
    calls = []

    def record(name, rollouts, baseline, *given):
        calls.append((name, baseline, *given))
        return rollouts.rewards, "refitted"

    for name, row in VALUE_FUNCTIONS.items():
        monkeypatch.setitem(VALUE_FUNCTIONS, name, row._replace(learn=partial(record, name)))
    settings = {"advantage.discount": 0.9, "advantage.gae_lambda": 0.8, "advantage.ridge": 0.1}
    plain = override(Config("Probe"), settings)
    deep = override(plain, {"advantage.baseline": "network", "imagine.horizon": T})
    for config in (plain, deep):
        batch, refitted = batch_of(config.advantage, a_batch(5), "before", KEY, config is deep)
        np.testing.assert_array_equal(batch.advantages.reshape(E, T).T, a_batch(5).rewards)
        assert refitted == "refitted"
    assert calls == [
        ("linear", "before", plain.advantage, KEY, False),
        ("network", "before", deep.advantage, KEY, True),
    ]
    np.testing.assert_array_equal(init_baseline(plain.advantage, S, KEY), linear.init(S))
    assert_same(init_baseline(deep.advantage, S, KEY), network.init(KEY, S, deep.advantage))
    # What a policy phase leaves is what the next one starts with.
    now = fresh()
    assert init_memory(PhaseSettings.of(deep, cut=True), random_policy(0, S, 2), now).baseline is now


def test_a_checkpoint_brings_the_network_back(tmp_path):
    config = override(Config("Probe"), {"advantage.baseline": "network", "advantage.value_hidden": (8,)})
    with probe.registered():
        state = training.init(config)
    changed = jax.tree.map(lambda x: np.asarray(x) + 1, state.baseline)
    save_state(tmp_path / "state.npz", state._replace(baseline=changed), {"metrpo": "0"})
    loaded, _ = load_state(tmp_path / "state.npz", state)
    assert jax.tree.structure(loaded.baseline) == jax.tree.structure(state.baseline)
    assert_same(loaded.baseline, changed)
    # A linear baseline is one array by this name, as it was before there were networks.
    save_state(tmp_path / "linear.npz", state._replace(baseline=linear.init(S)), {"metrpo": "0"})
    with np.load(tmp_path / "linear.npz") as file:
        assert [n for n in file.files if "baseline" in n] == [".baseline"]


def test_the_probe_is_learned_from_a_quarter_of_its_episodes():
    """Imagined episodes of 5 steps; what follows, the network knows."""
    settings = {"imagine.steps": 600, "imagine.horizon": 5, "trpo.max_kl": 0.03}
    config = override(Config("Probe", advantage=QUICK), settings)
    ensemble = linear_ensemble([(probe.A, probe.B)])
    policy = random_policy(0, 2, 2, (), scale=0.3, std=0.5)
    pool, tests = np.split(np.random.default_rng(0).uniform(-0.7, 0.7, (60 * 120 + 50, 2)).astype(np.float32), [-50])
    settings, simulator = PhaseSettings.of(config, cut=True), policy_phase.simulator_of(config, probe.PROBE, ensemble)
    memory = init_memory(settings, policy, fresh())
    new, after, (info, _) = policy_phase.run_updates(
        settings, simulator, policy, memory, pool.reshape(60, 120, 2), jax.random.key(1)
    )
    whole = policy_phase.simulator_of(Config("Probe"), probe.PROBE, ensemble)
    optimum = -np.mean(np.sum(tests @ probe.riccati()[0] * tests, axis=1))
    before, reached = (policy_phase.values_of(whole, p, tests)[0] for p in (policy, new))
    assert before < 15 * optimum
    assert 1.3 * optimum < reached < 0.999 * optimum
    assert np.all(info.accepted)
    assert int(after.baseline.moments[0].count) == 60 * QUICK.value_steps
