"""What the policy sees: states normalised by the dataset, so that no unit of an observation saturates a network.

A policy phase works on normalised states. Outside of it a policy acts on raw states: the normalisation is affine, so it
is folded into the first layer, and every stored or exported policy is a plain network.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from metrpo.policy.gaussian import Policy
from metrpo.types import Array


class Inputs(NamedTuple):
    """Shift and scale of a policy's inputs: it sees (state - shift) * scale."""

    shift: Float32[Array, "S"]
    scale: Float32[Array, "S"]
    """0 where the policy may not see a dimension."""


def inputs_of(states: Float[Array, "n S"], unseen: tuple[int, ...] = ()) -> Inputs:
    """The normalisation that gives `states` mean 0 and standard deviation 1; `unseen` dimensions get scale 0.

    A dimension that does not vary is only shifted: differences below float32's resolution are no signal.
    """
    mean, std = (f(np.asarray(states), axis=0, dtype=np.float64) for f in (np.mean, np.std))
    varies = std > 1e-6 * np.abs(mean)
    scale = 1.0 / np.where(varies & (std > 0), std, 1.0)
    scale[list(unseen)] = 0.0
    return Inputs(mean.astype(np.float32), scale.astype(np.float32))


def normalised(inputs: Inputs | None, states: Float[Array, "*batch S"]) -> Float[Array, "*batch S"]:
    """What the policy sees of raw `states`; None: the states themselves."""
    return states if inputs is None else (states - inputs.shift) * inputs.scale


def folded(policy: Policy, inputs: Inputs) -> Policy:
    """The policy of normalised states as one of raw states; host arrays."""
    (weights, biases), *rest = _host(policy)
    shift, scale = (np.asarray(x, np.float64) for x in inputs)
    raw = weights * scale[:, None]
    first = raw.astype(np.float32), (biases - shift @ raw).astype(np.float32)
    return policy._replace(layers=(first, *rest))


def unfolded(policy: Policy, inputs: Inputs) -> Policy:
    """The policy of raw states as one of normalised states: the same function; host arrays.

    What it may not see it does not see afterwards: the weights of these dimensions become 0.
    """
    (weights, biases), *rest = _host(policy)
    shift, scale = (np.asarray(x, np.float64) for x in inputs)
    seen = np.where(scale[:, None] > 0, weights, 0.0)
    new = seen / np.where(scale > 0, scale, 1.0)[:, None]
    first = new.astype(np.float32), (biases + shift @ seen).astype(np.float32)
    return policy._replace(layers=(first, *rest))


def _host(policy: Policy) -> list[tuple[Float[np.ndarray, "_in _out"], Float[np.ndarray, "_out"]]]:
    (weights, biases), *rest = policy.layers
    first = np.asarray(weights, np.float64), np.asarray(biases, np.float64)
    return [first, *((np.asarray(w), np.asarray(b)) for w, b in rest)]
