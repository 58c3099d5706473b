"""K dynamics networks as one pytree: state and action in, next state out (paper, sections 4.1 and 5).

The networks are stacked along a leading axis K and evaluated by one batched product per layer. A library's module
would have to be vmapped to the same products, so the forty lines are written out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Float, Int, Key

from metrpo.history import runs
from metrpo.types import Array, Normaliser, Transitions

Networks = tuple[tuple[Float[Array, "K _in _out"], Float[Array, "K 1 _out"]], ...]
"""One (weights, biases) a layer."""


LOG_SPREAD = (-7.0, 1.0)
"""Bounds of the log of a probabilistic member's spread, in standard deviations of a change."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class Carried:
    """What of the next state nobody predicts, for it stands in state and action already: a pytree without arrays."""

    indices: tuple[int, ...] = ()
    """[S - O], within state and action, [S + A]; the next state's last numbers in order (`History.carried`)."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class Activation:
    """What hidden units do: a pytree without arrays."""

    name: Literal["relu", "silu"] = "relu"

    def __call__(self, x: Float[Array, "K B I"]) -> Float[Array, "K B I"]:
        """Of what reaches them."""
        return jax.nn.silu(x) if self.name == "silu" else jax.nn.relu(x)


RELU = Activation()
"""The paper's (appendix A.1.2)."""


class Ensemble(NamedTuple):
    """K networks and the normaliser that they share."""

    networks: Networks
    normaliser: Normaliser
    carried: Carried = Carried()
    activation: Activation = RELU

    @property
    def members(self) -> int:
        """K."""
        return int(self.networks[0][0].shape[0])

    def outputs(self, x: Float[Array, "K B I"]) -> Float[Array, "K B E"]:
        """What the networks say, each member to its own batch."""
        return network_outputs(self.networks, x, self.activation, self.normaliser.delta_std.shape[-1])

    def first(self) -> Ensemble:
        """The first member as an ensemble of one."""
        return self._replace(networks=tuple((weights[:1], biases[:1]) for weights, biases in self.networks))


def init(
    key: Key[Array, ""],
    members: int,
    state_size: int,
    action_size: int,
    hidden: tuple[int, ...],
    predicted: int | None = None,
    probabilistic: bool = False,
) -> Networks:
    """Fresh networks: Xavier-uniform weights, zero biases. Member k depends on `key` and k alone, not on K.

    They have as many outputs as numbers are `predicted`, by default those of the state; `probabilistic` ones twice as
    many, for the log of each number's spread.
    """
    sizes = (state_size + action_size, *hidden, (predicted or state_size) * (2 if probabilistic else 1))

    def one(k: Int[Array, ""]) -> tuple[tuple[Float[Array, "_in _out"], Float[Array, "1 _out"]], ...]:
        keys = jax.random.split(jax.random.fold_in(key, k), len(sizes) - 1)
        xavier = jax.nn.initializers.glorot_uniform()
        return tuple(
            (xavier(layer_key, (fan_in, fan_out)), jnp.zeros((1, fan_out)))
            for layer_key, fan_in, fan_out in zip(keys, sizes[:-1], sizes[1:], strict=True)
        )

    return jax.vmap(one)(jnp.arange(members))


