"""Small ensembles, policies and tasks with known answers, shared by the tests."""

from __future__ import annotations

from itertools import pairwise

import jax
import numpy as np

from metrpo.model.ensemble import Ensemble
from metrpo.policy import gaussian
from metrpo.types import Episode, Normaliser, Transitions


def on_host(**jit):
    """jax.jit with results as NumPy arrays, for every operation on a JAX array is compiled by itself."""

    def wrap(function):
        compiled = jax.jit(function, **jit)
        return lambda *args, **kwargs: jax.device_get(compiled(*args, **kwargs))

    return wrap


def identity_normaliser(state_size, action_size):
    s, a = np.ones(state_size, np.float32), np.ones(action_size, np.float32)
    return Normaliser(0 * s, s, 0 * a, a, 0 * s, s)


def random_normaliser(rng, state_size, action_size, unseen=()):
    """Shifts and scales of about one; NumPy arrays."""

    def scale(n):
        return rng.uniform(0.5, 2.0, n).astype(np.float32)

    def shift(n):
        return rng.normal(size=n).astype(np.float32)

    state_scale = scale(state_size)
    state_scale[list(unseen)] = 0
    return Normaliser(
        shift(state_size), state_scale, shift(action_size), scale(action_size), shift(state_size), scale(state_size)
    )


def random_ensemble(seed=0, members=3, state_size=4, action_size=2, hidden=(8, 8), scale=1.0):
    """Random weights and biases under a random normaliser; NumPy arrays."""
    rng = np.random.default_rng(seed)
    sizes = (state_size + action_size, *hidden, state_size)
    networks = tuple(
        (_weights(rng, (members, i, o), scale), 0.3 * rng.normal(size=(members, 1, o)).astype(np.float32))
        for i, o in pairwise(sizes)
    )
    return Ensemble(networks, random_normaliser(rng, state_size, action_size))


def linear_ensemble(matrices, normaliser=None, relu=False):
    """The ensemble whose member k is exactly s' = A_k s + B_k a, given `matrices` [(A_k, B_k), ...].

    With `relu`, through a hidden layer as x = relu(x) - relu(-x); under any `normaliser`, which the weights undo.
    """
    state_size, action_size = matrices[0][1].shape
    n = normaliser or identity_normaliser(state_size, action_size)
    weights, biases = [], []
    for a, b in matrices:
        # delta = (A - I) s + B a, with s = mean + input / scale, and output = (delta - delta_mean) / delta_std
        full = np.concatenate([a - np.eye(state_size), b], axis=1).astype(np.float64)
        spread = np.concatenate([1 / n.state_scale, 1 / n.action_scale])
        middle = np.concatenate([n.state_mean, n.action_mean])
        weights.append(((full * spread) / n.delta_std[:, None]).T)
        biases.append(((full @ middle - n.delta_mean) / n.delta_std)[None])
    weights, biases = np.array(weights), np.array(biases)
    layers = [(weights, biases)]
    if relu:
        eye = np.eye(state_size + action_size)
        pair = np.broadcast_to(np.concatenate([eye, -eye], axis=1), (len(matrices), len(eye), 2 * len(eye)))
        layers = [
            (pair, np.zeros((len(matrices), 1, pair.shape[2]))),
            (np.concatenate([weights, -weights], axis=1), biases),
        ]
    networks = tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers)
    return Ensemble(networks, n)


def member(ensemble, k):
    """Member k as an ensemble of one."""
    return ensemble._replace(networks=jax.tree.map(lambda x: np.asarray(x)[k : k + 1], ensemble.networks))


def slow_delta(ensemble, k, state, action):
    """Member k's predicted change of one state, in float64 NumPy, one layer after the other."""
    n = jax.tree.map(lambda x: np.asarray(x, np.float64), ensemble.normaliser)
    h = np.concatenate([(state - n.state_mean) * n.state_scale, (action - n.action_mean) * n.action_scale])
    for i, (weights, biases) in enumerate(ensemble.networks):
        h = h @ np.asarray(weights[k], np.float64) + np.asarray(biases[k, 0], np.float64)
        if i < len(ensemble.networks) - 1:
            h = h / (1 + np.exp(-h)) if ensemble.activation.name == "silu" else np.maximum(h, 0)
    return n.delta_mean + n.delta_std * h


def random_policy(seed=0, state_size=4, action_size=2, hidden=(8,), scale=1.0, std=0.7):
    """Random weights, biases and log stds; NumPy arrays."""
    rng = np.random.default_rng(seed)
    sizes = (state_size, *hidden, action_size)
    layers = tuple(
        (_weights(rng, (i, o), scale), scale * rng.normal(size=o).astype(np.float32)) for i, o in pairwise(sizes)
    )
    log_std = np.log(std) + 0.3 * rng.normal(size=action_size)
    return gaussian.Policy(layers, log_std.astype(np.float32))


def _weights(rng, shape, scale):
    return (scale * rng.normal(size=shape) / np.sqrt(shape[-2])).astype(np.float32)


def slow_mean(policy, state):
    """The mean action in one state, in float64 NumPy."""
    h = np.asarray(state, np.float64)
    for i, (weights, biases) in enumerate(policy.layers):
        h = h @ np.asarray(weights, np.float64) + np.asarray(biases, np.float64)
        if i < len(policy.layers) - 1:
            h = np.tanh(h)
    return h


def random_transitions(rng, size, state_size=4, action_size=2, capacity=None):
    """`size` random transitions; beyond them, up to `capacity`, garbage that must never count."""
    capacity = capacity or size

    def rows(width):
        x = rng.normal(size=(capacity, width)).astype(np.float32)
        x[size:] = 1e4
        return x

    return Transitions(rows(state_size), rows(action_size), rows(state_size), np.int32(size))


def random_episode(rng, length, state_size=4, action_size=2, terminated=False):
    return Episode(
        rng.normal(size=(length + 1, state_size)).astype(np.float32),
        rng.uniform(-1, 1, size=(length, action_size)).astype(np.float32),
        rng.normal(size=length).astype(np.float32),
        terminated,
    )
