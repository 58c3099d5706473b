"""Fitting the ensemble: Adam with early stopping, every member on its own minibatches and its own best weights.

Paper, section 4.1 (the L2 one-step loss) and appendix A.1.2 (batch, passes, patience).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from metrpo import devices
from metrpo.config import FitConfig
from metrpo.model.ensemble import Ensemble, Networks, predict_delta, with_products
from metrpo.types import Array, Normaliser, Transitions

VALIDATION_CHUNK = 1000
"""Validation transitions per product; bounds memory and keeps shapes fixed as data grows."""


class FitInfo(NamedTuple):
    """What one fit did."""

    passes: int
    """Passes over the training set."""
    validation_loss: Array
    """[K], each member's best, in squared `loss_units`."""
    train_loss: Array
    """[K], of the last minibatches."""
    best_pass: Array
    """[K], the pass after which each member was best."""
    diverged: np.ndarray
    """[K] of bool: training ended with weights or a loss that are not finite."""
    lost: np.ndarray
    """[K] of bool: no weights are worth keeping: the best are not finite, or training diverged and never improved."""
    resets: int = 0
    """Members that were lost and fitted again."""


class _Progress(NamedTuple):
    networks: Networks
    optimizer: optax.OptState
    best_networks: Networks
    best_loss: Array
    best_pass: Array
    train_loss: Array