def normaliser_of(
    train: Transitions, std_floor: float, delta_std_floor: float, unseen: tuple[int, ...] = ()
) -> Normaliser:
    """Means and standard deviations of training data (host arrays); never of validation data.

    `unseen` state dimensions get scale 0, so that the networks cannot see them.
    """

    # In NumPy, for JAX would compile every operation again for every size of the data.
    def mean(x: Float[Array, "n F"]) -> Float[Array, "F"]:
        return jnp.asarray(np.mean(np.asarray(x), axis=0, dtype=np.float64), jnp.float32)

    def std(x: Float[Array, "n F"], floor: float = std_floor) -> Float[np.ndarray, "F"]:
        return np.maximum(np.std(np.asarray(x), axis=0, dtype=np.float64), floor)

    # What does not vary, to float32's precision, has nothing to tell: a tiny divisor would only blow up rounding.
    constant = std(train.states, 0.0) <= 1e-6 * np.abs(np.mean(np.asarray(train.states), axis=0, dtype=np.float64))
    state_scale = np.where(constant, 0.0, 1 / std(train.states))
    state_scale[list(unseen)] = 0.0
    return Normaliser(
        state_mean=mean(train.states),
        state_scale=jnp.asarray(state_scale, jnp.float32),
        action_mean=mean(train.actions),
        action_scale=jnp.asarray(1 / std(train.actions), jnp.float32),
        delta_mean=mean(train.deltas),
        delta_std=jnp.asarray(std(train.deltas, delta_std_floor), jnp.float32),
    )


@runtime_checkable
class Predictor(Protocol):
    """What `predict` needs: an `Ensemble`, or one device's share of it (`metrpo.model.model_parallel`)."""

    @property
    def members(self) -> int:
        """K."""

    @property
    def normaliser(self) -> Normaliser:
        """Shared by the members."""

    @property
    def carried(self) -> Carried:
        """What of the next state they need not predict."""

    def outputs(self, x: Float[Array, "K B I"]) -> Float[Array, "K B E"]:
        """What the networks say, each member to its own batch."""

    def first(self) -> Predictor:
        """The first member as an ensemble of one."""


def predict(
    ensemble: Predictor,
    states: Float[Array, "K B S"],
    actions: Float[Array, "K B A"],
    key: Key[Array, ""] | None = None,
) -> Float[Array, "K B P"]:
    """Next states and what else is learned, each member for its own batch; by `key`, with noise (`predict_delta`)."""
    return with_carried(ensemble, states, actions, predict_changing(ensemble, states, actions, key))


def predict_changing(
    ensemble: Predictor,
    states: Float[Array, "K B S"],
    actions: Float[Array, "K B A"],
    key: Key[Array, ""] | None = None,
) -> Float[Array, "K B D"]:
    """As `predict`, without what is carried over."""
    deltas = predict_delta(ensemble, states, actions, key)
    size = states.shape[-1] - len(ensemble.carried.indices)
    seen = states[..., :size]
    if deltas.shape[-1] == size:
        return seen + deltas
    return jnp.concatenate([seen + deltas[..., :size], deltas[..., size:]], axis=-1)


def with_carried(
    ensemble: Predictor,
    states: Float[Array, "*batch S"],
    actions: Float[Array, "*batch A"],
    changing: Float[Array, "*batch D"],
) -> Float[Array, "*batch P"]:
    """Next states and what else is learned, out of what models predict of them and what they leave as it was."""
    indices = ensemble.carried.indices
    if not indices:
        return changing
    size, now = states.shape[-1] - len(indices), jnp.concatenate([states, actions], axis=-1)
    rest = [now[..., part] for part in runs(indices)]
    return jnp.concatenate([changing[..., :size], *rest, changing[..., size:]], axis=-1)


def predict_delta(
    ensemble: Predictor,
    states: Float[Array, "K B S"],
    actions: Float[Array, "K B A"],
    key: Key[Array, ""] | None = None,
) -> Float[Array, "K B D"]:
    """Changes of state, without what is carried over, and what else is learned, each member for its own batch.

    Of probabilistic members a draw where there is a `key`, else the mean.
    """
    n, (means, log_spread) = ensemble.normaliser, mean_and_spread(ensemble, states, actions)
    if key is not None and log_spread is not None:
        means = means + jnp.exp(jax.lax.stop_gradient(log_spread)) * jax.random.normal(key, means.shape)
    return n.delta_mean + n.delta_std * means


