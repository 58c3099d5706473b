"""Fitting the ensemble: passes over the data with early stopping, every member at its own best weights.

Paper, section 4.1 (the L2 one-step loss) and appendix A.1.2 (batch, passes, patience).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key, Shaped

from metrpo import devices
from metrpo.config import FitConfig
from metrpo.model.ensemble import Ensemble, Networks
from metrpo.model.epochs import FitData, FitState, optimizer_of, train_and_validate, validation_loss
from metrpo.types import Array, Transitions


class FitInfo(NamedTuple):
    """What one fit did."""

    passes: int
    """Passes over the training set."""
    validation_loss: Float[Array, "K"]
    """Each member's best, in squared `loss_units`."""
    train_loss: Float[Array, "K"]
    """Of the last minibatches."""
    best_pass: Int[Array, "K"]
    """The pass after which each member was best."""
    diverged: Bool[np.ndarray, "K"]
    """Training ended with weights or a loss that are not finite."""
    lost: Bool[np.ndarray, "K"]
    """No weights are worth keeping: the best are not finite, or training diverged and never improved."""
    resets: int = 0
    """Members that were lost and fitted again."""


def fit(
    ensemble: Ensemble,
    train: Transitions,
    validation: Transitions,
    config: FitConfig,
    key: Key[Array, ""],
    on_validation: Callable[[int, Float[Array, "K"]], None] = lambda passes, losses: None,
    rounds: int = 1,
) -> tuple[Ensemble, FitInfo]:
    """The ensemble fitted to `train` from the weights it has, each member at its own best validation loss.

    Stops when no member has improved for `config.patience` passes, at the latest after `config.max_passes` or
    `rounds` times `config.max_steps`; with `config.decay` only then, for it is the small steps that end well.
    `on_validation(passes, best losses)` is called at every validation. Adam starts afresh. Members are spread over
    JAX's devices where their number allows, as the paper suggests (appendix "Real-time complexity").
    """
    # At least one step a pass: the first iterations of a small task may have fewer transitions than a minibatch.
    steps_per_pass = max(1, int(train.size) // config.batch_size)
    in_passes = config.max_passes * steps_per_pass
    at_most = in_passes if config.max_steps is None else rounds * config.max_steps
    data = FitData(ensemble.normaliser, train, validation, ensemble.activation, jnp.int32(at_most))
    networks, optimizer, most = ensemble.networks, optimizer_of(config, data.most), min(in_passes, at_most)
    loss = validation_loss(data.ensemble(networks), validation, config.loss_units)
    at = FitState(networks, optimizer.init(networks), networks, loss, jnp.zeros(loss.shape, jnp.int32), loss)
    at = jax.tree.map(jnp.copy, at)  # its buffers are given away below, the caller's are not
    mesh = devices.mesh(loss.size)
    at, data = devices.shared(at, mesh), devices.copied(data, mesh)
    steps = passes = 0
    while steps < most and (config.decay or passes - int(at.best_pass.max()) < config.patience):
        block = min(config.validate_every * steps_per_pass, most - steps)
        steps += block
        passes = -(-steps // steps_per_pass)
        counts = jnp.int32(block), jnp.int32(passes)
        at = train_and_validate(at, data, config, mesh, key, *counts)
        on_validation(passes, at.best_loss)
    diverged = ~(_finite(at.networks) & np.isfinite(at.train_loss))
    lost = ~(_finite(at.best_networks) & np.isfinite(at.best_loss)) | (diverged & (np.asarray(at.best_pass) == 0))
    info = FitInfo(passes, at.best_loss, at.train_loss, at.best_pass, diverged, lost)
    return ensemble._replace(networks=at.best_networks, normaliser=data.normaliser), info


def refit(
    ensemble: Ensemble,
    info: FitInfo,
    fresh: Networks,
    train: Transitions,
    validation: Transitions,
    config: FitConfig,
    key: Key[Array, ""],
) -> tuple[Ensemble, FitInfo]:
    """A fitted ensemble with its lost members fitted again, by themselves, from theirs of `fresh`.

    The others are bit for bit what they were.
    """
    lost = np.flatnonzero(info.lost)

    def put(old: Shaped[Array, "K *rest"], new: Shaped[Array, "_ *rest"]) -> Shaped[np.ndarray, "K *rest"]:
        rows = np.array(old)
        rows[lost] = new
        return rows

    normaliser = jax.tree.map(np.asarray, ensemble.normaliser)
    chosen = jax.tree.map(lambda x: np.asarray(x)[lost], fresh)
    start = ensemble._replace(networks=chosen, normaliser=normaliser)
    again, second = fit(start, train, validation, config, key)
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
    return ensemble._replace(networks=networks), merged


def _finite(networks: Networks) -> Bool[np.ndarray, "K"]:
    """Of each member, whether all of its weights are."""
    leaves = [np.isfinite(np.asarray(x)) for x in jax.tree.leaves(networks)]
    return np.all([x.all(axis=tuple(range(1, x.ndim))) for x in leaves], axis=0)
