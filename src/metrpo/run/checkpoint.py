"""Checkpoints: a pytree of arrays and plain numbers, written atomically, checked when read, and free of pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from metrpo.errors import RunDirectoryError
from metrpo.run.files import metrpo_version, read_arrays, write_arrays
from metrpo.safe_load import brief

Tree = TypeVar("Tree")
_LATER = (".dataset.origin", ".proven")
"""Leaves, or what holds them, that files of earlier versions lack: the template's stand in. Their shapes are the
template's, always."""


def save_state(path: Path, state: Any, meta: Mapping[str, Any]) -> None:
    """Writes a pytree of arrays, ints, floats and bools together with JSON-able `meta`.

    Raises `RunDirectoryError` when the file cannot be written, `TypeError` for leaves that only pickle could hold.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(state)}
    write_arrays(path, arrays, meta)


def load_state(path: Path, template: Tree) -> tuple[Tree, dict[str, Any]]:
    """The pytree and the `meta` that `save_state` wrote.

    `template` gives the structure, kinds and dtypes: NumPy leaves come back as NumPy arrays, JAX leaves as JAX arrays,
    plain numbers as plain numbers. Shapes are the template's but for the first axis of NumPy arrays, which is the
    file's own: a dataset may have grown.

    Raises `DamagedFile` when the file is truncated or edited, `RunDirectoryError` when it is of another format or
    holds another structure.
    """
    arrays, meta = read_arrays(path)
    expected = dict(_named_leaves(template))
    arrays = {n: np.asarray(leaf) for n, leaf in expected.items() if n.startswith(_LATER)} | arrays
    wrong = [f"lacks {n}" for n in expected if n not in arrays]
    wrong += [f"has unknown {n}" for n in arrays if n not in expected]
    wrong += [w for n, leaf in expected.items() if n in arrays and (w := _mismatch(n, leaf, arrays[n]))]
    if wrong:
        resized = not any(_is_other(n, leaf, arrays) for n, leaf in expected.items()) and len(arrays) == len(expected)
        raise RunDirectoryError(f"{path} does not fit this run: {_advice(wrong, resized, meta.get('metrpo'))}")
    leaves = [_like(leaf, arrays[name]) for name, leaf in expected.items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves), meta


def _is_other(name: str, leaf: Any, arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the file lacks `name`, or has it as something that is not only of another size."""
    return name not in arrays or _kind(leaf) != (arrays[name].dtype, arrays[name].ndim)


def _advice(wrong: list[str], resized: bool, writer: Any) -> str:
    more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
    said = f"it {'; it '.join(wrong[:3])}{more}"
    if resized:
        return (
            f"{said}. The size of the task's observations or actions has changed: restore it, "
            "or choose another directory (--run-dir)"
        )
    if writer == metrpo_version():
        return f"{said}; choose another directory (--run-dir)"
    return f"{said}. It was written by metrpo {brief(writer)}: use that version, or another directory (--run-dir)"


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path) or "state", leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]


def _mismatch(name: str, leaf: Any, array: np.ndarray) -> str:
    kind, rank = _kind(leaf)
    if (kind, rank) != (array.dtype, array.ndim):
        return f"has {name} as {array.dtype} of rank {array.ndim} instead of {kind} of rank {rank}"
    grows = isinstance(leaf, np.ndarray) and not name.startswith(_LATER)
    expected = np.shape(leaf)
    if expected[grows:] != array.shape[grows:]:
        return f"has {name} of shape {list(array.shape)} instead of {['n', *expected[1:]] if grows else list(expected)}"
    return ""


def _kind(leaf: Any) -> tuple[Any, int]:
    return (leaf.dtype, leaf.ndim) if hasattr(leaf, "dtype") else (np.asarray(leaf).dtype, 0)


def _like(leaf: Any, array: np.ndarray) -> Any:
    if isinstance(leaf, int | float):
        return type(leaf)(array.item())
    if isinstance(leaf, np.generic):
        return array[()]
    return array if isinstance(leaf, np.ndarray) else jnp.asarray(array)