def mean_and_spread(
    ensemble: Predictor, states: Float[Array, "K B S"], actions: Float[Array, "K B A"]
) -> tuple[Float[Array, "K B D"], Float[Array, "K B D"] | None]:
    """What members expect, and the log of the spread around it (None: not probabilistic), in the normaliser's units."""
    n = ensemble.normaliser
    inputs = jnp.concatenate(
        [(states - n.state_mean) * n.state_scale, (actions - n.action_mean) * n.action_scale], axis=-1
    )
    said, size = ensemble.outputs(inputs), n.delta_std.shape[-1]
    if said.shape[-1] == size:
        return said, None
    return said[..., :size], said[..., size:].clip(*LOG_SPREAD)


def network_outputs(
    networks: Networks, x: Float[Array, "K B I"], activation: Activation = RELU, means: int | None = None
) -> Float[Array, "K B E"]:
    """What the networks say, each member to its own batch.

    The outputs after the first `means` (None: all) teach their own weights alone, not the layers before these.
    """
    *inner, (weights, biases) = networks
    for w, b in inner:
        x = activation(layer_outputs(x, w, b))
    if means in (None, biases.shape[-1]):
        return layer_outputs(x, weights, biases)
    expected = layer_outputs(x, weights[..., :means], biases[..., :means])
    spread = layer_outputs(jax.lax.stop_gradient(x), weights[..., means:], biases[..., means:])
    return jnp.concatenate([expected, spread], axis=-1)


def layer_outputs(
    x: Float[Array, "K B I"], weights: Float[Array, "K I O"], biases: Float[Array, "K 1 O"]
) -> Float[Array, "K B O"]:
    """Before the nonlinearity, each member for its own batch."""
    return _product(x, weights) + biases


def with_products(networks: Networks, dtype: str) -> Networks:
    """The networks with weights of `dtype`, in which their matrix products are then taken; sums stay float32."""
    return tuple((weights.astype(dtype), biases) for weights, biases in networks)


@jax.custom_vjp
def _product(x: Float[Array, "K B I"], weights: Float[Array, "K I O"]) -> Float[Array, "K B O"]:
    """In float32; of bfloat16 operands where the weights are bfloat16."""
    return _forward(x, weights)[0]


def _forward(
    x: Float[Array, "K B I"], weights: Float[Array, "K I O"]
) -> tuple[Float[Array, "K B O"], tuple[Float[Array, "K B I"], Float[Array, "K I O"]]]:
    if weights.dtype != jnp.bfloat16:
        return jnp.einsum("kbi,kio->kbo", x, weights), (x, weights)
    x = x.astype(jnp.bfloat16)
    return _member_by_member(x, weights), (x, weights)


def _backward(
    saved: tuple[Float[Array, "K B I"], Float[Array, "K I O"]], gradient: Float[Array, "K B O"]
) -> tuple[Float[Array, "K B I"], Float[Array, "K I O"]]:
    x, weights = saved
    if weights.dtype != jnp.bfloat16:
        # JAX's own rule takes g' x and turns it round afterwards; Adam then reads it across its rows, twice.
        return jnp.einsum("kbo,kio->kbi", gradient, weights), jnp.einsum("kbi,kbo->kio", x, gradient)
    gradient = gradient.astype(jnp.bfloat16)
    # On CPUs x' g takes twice as long unless x' lies in memory as its shape says.
    transposed = jnp.swapaxes(x, 1, 2)
    transposed = with_layout_constraint(transposed, Layout(major_to_minor=(0, 1, 2)))
    to_x = _member_by_member(gradient, jnp.swapaxes(weights, 1, 2))
    return to_x, _member_by_member(transposed, gradient).astype(weights.dtype)


_product.defvjp(_forward, _backward)


def _member_by_member(a: Float[Array, "K M N"], b: Float[Array, "K N P"]) -> Float[Array, "K M P"]:
    """In float32; faster than one batched product in bfloat16."""
    pairs = zip(a, b, strict=True)
    return jnp.stack([jnp.matmul(x, y, preferred_element_type=jnp.float32) for x, y in pairs])
