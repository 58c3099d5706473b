"""Passes over the training set: Adam on the L2 one-step loss, every member on its own minibatches, then a validation.

Paper, section 4.1 (eq. 1) and appendix A.1.2 (batch, passes).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Float, Int, Key

from metrpo.config import FitConfig
from metrpo.devices import AXIS, FIRST, WHOLE, spread
from metrpo.model.ensemble import Activation, Ensemble, Networks, mean_and_spread, with_products
from metrpo.types import Array, Normaliser, Transitions

VALIDATION_CHUNK = 1000
"""Validation transitions per product; bounds memory and keeps shapes fixed as data grows."""


class _Training(NamedTuple):
    networks: Networks
    optimizer: optax.OptState
    train_loss: Float[Array, "K"]


class FitData(NamedTuple):
    """What a fit learns from, and is judged by."""

    normaliser: Normaliser
    train: Transitions
    validation: Transitions
    activation: Activation
    most: Int[Array, ""]
    """Minibatches of the whole fit, over which `config.decay` lets the step size fall."""

    def ensemble(self, networks: Networks) -> Ensemble:
        """Of networks that are being fitted."""
        return Ensemble(networks, self.normaliser, activation=self.activation)


class FitState(NamedTuple):
    """Where a fit stands; all but Adam's count has the members first."""

    networks: Networks
    optimizer: optax.OptState
    best_networks: Networks
    best_loss: Float[Array, "K"]
    best_pass: Int[Array, "K"]
    train_loss: Float[Array, "K"]


def losses_of(
    ensemble: Ensemble,
    loss_units: str,
    states: Float[Array, "K B S"],
    actions: Float[Array, "K B A"],
    deltas: Float[Array, "K B D"],
) -> tuple[Float[Array, "K B"], Float[Array, "K B"] | float]:
    """Squared error of the predicted change, summed over state dimensions (paper, eq. 1), and how unlikely
    probabilistic members hold the errors that they make, in nats (others: 0).

    Errors are in "raw" state units (the paper), or each dimension's in units of its "std", so that none drowns another.
    The likelihood's gradient is of the spread alone: the mean learns what it would learn without.
    """
    n, (means, log_spread) = ensemble.normaliser, mean_and_spread(ensemble, states, actions)
    errors = n.delta_mean + n.delta_std * means - deltas
    in_std = errors / n.delta_std
    loss = jnp.sum(jnp.square(in_std if loss_units == "std" else errors), axis=-1)
    if log_spread is None:
        return loss, 0.0
    squares = jnp.square(jax.lax.stop_gradient(in_std))
    return loss, jnp.sum(log_spread + 0.5 * squares * jnp.exp(-2.0 * log_spread), axis=-1)


@partial(jax.jit, static_argnames="loss_units")
def validation_loss(ensemble: Ensemble, validation: Transitions, loss_units: str = "raw") -> Float[Array, "K"]:
    """Mean squared error over the first `size` validation transitions (`losses_of`); capacity beyond costs nothing."""
    members = ensemble.members
    capacity = validation.states.shape[0]

    def chunk_sum(i: Int[Array, ""], total: Float[Array, "K"]) -> Float[Array, "K"]:
        index = i * VALIDATION_CHUNK + jnp.arange(VALIDATION_CHUNK)
        rows = [jnp.take(x, index, axis=0, mode="clip") for x in validation[:3]]
        losses, _ = losses_of(ensemble, loss_units, *(jnp.broadcast_to(x, (members, *x.shape)) for x in rows))
        return total + jnp.sum(jnp.where(index < jnp.minimum(validation.size, capacity), losses, 0.0), axis=-1)

    chunks = (validation.size + VALIDATION_CHUNK - 1) // VALIDATION_CHUNK
    return jax.lax.fori_loop(0, chunks, chunk_sum, jnp.zeros(members)) / validation.size


@partial(jax.jit, static_argnames=("config", "mesh"), donate_argnums=0)
def train_and_validate(
    at: FitState,
    data: FitData,
    config: FitConfig,
    mesh: Mesh,
    key: Key[Array, ""],
    steps: Int[Array, ""],
    passes: Int[Array, ""],
) -> FitState:
    """`steps` minibatches for every member, each device of `mesh` with its own members, then one validation."""
    own = jax.tree.map(lambda x: FIRST if x.ndim else WHOLE, at)
    block = spread(partial(_block, config=config), mesh, (own, WHOLE, WHOLE, WHOLE, WHOLE), own)
    after: FitState = block(at, data, key, steps, passes)
    return after


