"""A value network: the other baseline, for returns that no linear function of the state describes.

It is fitted by a fixed number of Adam steps after every policy update and goes on from there in the next one, so that
it follows the policy through the whole run. Inputs and targets are normalised by the batch it was last fitted to: where
returns grow from 5 to 5,000 its predictions grow with them, without a step of Adam.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float, Key

from metrpo.config import AdvantageConfig
from metrpo.devices import across, share_of, sharers
from metrpo.policy import gaussian
from metrpo.policy.advantage import gae, standardise
from metrpo.policy.gaussian import Layers
from metrpo.types import Array, Trajectories

_FAR = 10.0
"""Normalised inputs beyond this, of a rollout that leaves the data, are shortened to it."""


class Value(NamedTuple):
    """The network, what it needs to go on learning, and its units; a pytree."""

    layers: Layers
    """tanh between them."""
    moments: Any
    """Adam's."""
    input_mean: Float[Array, "I"]
    """Of the states and t/100 in the last batch."""
    input_scale: Float[Array, "I"]
    """1 / std; 0 where an input does not vary."""
    target_mean: Float[Array, ""]
    target_std: Float[Array, ""]


def init(key: Key[Array, ""], state_size: int, config: AdvantageConfig) -> Value:
    """A fresh network that predicts 0 everywhere."""
    *inner, (last, biases) = gaussian.init(key, state_size + 1, 1, config.value_hidden, 1.0).layers
    layers = (*inner, (jnp.zeros_like(last), biases))
    inputs = jnp.zeros(state_size + 1)
    return Value(layers, _optimizer(config).init(layers), inputs, inputs, jnp.float32(0), jnp.float32(1))


def inputs(states: Float[Array, "T N S"], timeless: bool = False) -> Float[Array, "T N S+1"]:
    """What the network sees: the states and t/100; `timeless` leaves t at 0."""
    steps, count, _ = states.shape
    time = jnp.zeros(steps) if timeless else jnp.arange(steps, dtype=states.dtype) / 100.0
    return jnp.concatenate([states, jnp.broadcast_to(time[:, None, None], (steps, count, 1))], axis=-1)


def predict(value: Value, x: Float[Array, "*batch I"]) -> Float[Array, "*batch"]:
    """The values of `inputs`."""
    return value.target_mean + value.target_std * _network(value.layers, _normalised(value, x))


def at_cut(value: Value, states: Float[Array, "N S"]) -> Float[Array, "N"]:
    """The values of the states in which episodes are cut off, whatever the time."""
    return predict(value, inputs(states[None], timeless=True)[0])


def advantages_and_value(
    trajectories: Trajectories,
    baseline: Value,
    config: AdvantageConfig,
    key: Key[Array, ""],
    cut: bool = False,
) -> tuple[Float[Array, "T N"], Value]:
    """Standardised advantages under `baseline`, and the network fitted to this batch for the next one.

    As `linear.advantages_and_value` does it with the linear baseline; `key` draws the minibatches.
    """
    rewards, mask, discount = trajectories.rewards, trajectories.mask, config.discount
    x = inputs(trajectories.states, timeless=cut)
    values = predict(baseline, x)
    after = jnp.zeros_like(values[0])
    if cut:
        after = trajectories.going_on * at_cut(baseline, trajectories.last)
    advantages = gae(rewards, values, mask, discount, config.gae_lambda, after)
    # The lambda-return: at lambda 1 what the episode earned, below it less noisy and leaning on the old value.
    targets = values + advantages
    flat = (x.reshape(-1, x.shape[-1]), targets.reshape(-1), mask.reshape(-1))
    return standardise(advantages, mask), fit(baseline, *flat, config, key)


def fit(
    value: Value,
    x: Float[Array, "n I"],
    targets: Float[Array, "n"],
    mask: Float[Array, "n"],
    config: AdvantageConfig,
    key: Key[Array, ""],
) -> Value:
    """The network after `config.value_steps` steps of Adam towards `targets` of the inputs `x`.

    Minibatches are drawn with replacement where `mask` is 1, by every device from its share of the batch. A fit
    that is not finite, or of nothing, leaves `value` as it is.
    """
    sums = jnp.cumsum(mask)
    count = sums[-1]
    total = across(count)
    # A device whose share counts fewer steps has that much less to say.
    weight = count / jnp.maximum(total, 1.0)
    fresh = _renormalised(value, x, targets, mask)
    z = (targets - fresh.target_mean) / fresh.target_std
    optimizer = _optimizer(config)
    size = -(-config.value_batch_size // sharers())

    def loss(layers: Layers, x: Float[Array, "n I"], z: Float[Array, "n"]) -> Float[Array, ""]:
        return weight * jnp.mean(jnp.square(_network(layers, _normalised(fresh, x)) - z))

    def step(carry: tuple[Layers, Any], key: Key[Array, ""]) -> tuple[tuple[Layers, Any], None]:
        layers, moments = carry
        # The r-th step that counts, r uniform: where the sums first pass r.
        index = jnp.searchsorted(sums, jax.random.uniform(key, (size,)) * count, side="right")
        rows = (jnp.take(array, index, axis=0, mode="clip") for array in (x, z))
        gradient = across(jax.grad(loss)(layers, *rows))
        change, moments = optimizer.update(gradient, moments)
        return (optax.apply_updates(layers, change), moments), None

    keys = jax.random.split(share_of(key), config.value_steps)
    (layers, moments), _ = jax.lax.scan(step, (fresh.layers, fresh.moments), keys)
    new = fresh._replace(layers=layers, moments=moments)
    sound = (total > 0) & jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(new)]))
    return jax.tree.map(lambda now, before: jnp.where(sound, now, before), new, value)


def _renormalised(value: Value, x: Float[Array, "n I"], targets: Float[Array, "n"], mask: Float[Array, "n"]) -> Value:
    """`value` in the units of this batch: the same network, so that predictions move and stretch with the targets."""
    count = jnp.maximum(across(jnp.sum(mask)), 1.0)

    def mean(rows: Float[Array, "n *rest"]) -> Float[Array, "*rest"]:
        return across(mask @ rows) / count

    # Steps that do not count may hold anything, and 0 times infinity is NaN.
    seen, aims = jnp.where(mask[:, None] > 0, x, 0.0), jnp.where(mask > 0, targets, 0.0)
    input_mean, target_mean = mean(seen), mean(aims)
    input_std = jnp.sqrt(mean(jnp.square(seen - input_mean)))
    target_std = jnp.sqrt(mean(jnp.square(aims - target_mean)))
    # Equal numbers seem to differ by float32's rounding: that is no signal to blow up.
    varies = input_std > 1e-5 * jnp.abs(input_mean)
    return value._replace(
        input_mean=input_mean,
        input_scale=jnp.where(varies, 1.0 / jnp.where(varies, input_std, 1.0), 0.0),
        target_mean=target_mean,
        target_std=jnp.maximum(target_std, 1e-4 * jnp.abs(target_mean) + 1e-8),
    )


def _normalised(value: Value, x: Float[Array, "*batch I"]) -> Float[Array, "*batch I"]:
    return jnp.clip((x - value.input_mean) * value.input_scale, -_FAR, _FAR)


def _network(layers: Layers, x: Float[Array, "*batch I"]) -> Float[Array, "*batch"]:
    *inner, (last_weights, last_biases) = layers
    for weights, biases in inner:
        x = jnp.tanh(x @ weights + biases)
    return (x @ last_weights + last_biases)[..., 0]


def _optimizer(config: AdvantageConfig) -> optax.GradientTransformation:
    return optax.adam(config.value_learning_rate)
