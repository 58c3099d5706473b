"""Fitting against a slow NumPy version: every member alone, by its own minibatches, back at its own best weights."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from helpers import linear_ensemble, member, random_ensemble, random_transitions, slow_delta
from metrpo.config import FitConfig
from metrpo.model import ensemble as ensembles
from metrpo.model import fit as fitting
from metrpo.model.ensemble import Ensemble
from metrpo.model.epochs import minibatch, train_and_validate
from metrpo.speed.measure import compilations
from metrpo.types import Transitions

KEY = jax.random.key(0)


def fit(*args, **more):
    """The fit with its results as NumPy arrays: every operation on a JAX array would be compiled by itself."""
    return jax.device_get(fitting.fit(*args, **more))


def slow_validation_loss(ensemble, validation, loss_units="raw"):
    size = int(validation.size)
    unit = np.asarray(ensemble.normaliser.delta_std, np.float64) if loss_units == "std" else 1.0
    losses = np.zeros(ensemble.members)
    for k in range(ensemble.members):
        for s, a, d in zip(*(x[:size] for x in validation[:3]), strict=True):
            losses[k] += np.sum(((slow_delta(ensemble, k, s, a) - d) / unit) ** 2) / size
    return losses


@pytest.mark.parametrize("size", [1, 999, 1000, 1001, 2500])
def test_validation_loss_is_the_mean_over_the_rows_that_count(size):
    """Chunks of 1,000, the last one partly filled; garbage lies beyond `size`."""
    ensemble = random_ensemble(0, members=2, hidden=(3,))
    validation = random_transitions(np.random.default_rng(size), size, capacity=2500)
    got = fitting.validation_loss(ensemble, validation)
    np.testing.assert_allclose(got, slow_validation_loss(ensemble, validation), rtol=1e-4)


def test_validation_loss_below_one_chunk_in_either_unit():
    ensemble = random_ensemble(0, members=2, hidden=(3,))
    validation = random_transitions(np.random.default_rng(0), 7)
    for units in ("raw", "std"):
        got = fitting.validation_loss(ensemble, validation, units)
        np.testing.assert_allclose(got, slow_validation_loss(ensemble, validation, units), rtol=1e-4)


class SlowMember:
    """One network and its Adam(W), in float64 NumPy, with the gradient worked out by hand."""

    def __init__(self, ensemble, k, config):
        self.ensemble, self.config, self.steps = ensemble, config, 0
        self.layers = [[np.asarray(x[k], np.float64) for x in layer] for layer in ensemble.networks]
        self.moments = [[(np.zeros_like(x), np.zeros_like(x)) for x in layer] for layer in self.layers]

    def gradient(self, states, actions, deltas):
        n = self.ensemble.normaliser
        inputs = [
            np.concatenate([(states - n.state_mean) * n.state_scale, (actions - n.action_mean) * n.action_scale], 1)
        ]
        slopes, smooth = [], self.ensemble.activation.name == "silu"
        for i, (weights, biases) in enumerate(self.layers):
            h = inputs[-1] @ weights + biases
            sigmoid = 1 / (1 + np.exp(-h)) if smooth else (h > 0).astype(float)
            slopes.append(sigmoid * (1 + h * (1 - sigmoid)) if smooth else sigmoid)
            inputs.append(h * sigmoid if i < len(self.layers) - 1 else h)
        unit = n.delta_std if self.config.loss_units == "std" else 1.0
        back = 2 * (n.delta_mean + n.delta_std * inputs[-1] - deltas) / unit**2 * n.delta_std / len(states)
        gradients = []
        for i, (weights, _) in reversed(list(enumerate(self.layers))):
            if i < len(self.layers) - 1:
                back = back * slopes[i]
            gradients.insert(0, (inputs[i].T @ back, back.sum(0, keepdims=True)))
            back = back @ weights.T
        return gradients

    def step(self, rows):
        rate = self.config.learning_rate
        if self.config.decay:
            rate *= 0.5 * (1 + np.cos(np.pi * self.steps / self.config.max_steps))
        self.steps += 1
        for layer, moments, gradients in zip(self.layers, self.moments, self.gradient(*rows), strict=True):
            for j, g in enumerate(gradients):
                first, second = 0.9 * moments[j][0] + 0.1 * g, 0.999 * moments[j][1] + 0.001 * g**2
                moments[j] = first, second
                first, second = first / (1 - 0.9**self.steps), second / (1 - 0.999**self.steps)
                decay = self.config.weight_decay * layer[j] if j == 0 else 0.0
                layer[j] = layer[j] - rate * (first / (np.sqrt(second) + 1e-8) + decay)

    def loss(self, validation):
        networks = tuple((w[None], b[None]) for w, b in self.layers)
        alone = self.ensemble._replace(networks=networks)
        return slow_validation_loss(alone, validation, self.config.loss_units)[0]


def slow_fit(ensemble, k, train, validation, config):
    """Member k trained alone: its validation losses after 0, 1, ... blocks, and its layers then."""
    slow = SlowMember(ensemble, k, config)
    steps = max(1, int(train.size) // config.batch_size) * config.validate_every
    losses, layers = [slow.loss(validation)], [[tuple(x) for x in slow.layers]]
    for passes in range(config.validate_every, config.max_passes + 1, config.validate_every):
        block = jax.random.fold_in(KEY, passes)
        for i in range(steps):
            index = minibatch(jax.random.fold_in(block, i), jnp.arange(k, k + 1), config.batch_size, train.size)[0]
            slow.step([x[np.asarray(index)].astype(float) for x in train[:3]])
        losses.append(slow.loss(validation))
        layers.append([tuple(x) for x in slow.layers])
    return np.array(losses), layers


NOISY = FitConfig(learning_rate=0.03, batch_size=10, validate_every=2, max_passes=16, patience=99)


@pytest.mark.parametrize(
    ("size", "config", "activation"),
    [
        (33, NOISY, "relu"),
        (33, NOISY, "silu"),
        (33, replace(NOISY, loss_units="std", weight_decay=2.0), "relu"),
        (33, replace(NOISY, weight_decay=2.0, decay=True, max_steps=48), "relu"),
        (5, replace(NOISY, validate_every=1), "relu"),
    ],
    ids=[
        "minibatches",
        "smooth units",
        "weights decay, units of std",
        "steps fall to 0",
        "fewer rows than a minibatch",
    ],
)
def test_each_member_trains_alone_and_returns_to_its_own_best(size, config, activation):
    """Each slice equals that member's training by itself; few noisy rows make the best passes differ."""
    ensemble = random_ensemble(3, hidden=(8,))._replace(activation=ensembles.Activation(activation))
    rng = np.random.default_rng(size)
    train, validation = random_transitions(rng, size, capacity=40), random_transitions(rng, 30)
    fitted, info = fit(ensemble, train, validation, config, KEY)
    best_blocks = []
    for k in range(3):
        losses, layers = slow_fit(ensemble, k, train, validation, config)
        best = int(np.argmin(losses))
        best_blocks.append(best)
        assert int(info.best_pass[k]) == best * config.validate_every
        assert float(info.validation_loss[k]) == pytest.approx(losses[best], rel=1e-3)
        for ours, slow in zip(member(fitted, k).networks, layers[best], strict=True):
            for x, y in zip(ours, slow, strict=True):
                np.testing.assert_allclose(x[0], y, atol=2e-3)
    assert len(set(best_blocks)) > 1, "the case must have members that are best at different passes"
    assert min(best_blocks) < config.max_passes // config.validate_every
    again = fitting.validation_loss(fitted, validation, config.loss_units)
    np.testing.assert_allclose(again, info.validation_loss, rtol=1e-5)
    assert info.passes == config.max_passes


