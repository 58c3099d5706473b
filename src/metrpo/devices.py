"""Sharing a batch among JAX's devices: GPUs, or the several that a CPU with several cores is divided into."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
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


def by_first(work: Callable[[Any], Any], share: Any, axis: str) -> Any:
    """`work` on the whole batch by the first device alone; the others wait, and have zeros where it has results.

    The devices of a CPU have one pool of threads: the first then works with every core. `share` is this device's part
    of the batch, along the first axis.
    """
    batch = jax.lax.all_gather(share, axis, tiled=True)

    def wait(batch: Any) -> Any:
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(work, batch))

    return jax.lax.cond(jax.lax.axis_index(axis) == 0, work, wait, batch)


def dealt(x: Any, axis: str, dimension: int) -> Any:
    """Every device's part, along `dimension`, of the arrays of `x` that the first device has (see `by_first`)."""
    return jax.lax.psum_scatter(x, axis, scatter_dimension=dimension, tiled=True)