def fit(
    networks: Networks,
    normaliser: Normaliser,
    train: Transitions,
    validation: Transitions,
    config: FitConfig,
    key: Array,
    on_validation: Callable[[int, Array], None] = lambda passes, losses: None,
) -> tuple[Ensemble, FitInfo]:
    """The ensemble fitted to `train`, each member at its own best validation loss.

    Stops when no member has improved for `config.patience` passes, at the latest after `config.max_passes` or
    `config.max_steps`.
    `on_validation(passes, best losses [K])` is called at every validation. Adam starts afresh. Members are spread over
    JAX's devices where their number allows (paper, section 5: "could potentially yield multiple-fold speed-up").
    """
    optimizer = _optimizer(config)
    loss = validation_loss(Ensemble(networks, normaliser), validation, config.loss_units)
    at = _Progress(networks, optimizer.init(networks), networks, loss, jnp.zeros(loss.shape, jnp.int32), loss)
    at = jax.tree.map(jnp.copy, at)  # its buffers are given away below, the caller's are not
    mesh = devices.mesh(loss.size, "members")
    at, normaliser = devices.shared(at, mesh), devices.copied(normaliser, mesh)
    train, validation = devices.copied(train, mesh), devices.copied(validation, mesh)
    # At least one step a pass: the first iterations of a small task may have fewer transitions than a minibatch.
    steps_per_pass = max(1, int(train.size) // config.batch_size)
    steps = steps_per_pass * config.validate_every
    max_passes = min(config.max_passes, (config.max_steps or math.inf) / steps_per_pass)
    passes = 0
    while passes < max_passes and passes - int(at.best_pass.max()) < config.patience:
        passes += config.validate_every
        at = _train_and_validate(at, normaliser, train, validation, config, key, jnp.int32(steps), jnp.int32(passes))
        on_validation(passes, at.best_loss)
    diverged = ~(_finite(at.networks) & np.isfinite(at.train_loss))
    lost = ~(_finite(at.best_networks) & np.isfinite(at.best_loss)) | (diverged & (np.asarray(at.best_pass) == 0))
    info = FitInfo(passes, at.best_loss, at.train_loss, at.best_pass, diverged, lost)
    return Ensemble(at.best_networks, normaliser), info


def refit(
    ensemble: Ensemble,
    info: FitInfo,
    fresh: Networks,
    train: Transitions,
    validation: Transitions,
    config: FitConfig,
    key: Array,
) -> tuple[Ensemble, FitInfo]:
    """A fitted ensemble with its lost members fitted again, by themselves, from theirs of `fresh`.

    The others are bit for bit what they were.
    """
    lost = np.flatnonzero(info.lost)

    def put(old: Array, new: Array) -> np.ndarray:
        rows = np.array(old)
        rows[lost] = new
        return rows

    normaliser = jax.tree.map(np.asarray, ensemble.normaliser)
    chosen = jax.tree.map(lambda x: np.asarray(x)[lost], fresh)
    again, second = fit(chosen, normaliser, train, validation, config, key)
    networks = jax.tree.map(lambda old, new: jnp.asarray(put(old, new)), ensemble.networks, again.networks)
    merged = FitInfo(
        passes=info.passes + second.passes,
        validation_loss=put(info.validation_loss, second.validation_loss),
        train_loss=put(info.train_loss, second.train_loss),
        best_pass=put(info.best_pass, second.best_pass),
        diverged=put(info.diverged, second.diverged),
        lost=put(info.lost, second.lost),
        resets=len(lost),
    )
    return Ensemble(networks, ensemble.normaliser), merged


def _finite(networks: Networks) -> np.ndarray:
    """[K] of bool."""
    leaves = [np.isfinite(np.asarray(x)) for x in jax.tree.leaves(networks)]
    return np.all([x.all(axis=tuple(range(1, x.ndim))) for x in leaves], axis=0)


def loss_of(ensemble: Ensemble, loss_units: str, states: Array, actions: Array, deltas: Array) -> Array:
    """[K, B]: squared error of the predicted change, summed over state dimensions (paper, eq. 1).

    In "raw" state units (the paper), or each dimension in units of its "std", so that none drowns another.
    """
    errors = predict_delta(ensemble, states, actions) - deltas
    if loss_units == "std":
        errors = errors / ensemble.normaliser.delta_std
    return jnp.sum(jnp.square(errors), axis=-1)


@partial(jax.jit, static_argnames="loss_units")
def validation_loss(ensemble: Ensemble, validation: Transitions, loss_units: str = "raw") -> Array:
    """[K]: mean of `loss_of` over the first `size` validation transitions; the capacity beyond costs nothing."""
    members = ensemble.members
    capacity = validation.states.shape[0]

    def chunk_sum(i: Array, total: Array) -> Array:
        index = i * VALIDATION_CHUNK + jnp.arange(VALIDATION_CHUNK)
        rows = [jnp.take(x, index, axis=0, mode="clip") for x in validation[:3]]
        losses = loss_of(ensemble, loss_units, *(jnp.broadcast_to(x, (members, *x.shape)) for x in rows))
        return total + jnp.sum(jnp.where(index < jnp.minimum(validation.size, capacity), losses, 0.0), axis=-1)

    chunks = (validation.size + VALIDATION_CHUNK - 1) // VALIDATION_CHUNK
    return jax.lax.fori_loop(0, chunks, chunk_sum, jnp.zeros(members)) / validation.size


@partial(jax.jit, static_argnames="config", donate_argnums=0)
def _train_and_validate(
    at: _Progress,
    normaliser: Normaliser,
    train: Transitions,
    validation: Transitions,
    config: FitConfig,
    key: Array,
    steps: Array,
    passes: Array,
) -> _Progress:
    optimizer = _optimizer(config)
    members = at.best_loss.shape[0]
    block_key = jax.random.fold_in(key, passes)

    def total_loss(networks: Networks, *batch: Array) -> tuple[Array, Array]:
        ensemble = Ensemble(with_products(networks, config.products), normaliser)
        losses = jnp.mean(loss_of(ensemble, config.loss_units, *batch), axis=-1)
        return jnp.sum(losses), losses

    def step(i: Array, carry: tuple[Networks, optax.OptState, Array]) -> tuple[Networks, optax.OptState, Array]:
        networks, optimizer_state, _ = carry
        index = minibatch(jax.random.fold_in(block_key, i), members, config.batch_size, train.size)
        batch = (jnp.take(x, index, axis=0) for x in train[:3])
        gradient, losses = jax.grad(total_loss, has_aux=True)(networks, *batch)
        change, optimizer_state = optimizer.update(gradient, optimizer_state, networks)
        return optax.apply_updates(networks, change), optimizer_state, losses

    start = (at.networks, at.optimizer, at.train_loss)
    networks, optimizer_state, train_loss = jax.lax.fori_loop(0, steps, step, start)
    loss = validation_loss(Ensemble(networks, normaliser), validation, config.loss_units)
    better = loss < at.best_loss  # False for NaN: a diverged member keeps its best weights

    def keep_best(new: Array, best: Array) -> Array:
        return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, best)

    return _Progress(
        networks,
        optimizer_state,
        jax.tree.map(keep_best, networks, at.best_networks),
        jnp.where(better, loss, at.best_loss),
        jnp.where(better, passes, at.best_pass),
        train_loss,
    )


def _optimizer(config: FitConfig) -> optax.GradientTransformation:
    return optax.adamw(config.learning_rate, weight_decay=config.weight_decay, mask=_weights_only)


def _weights_only(networks: Networks) -> tuple[tuple[bool, bool], ...]:
    return tuple((True, False) for _ in networks)


def minibatch(key: Array, members: int, batch_size: int, size: Array) -> Array:
    """[K, B] indices below `size`, with replacement; member k's depend on `key` and k alone."""
    keys = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(members))
    return jax.vmap(lambda k: jax.random.randint(k, (batch_size,), 0, size))(keys)
