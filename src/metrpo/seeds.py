"""Where all randomness comes from: (seed, iteration, stage), so that a run resumed at an iteration is the same run."""

from __future__ import annotations

from enum import IntEnum

import jax
import numpy as np

from metrpo.types import Array


class Stage(IntEnum):
    """What the randomness is for."""

    INIT, COLLECT, FIT, IMPROVE, EVALUATE, SPLIT, RESET, DIAGNOSE, ORACLE, PROVE = range(10)


def key_of(seed: int, iteration: int, stage: Stage) -> Array:
    """A JAX key for a stage of an outer iteration."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), iteration), int(stage))


def rng_of(seed: int, iteration: int, stage: Stage, number: int = 0) -> np.random.Generator:
    """A NumPy generator for a stage of an outer iteration, or for the `number`-th thing that is done in it."""
    return np.random.default_rng([seed, iteration, int(stage), number])