def a_system(size, seed=0, noise=0.0):
    """Transitions of one fixed linear system."""
    rng = np.random.default_rng(99)
    a, b = 0.3 * rng.normal(size=(4, 4)), 0.3 * rng.normal(size=(4, 2))
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=(size, 4)), rng.uniform(-1, 1, size=(size, 2))
    deltas = states @ a.T + actions @ b.T + noise * rng.normal(size=(size, 4))
    return Transitions(*(x.astype(np.float32) for x in (states, actions, deltas)), np.int32(size)), (a, b)


SHORT = FitConfig(learning_rate=0.01, batch_size=20, validate_every=2, max_passes=6, patience=99)


@pytest.mark.parametrize("k", [0, 2])
@pytest.mark.parametrize("garbage", [np.nan, 100.0])
def test_other_members_have_no_influence(k, garbage):
    train, validation = a_system(60)[0], a_system(30, seed=1)[0]
    networks = random_ensemble(1).networks
    normaliser = ensembles.normaliser_of(train, 0.1, 0.1)

    def spoil(x):
        x = np.full_like(x, garbage) if np.isnan(garbage) else garbage * x
        x[k] = 0
        return x

    others = np.arange(3).reshape(3, 1, 1) != k
    spoilt = jax.tree.map(lambda x: np.where(others, spoil(x), x).astype(np.float32), networks)
    (clean, info), (dirty, dirty_info) = (
        fit(Ensemble(n, normaliser), train, validation, SHORT, KEY) for n in (networks, spoilt)
    )
    for ours, theirs in zip(member(dirty, k).networks, member(clean, k).networks, strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)
        np.testing.assert_allclose(ours[1], theirs[1], atol=1e-6)
    assert info.best_pass[k] == dirty_info.best_pass[k] > 0
    assert info.validation_loss[k] == pytest.approx(float(dirty_info.validation_loss[k]), rel=1e-5)


