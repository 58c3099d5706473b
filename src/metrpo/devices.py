"""Sharing a batch among JAX's devices: GPUs, or the several that a CPU with several cores is divided into."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def mesh(count: int, axis: str) -> Mesh:
    """The devices that share `count` equal things along `axis`: as many as there are and divide `count`."""
    devices = jax.devices()
    size = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    return Mesh(np.array(devices[:size]), (axis,))


def shared(x: Any, mesh: Mesh) -> Any:
    """The arrays of `x`, cut along their first axis into one piece for every device of `mesh`."""
    whole, cut = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))
    return jax.tree.map(lambda a: jax.device_put(a, cut if np.ndim(a) else whole), x)


def copied(x: Any, mesh: Mesh) -> Any:
    """The arrays of `x`, whole on every device of `mesh`."""
    return jax.device_put(x, NamedSharding(mesh, PartitionSpec()))


def across(x: Any, axis: str | None) -> Any:
    """A sum over this device's share of a batch made the sum over all shares; as it is without an `axis`."""
    return x if axis is None else jax.lax.psum(x, axis)


def share_of(key: Any, axis: str | None) -> Any:
    """A random key of this device's own; the key as it is without an `axis`."""
    return key if axis is None else jax.random.fold_in(key, jax.lax.axis_index(axis))


def part_of(x: Any, axis: str, dimension: int) -> Any:
    """This device's part, along `dimension`, of the array `x`, which every device has whole."""
    size = x.shape[dimension] // jax.lax.axis_size(axis)
    return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(axis) * size, size, dimension)
