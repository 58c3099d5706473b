"""The mean network linearised at a batch: its Jacobian J and transpose J', for gradients and Gauss-Newton products.

Automatic differentiation gives the same products (the tests compare them) in almost twice the time, for it goes through
memory at every operation. Here the batch lies features first, in chunks whose activations stay in the cache, and J and
J' of a chunk follow each other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from metrpo.policy.gaussian import Layers
from metrpo.types import Array

CHUNK = 1000
"""Steps per chunk: 64 activations of 1,000 steps are 256 kB."""


class Linearised(NamedTuple):
    """The network at C chunks of states."""

    layers: Layers
    inputs: tuple[Float[Array, "C _in chunk"], ...]
    """Of every layer."""
    means: Float[Array, "C A chunk"]


def chunked(x: Float[Array, "n"] | Float[Array, "n F"]) -> Float[Array, "C _ chunk"]:
    """The steps in chunks of `CHUNK`, features first, padded with zeros; a short batch is one chunk of its own."""
    x = x.reshape(x.shape[0], -1)
    size = min(CHUNK, x.shape[0])
    x = jnp.pad(x, ((0, -x.shape[0] % size), (0, 0)))
    return jnp.swapaxes(x.reshape(-1, size, x.shape[1]), 1, 2)


def forward(layers: Layers, states: Float[Array, "S n"]) -> tuple[Float[Array, "_ n"], ...]:
    """Inputs of every layer and the means, of one chunk of states."""
    values = [states]
    for i, (weights, biases) in enumerate(layers):
        output = weights.T @ values[-1] + biases[:, None]
        values.append(jnp.tanh(output) if i < len(layers) - 1 else output)
    return tuple(values)


def linearise(layers: Layers, states: Float[Array, "C S chunk"]) -> Linearised:
    """The network at chunked states."""
    *inputs, means = jax.lax.map(lambda chunk: forward(layers, chunk), states)
    return Linearised(layers, tuple(inputs), means)


def pull_back(at: Linearised, outputs: Float[Array, "C A chunk"]) -> Layers:
    """J' outputs, shaped as the parameters, summed over the steps."""
    return _sum_over_chunks(at, lambda inputs, given: _backward(at.layers, inputs, given), outputs)


def gauss_newton(at: Linearised, weights: Float[Array, "C A chunk"], tangent: Layers) -> Layers:
    """J' diag(weights) J tangent, summed over the steps."""
    transposed, tangent_transposed = _transposed(at.layers), _transposed(tangent)

    def product(inputs: _Chunk, given: Float[Array, "A n"]) -> Layers:
        return _backward(at.layers, inputs, given * _tangent(transposed, inputs, tangent_transposed))

    return _sum_over_chunks(at, product, weights)


def _tangent(layers: Layers, inputs: _Chunk, tangent: Layers) -> Float[Array, "A n"]:
    """J tangent of one chunk; the weights of both come transposed, [out, in]."""
    change = jnp.float32(0)
    for i, ((weights, _), (dweights, dbiases)) in enumerate(zip(layers, tangent, strict=True)):
        through = weights @ (change * (1 - jnp.square(inputs[i]))) if i else 0.0
        change = dweights @ inputs[i] + through + dbiases[:, None]
    return change


def _transposed(layers: Layers) -> Layers:
    """Weights [out, in], written out once (the barrier), for a product that transposes as it goes is 8 % slower."""
    return jax.lax.optimization_barrier(tuple((weights.T, biases) for weights, biases in layers))


def _backward(layers: Layers, inputs: _Chunk, outputs: Float[Array, "A n"]) -> Layers:
    """J' outputs of one chunk."""
    gradients = []
    for i in reversed(range(len(layers))):
        gradients.append((inputs[i] @ outputs.T, jnp.sum(outputs, axis=1)))
        if i:
            outputs = (layers[i][0] @ outputs) * (1 - jnp.square(inputs[i]))
    return tuple(reversed(gradients))


_Chunk = tuple[Float[Array, "_ n"], ...]
"""Of one chunk, the inputs of every layer."""


def _sum_over_chunks(
    at: Linearised, term: Callable[[_Chunk, Float[Array, "A n"]], Layers], given: Float[Array, "C A n"]
) -> Layers:
    def add(total: Layers, chunk: tuple[_Chunk, Float[Array, "A n"]]) -> tuple[Layers, None]:
        return jax.tree.map(jnp.add, total, term(*chunk)), None

    return jax.lax.scan(add, jax.tree.map(jnp.zeros_like, at.layers), (at.inputs, given))[0]