def test_the_first_member_of_many_is_the_only_member_of_one():
    train, validation = a_system(60)[0], a_system(30, seed=1)[0]
    normaliser = ensembles.normaliser_of(train, 0.1, 0.1)
    three, one = (
        fit(Ensemble(e.networks, normaliser), train, validation, SHORT, KEY)[0]
        for e in (random_ensemble(1), member(random_ensemble(1), 0))
    )
    for ours, theirs in zip(jax.tree.leaves(member(three, 0).networks), jax.tree.leaves(one.networks), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_members_trained_at_once_equal_those_trained_in_turn(monkeypatch):
    """As on a GPU, and as on a CPU."""
    train, validation = a_system(60)[0], a_system(30, seed=1)[0]
    start = random_ensemble(1)._replace(normaliser=ensembles.normaliser_of(train, 0.1, 0.1))
    found = []
    for backend in ("cpu", "gpu"):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        train_and_validate.clear_cache()
        found.append(fit(start, train, validation, SHORT, KEY))
    train_and_validate.clear_cache()
    for ours, theirs in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_a_diverged_member_keeps_its_best_weights():
    train, validation = a_system(60)[0], a_system(30, seed=1)[0]
    start = random_ensemble(2)._replace(normaliser=ensembles.normaliser_of(train, 0.1, 0.1))
    train.deltas[:] = 1e30  # squares overflow: the loss is infinite and the gradient is not a number
    fitted, info = fit(start, train, validation, SHORT, KEY)
    assert jax.tree.all(jax.tree.map(np.array_equal, fitted.networks, start.networks))
    assert not np.any(info.best_pass)
    assert np.all(np.isfinite(info.validation_loss))


@pytest.mark.parametrize(
    ("improvements", "settings", "passes"),
    [
        ([[], []], {}, 25),
        ([[5, 10], []], {}, 35),
        ([[5, 30], []], {}, 55),
        ([[5, 31 + 4], [10]], {}, 60),
        ([[5], [30]], {}, 55),
        ([[25], []], {}, 50),
        ([[30], []], {}, 25),
        ([range(5, 2000, 5), []], {"max_passes": 40}, 40),
        ([[3], []], {"validate_every": 3, "patience": 7}, 12),
        ([[3], []], {"validate_every": 3, "patience": 7, "decay": True, "max_steps": 60}, 20),
        # 30 minibatches are 10 passes of 3; the 31st begins the eleventh
        ([range(5, 2000, 5), []], {"max_steps": 30}, 10),
        ([range(5, 2000, 5), []], {"max_steps": 31}, 11),
        ([range(5, 2000, 5), []], {"max_steps": 7}, 3),
        ([range(5, 2000, 5), []], {"max_passes": 12}, 12),
        ([range(5, 2000, 5), []], {"max_steps": 30, "max_passes": 5}, 5),
        ([[], []], {"max_steps": 3000}, 25),
    ],
)
def test_fitting_stops_when_no_member_improves_within_patience(monkeypatch, improvements, settings, passes):
    """With the passes after which each of two members improves given."""
    config = FitConfig(**settings)
    trained = []

    def scripted(at, data, config, mesh, key, steps, after):
        trained.append((int(after), int(steps)))
        better = jnp.array([int(after) in list(script) for script in improvements])
        return at._replace(best_pass=jnp.where(better, after, at.best_pass), best_loss=at.best_loss - better)

    monkeypatch.setattr(fitting, "train_and_validate", scripted)
    told = []
    ensemble = random_ensemble(0, members=2, hidden=())
    train = random_transitions(np.random.default_rng(0), 3500, capacity=5000)
    validation = random_transitions(np.random.default_rng(1), 8)

    def tell(passes, losses):
        told.append((passes, np.array(losses)))

    _, info = fit(ensemble, train, validation, config, KEY, tell)
    assert info.passes == passes
    every = config.validate_every
    # 3,500 rows are 3 minibatches of 1,000: a pass is 3 steps, whatever the capacity.
    total = sum(steps for _, steps in trained)
    assert total == min(3 * passes, config.max_steps or 3 * passes), "a maximum is a maximum"
    whole, (last, rest) = trained[:-1], trained[-1]
    assert whole == [(p, 3 * every) for p in range(every, last, every)]
    assert last == passes
    assert 0 < rest <= 3 * every
    assert [p for p, _ in told] == [p for p, _ in trained]
    np.testing.assert_array_equal(told[-1][1], info.validation_loss)


def test_capacity_beyond_the_size_has_no_influence():
    train, validation = a_system(60)[0], a_system(30, seed=1)[0]
    ensemble = random_ensemble(1)._replace(normaliser=ensembles.normaliser_of(train, 0.1, 0.1))

    def padded(t, capacity):
        garbage = np.float32(1e4)
        return Transitions(
            *(np.pad(x, ((0, capacity - len(x)), (0, 0)), constant_values=garbage) for x in t[:3]), t.size
        )

    exact = fit(ensemble, train, validation, SHORT, KEY)
    roomy = fit(ensemble, padded(train, 100), padded(validation, 1500), SHORT, KEY)
    for ours, theirs in zip(jax.tree.leaves(roomy), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize("decay", [False, True])
def test_rounds_are_so_many_times_the_steps_and_compile_nothing_anew(decay):
    train, validation = a_system(60)[0], a_system(30, seed=1)[0]
    ensemble = random_ensemble(1)._replace(normaliser=ensembles.normaliser_of(train, 0.1, 0.1))
    config = replace(SHORT, max_steps=6, max_passes=100, patience=100, decay=decay)
    once = fit(ensemble, train, validation, config, KEY)
    with compilations() as seen:
        thrice = fit(ensemble, train, validation, config, KEY, rounds=3)
    assert not seen
    as_one = fit(ensemble, train, validation, replace(config, max_steps=18), KEY)
    assert thrice[1].passes == as_one[1].passes == -(-18 // (60 // config.batch_size)) > once[1].passes
    for ours, theirs in zip(jax.tree.leaves(thrice), jax.tree.leaves(as_one), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_callers_arrays_stay_usable():
    train, validation = jax.device_put((a_system(60)[0], a_system(30, seed=1)[0]))
    ensemble = random_ensemble(1)._replace(normaliser=ensembles.normaliser_of(train, 0.1, 0.1))
    given = jax.tree.map(jnp.asarray, (ensemble, train, validation))
    before = jax.tree.map(np.array, given)
    fit(given[0], given[1], given[2], SHORT, KEY)
    assert not any(x.is_deleted() for x in jax.tree.leaves(given))
    assert jax.tree.all(jax.tree.map(np.array_equal, given, before))


def test_fitting_learns_a_known_system():
    train, (a, b) = a_system(500)
    validation, _ = a_system(200, seed=1)
    normaliser = ensembles.normaliser_of(train, 0.1, 0.1)
    networks = ensembles.init(jax.random.key(0), 3, 4, 2, (16,))
    config = FitConfig(learning_rate=0.01, batch_size=50, validate_every=5, max_passes=80, patience=25)
    before = fitting.validation_loss(Ensemble(networks, normaliser), validation)
    losses = []

    def keep(passes, loss):
        losses.append(np.array(loss))

    fitted, info = fit(Ensemble(networks, normaliser), train, validation, config, KEY, keep)
    assert np.all(info.validation_loss < 0.01 * before)
    assert np.all(np.diff(np.array([before, *losses]), axis=0) <= 0), "the best so far never gets worse"
    fresh, _ = a_system(50, seed=2)
    prediction = ensembles.predict_delta(fitted, *(np.stack([x] * 3) for x in fresh[:2]))
    np.testing.assert_allclose(prediction, np.stack([fresh.deltas] * 3), atol=0.5)
    assert np.std(prediction - fresh.deltas) < 0.1 * np.std(fresh.deltas)
    # The exact system has no loss at all.
    exact = linear_ensemble([(np.eye(4) + a, b)], normaliser)
    assert fitting.validation_loss(exact, validation)[0] < 1e-9


def test_minibatches_are_uniform_and_independent():
    keys = jax.random.split(jax.random.key(1), 300)
    index = np.asarray(jax.vmap(lambda k: minibatch(k, jnp.arange(3), 10, 7))(keys))
    assert (index.min(), index.max()) == (0, 6)
    for k in range(3):
        assert stats.chisquare(np.bincount(index[:, k].ravel(), minlength=7)).pvalue > 1e-3
    # between members, between steps and within a batch (with replacement)
    for x, y in ((index[:, 0], index[:, 1]), (index[1:, 0], index[:-1, 0]), (index[:, 0, 1:], index[:, 0, :-1])):
        table = np.histogram2d(x.ravel(), y.ravel(), bins=7)[0]
        assert stats.chi2_contingency(table).pvalue > 1e-3
