"""How far a learned end of episode can be trusted: the models' probabilities against held-out real ends."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from metrpo.model.ensemble import Ensemble, predict
from metrpo.types import Array, Transitions

_BINS = 10
_MOST = 10_000
"""Transitions looked at, the newest: enough for a share, and a fixed shape for compiled code."""


class Calibration(NamedTuple):
    """What the models' probabilities of an end are worth, each model by itself, on n real transitions."""

    share: float
    """Share of the transitions that ended an episode."""
    recall: float
    """Share of these that a model sees: probability above one half, where imagination ends. NaN without any."""
    false_alarms: float
    """Share of the transitions without an end where a model sees one."""
    error: float
    """Expected calibration error: |mean probability - share of ends| in ten bins of probability, weighted by their
    number (Naeini et al. 2015)."""


def calibration(probabilities: Float[np.ndarray, "K n"], ended: Bool[np.ndarray, "n"]) -> Calibration:
    """Of each model's probabilities, taken into [0, 1], for what `ended`."""
    p, real = np.clip(probabilities, 0.0, 1.0), np.broadcast_to(ended, probabilities.shape)
    seen, bins = p > 0.5, np.minimum((_BINS * p).astype(int), _BINS - 1)
    error = sum(abs(np.sum(p[bins == b]) - np.sum(real[bins == b])) for b in range(_BINS)) / p.size
    mean = partial(np.mean, dtype=np.float64)
    return Calibration(
        share=float(mean(ended)),
        recall=float(mean(seen[real])) if ended.any() else float("nan"),
        false_alarms=float(mean(seen[~real])) if not ended.all() else float("nan"),
        error=float(error),
    )


def end_calibration(ensemble: Ensemble, held_out: Transitions) -> Calibration:
    """Of the ensemble's last output, the learned end, on the newest of the `held_out` transitions (host arrays)."""
    count = min(len(held_out.states), _MOST)

    def padded(rows: Float[Array, "n F"]) -> Float[np.ndarray, "most F"]:
        out = np.zeros((_MOST, rows.shape[1]), np.float32)
        out[:count] = rows[-count:]
        return out

    probabilities = np.asarray(_ends(ensemble, padded(held_out.states), padded(held_out.actions)))
    return calibration(probabilities[:, :count], np.asarray(held_out.deltas)[-count:, -1] > 0.5)


@jax.jit
def _ends(ensemble: Ensemble, states: Float[Array, "n S"], actions: Float[Array, "n A"]) -> Float[Array, "K n"]:
    members = len(ensemble.networks[0][0])
    copies = [jnp.broadcast_to(x, (members, *x.shape)) for x in (states, actions)]
    return predict(ensemble, *copies)[..., -1]
