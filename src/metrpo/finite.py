"""What is learned stays finite: the check before anything is saved, and errors that say where a run stands."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np

from metrpo.errors import DivergedError, TaskError


def require_finite(stage: str, iteration: int, advice: str, **parts: Any) -> None:
    """Raises `DivergedError`, with stage, iteration and array, where a pytree of `parts` holds NaN or infinity."""
    for name, part in parts.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            array = np.asarray(leaf)
            if array.dtype.kind != "f" or np.isfinite(array).all():
                continue
            at = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise DivergedError(
                f"{stage}, iteration {iteration}: {name}{jax.tree_util.keystr(path)}: expected finite numbers, "
                f"got {array[at]} at {list(at)}; {advice}"
            )


@contextmanager
def naming(stage: str, iteration: int) -> Iterator[None]:
    """What goes wrong in the real environment within this block says in which stage and iteration it did."""
    try:
        yield
    except (TaskError, DivergedError) as error:
        raise type(error)(f"{stage}, iteration {iteration}: {error}") from error
