"""Sharing a batch among JAX's devices: GPUs, or the several that a CPU with several cores is divided into.

`spread` makes a function one of every device's share. What it calls sees the shares by `across` and its neighbours,
which need no word of the devices: outside of `spread` there is one share, the whole.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "devices"
WHOLE, FIRST, SECOND = PartitionSpec(), PartitionSpec(AXIS), PartitionSpec(None, AXIS)
"""Every device has the whole of an array, or a piece along its first or its second axis."""


def mesh(count: int) -> Mesh:
    """The devices that share `count` equal things: as many as there are and divide `count`."""
    devices = jax.devices()
    size = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    return Mesh(np.array(devices[:size]), (AXIS,))


def shared(x: Any, mesh: Mesh) -> Any:
    """The arrays of `x`, cut along their first axis into one piece for every device of `mesh`."""
    whole, cut = NamedSharding(mesh, WHOLE), NamedSharding(mesh, FIRST)
    return jax.tree.map(lambda a: jax.device_put(a, cut if np.ndim(a) else whole), x)


def copied(x: Any, mesh: Mesh) -> Any:
    """The arrays of `x`, whole on every device of `mesh`."""
    return jax.device_put(x, NamedSharding(mesh, WHOLE))


def spread(function: Callable[..., Any], mesh: Mesh, in_specs: Any, out_specs: Any) -> Callable[..., Any]:
    """`function`, called on every device of `mesh` with its share of the arguments; specs are those above."""
    return jax.shard_map(function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def is_spread() -> bool:
    """Whether this is traced inside `spread`."""
    try:
        jax.lax.axis_size(AXIS)
    except NameError:  # JAX knows no such axis here
        return False
    return True


def sharers() -> int:
    """The devices that share the batch; 1 outside of `spread`."""
    return jax.lax.axis_size(AXIS) if is_spread() else 1


def across(x: Any) -> Any:
    """A sum over this device's share of a batch made the sum over all shares."""
    return jax.lax.psum(x, AXIS) if is_spread() else x


def share_of(key: Any) -> Any:
    """A random key of this device's own; outside of `spread` the key as it is."""
    return jax.random.fold_in(key, jax.lax.axis_index(AXIS)) if is_spread() else key


def part_of(x: Any, dimension: int) -> Any:
    """This device's part, along `dimension`, of the array `x`, which every device has whole."""
    size = x.shape[dimension] // jax.lax.axis_size(AXIS)
    return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(AXIS) * size, size, dimension)
