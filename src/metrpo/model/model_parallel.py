"""An ensemble whose members are shared out among the cores of a CPU, each a JAX device (see `metrpo.devices`).

Worth it where an ensemble has more weights than a core's cache and few states for each member: every core then reads
its share of the weights, not all, and predicts for the states of all. (The paper suggests members in parallel for the
fit, appendix "Real-time complexity".)
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from metrpo.devices import AXIS, part_of
from metrpo.model.ensemble import RELU, Activation, Carried, Ensemble, Networks, layer_outputs, network_outputs
from metrpo.types import Array, Normaliser

_UNITS, _INPUTS = 2, 1
"""Dimensions of a layer's weights [K, in, out]."""


class SharedEnsemble(NamedTuple):
    """One device's share of an ensemble. It stands for the `Ensemble` in `predict` and `predict_delta`.

    Every device asks for predictions of states of its own, as many as the others, and gets these.
    """

    own: Networks
    """This device's members: K // devices."""
    cut: Networks
    """The members that remain; of every second hidden layer, this device's units."""
    normaliser: Normaliser
    carried: Carried = Carried()
    activation: Activation = RELU

    @property
    def members(self) -> int:
        """K."""
        own, remaining = (len(networks[0][0]) for networks in (self.own, self.cut))
        return own * jax.lax.axis_size(AXIS) + remaining

    def outputs(self, x: Float[Array, "K B I"]) -> Float[Array, "K B E"]:
        """What the networks say, each member to its own batch, of this device's states."""
        own, remaining = (len(networks[0][0]) for networks in (self.own, self.cut))
        x = jax.lax.all_gather(x, AXIS, axis=1, tiled=True)
        outputs = jnp.zeros((*x.shape[:2], self.own[-1][1].shape[-1]))
        if own:
            first = own * jax.lax.axis_index(AXIS)
            mine = network_outputs(self.own, jax.lax.dynamic_slice_in_dim(x, first, own), self.activation)
            outputs = jax.lax.dynamic_update_slice_in_dim(outputs, mine, first, 0)
        if remaining:
            outputs = outputs.at[-remaining:].set(self._summands(x[-remaining:]))
        return jax.lax.psum_scatter(outputs, AXIS, scatter_dimension=1, tiled=True)

    def first(self) -> Ensemble:
        """No device has one member by itself: samplings that ask for it are not shared (`Sampling.of_drawn_models`)."""
        raise NotImplementedError("expected a sampling that draws a model for each state, got one of the first member")

    def _summands(self, x: Float[Array, "K B I"]) -> Float[Array, "K B E"]:
        """This device's part of the remaining members' outputs, which are the sums of the parts."""
        for layer, (weights, biases) in enumerate(self.cut):
            if layer > 0:
                if _cut_along(layer - 1, self.cut) == _INPUTS:
                    x = jax.lax.psum(x, AXIS)
                x = self.activation(x)
            x = layer_outputs(x, weights, biases)
        return x


def can_share(networks: Networks, devices: int) -> bool:
    """Whether `devices` devices can share the networks: there is a hidden layer, and its units can be divided."""
    hidden = [biases.shape[-1] for _, biases in networks[:-1]]
    return len(hidden) > 0 and all(size % devices == 0 for size in hidden)


def shared(ensemble: Ensemble) -> SharedEnsemble:
    """This device's share of `ensemble`, inside `devices.spread`, where `can_share`."""
    devices, this = jax.lax.axis_size(AXIS), jax.lax.axis_index(AXIS)
    own = ensemble.members // devices
    cut = []
    for layer, (weights, biases) in enumerate(ensemble.networks):
        weights, biases = weights[own * devices :], biases[own * devices :]
        along = _cut_along(layer, ensemble.networks)
        if along is not None:
            weights = part_of(weights, along)
            # Where products are summed across devices, the biases come from one.
            biases = part_of(biases, _UNITS) if along == _UNITS else jnp.where(this == 0, biases, 0.0)
        cut.append((weights, biases))
    mine = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, this * own, own), ensemble.networks)
    return SharedEnsemble(mine, tuple(cut), ensemble.normaliser, ensemble.carried, ensemble.activation)


def _cut_along(layer: int, networks: Networks) -> int | None:
    """Layers are cut in pairs, from the last: its inputs, and the units of the one before it. A sum ends each pair."""
    from_last = len(networks) - 1 - layer
    if from_last % 2:
        return _UNITS
    return _INPUTS if layer > 0 else None