def _block(
    at: FitState,
    data: FitData,
    key: Key[Array, ""],
    steps: Int[Array, ""],
    passes: Int[Array, ""],
    config: FitConfig,
) -> FitState:
    """One device's share of `train_and_validate`."""
    optimizer = optimizer_of(config, data.most)
    members = at.best_loss.shape[0]
    first = jax.lax.axis_index(AXIS) * members
    block_key = jax.random.fold_in(key, passes)

    def total_loss(networks: Networks, *batch: Float[Array, "K B _"]) -> tuple[Float[Array, ""], Float[Array, "K"]]:
        ensemble = data.ensemble(with_products(networks, config.products))
        losses, surprise = losses_of(ensemble, config.loss_units, *batch)
        return jnp.sum(jnp.mean(losses + surprise, axis=-1)), jnp.mean(losses, axis=-1)

    def train_group(group: _Training, numbers: Int[Array, "K"], key: Key[Array, ""]) -> _Training:
        index = minibatch(key, numbers, config.batch_size, data.train.size)
        batch = (jnp.take(x, index, axis=0) for x in data.train[:3])
        gradient, losses = jax.grad(total_loss, has_aux=True)(group.networks, *batch)
        change, optimizer_state = optimizer.update(gradient, group.optimizer, group.networks)
        return _Training(optax.apply_updates(group.networks, change), optimizer_state, losses)

    def step(i: Int[Array, ""], groups: list[_Training]) -> list[_Training]:
        step_key = jax.random.fold_in(block_key, i)
        numbers = jnp.split(first + jnp.arange(members), len(groups))
        return [train_group(group, n, step_key) for group, n in zip(groups, numbers, strict=True)]

    # On a CPU one member after another, for what one computes stays in the cache; a GPU wants them all at once.
    apart = members if jax.default_backend() == "cpu" else 1
    groups = _split(_Training(at.networks, at.optimizer, at.train_loss), apart)
    networks, optimizer_state, train_loss = _joined(jax.lax.fori_loop(0, steps, step, groups))
    loss = validation_loss(data.ensemble(networks), data.validation, config.loss_units)
    better = loss < at.best_loss  # False for NaN: a diverged member keeps its best weights

    def keep_best(new: Float[Array, "K *rest"], best: Float[Array, "K *rest"]) -> Float[Array, "K *rest"]:
        return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, best)

    return FitState(
        networks,
        optimizer_state,
        jax.tree.map(keep_best, networks, at.best_networks),
        jnp.where(better, loss, at.best_loss),
        jnp.where(better, passes, at.best_pass),
        train_loss,
    )


def _split(x: Any, count: int) -> list[Any]:
    """`count` pytrees out of one whose arrays have the members first; scalars (Adam's count) go to each."""
    leaves, shape = jax.tree.flatten(x)
    pieces = [jnp.split(leaf, count) if leaf.ndim else [leaf] * count for leaf in leaves]
    return [jax.tree.unflatten(shape, parts) for parts in zip(*pieces, strict=True)]


def _joined(parts: list[Any]) -> Any:
    """What `_split` took apart."""
    return jax.tree.map(lambda *a: jnp.concatenate(a) if a[0].ndim else a[0], *parts)


def optimizer_of(config: FitConfig, most: Int[Array, ""]) -> optax.GradientTransformation:
    """Adam for `most` steps, with weight decay on the weights alone, which falls with the step size."""

    def falling(count: Int[Array, ""]) -> Float[Array, ""]:
        return config.learning_rate * 0.5 * (1.0 + jnp.cos(jnp.pi * jnp.minimum(count / most, 1.0)))

    rate: optax.ScalarOrSchedule = falling if config.decay else config.learning_rate
    return optax.adamw(rate, weight_decay=config.weight_decay, mask=_weights_only)


def _weights_only(networks: Networks) -> tuple[tuple[bool, bool], ...]:
    return tuple((True, False) for _ in networks)


def minibatch(
    key: Key[Array, ""], numbers: Int[Array, "K"], batch_size: int, size: Int[Array, ""] | int
) -> Int[Array, "K {batch_size}"]:
    """Indices below `size`, with replacement, for the members `numbers`; each one's depend on its number and `key`
    alone."""
    keys = jax.vmap(partial(jax.random.fold_in, key))(numbers)
    return jax.vmap(lambda k: jax.random.randint(k, (batch_size,), 0, size))(keys)
