"""Dimensions of the observation that cannot be learned from as they are, by name: too coarse, too far, too small."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from metrpo.config import Config
from metrpo.model.imagine import EXPLODED
from metrpo.types import Episode
from metrpo.world.dataset import Dataset
from metrpo.world.task import Task

_log = logging.getLogger("metrpo")
COARSE = 0.01
"""Of a typical change in one step: where numbers lie further apart than this, such a change is lost in rounding."""
FAR, SMALL, LARGE = 100.0, 1e-2, 1e3
"""What a policy without normalised states can cope with: |mean| / std up to the first, std between the others."""
_NAMED = 5
"""Dimensions named in one warning."""
_ROWS = 5000
"""States looked at, the newest."""


class Found(NamedTuple):
    """What is wrong with some dimensions, and what to do."""

    dimensions: tuple[int, ...]
    why: str
    advice: str


def warn(config: Config, task: Task, dataset: Dataset, episodes: list[Episode]) -> None:
    """Says which dimensions cannot be learned from as they are."""
    for found in findings(config, task, dataset, episodes):
        names = ", ".join(named(task, d) for d in found.dimensions[:_NAMED])
        more = len(found.dimensions) - _NAMED
        names += f" and {more} more" if more > 0 else ""
        _log.warning("%s: observed %s: %s; %s", task.name, names, found.why, found.advice)


def count(config: Config, task: Task, dataset: Dataset, episodes: list[Episode]) -> int:
    """How many dimensions cannot be learned from as they are: a number for the record."""
    return len({d for found in findings(config, task, dataset, episodes) for d in found.dimensions})


def named(task: Task, dimension: int) -> str:
    """A dimension by its number, and by its name where the observation has named parts."""
    parts = task.interface.observation if task.interface else ()
    first = 0
    for size, text in parts:
        if dimension < first + size and len(parts) > 1:
            return f"dimension {dimension} (number {dimension - first} of {text})"
        first += size
    return f"dimension {dimension}"


def findings(config: Config, task: Task, dataset: Dataset, episodes: list[Episode]) -> list[Found]:
    """What there is to say about the training data and the `episodes` that they are from, if these are at hand.

    Of a state with a history about its newest observation: the others are its copies.
    """
    newest = task.layout.newest
    states = newest(dataset.train.states[-_ROWS:]).astype(np.float64)
    if not len(states):
        return []
    observed = [newest(e.states) for e in episodes]
    change = _change(dataset, observed, states.shape[1])
    checks = (_coarse(states, change), _rounded(newest(dataset.origin), observed, change), _exploded(states))
    unnormalised = () if config.policy.normalise else (_far_from_1(states, task), _hidden(config, states, task))
    return [found for found in (*checks, *unnormalised) if found.dimensions]


def _change(dataset: Dataset, observed: list[np.ndarray], size: int) -> np.ndarray:
    """[O], root mean square of the changes in one step; 0 where nothing changes."""
    kept = dataset.train.deltas[-_ROWS:, :size].astype(np.float64)
    changes = [np.diff(x.astype(np.float64), axis=0) for x in observed] or [kept]
    return np.sqrt(np.mean(np.square(np.concatenate(changes)), axis=0))


def _apart(largest: np.ndarray) -> np.ndarray:
    """How far apart float32's numbers lie around `largest` [S]."""
    return np.spacing(largest.astype(np.float32)).astype(np.float64)


def _coarse(states: np.ndarray, change: np.ndarray) -> Found:
    apart = _apart(np.abs(states).max(axis=0))
    dimensions = _where((change > 0) & (apart > COARSE * change))
    return Found(
        dimensions,
        f"float32 cannot tell one step's states apart: its numbers lie {_most(apart, dimensions)} apart there, a step "
        f"changes them by {_most(change, dimensions)}",
        "observe differences from something near, or leave them out",
    )


def _rounded(origin: np.ndarray, observed: list[np.ndarray], change: np.ndarray) -> Found:
    """Where there is an origin, but what was observed came in float32: the digits were lost before."""
    exact = np.concatenate(observed or [origin[None]])
    apart = _apart(np.abs(exact).max(axis=0))
    in_float32 = np.all(exact == exact.astype(np.float32), axis=0)
    dimensions = _where((origin != 0) & in_float32 & (change > 0) & (apart > COARSE * change))
    return Found(
        dimensions,
        f"the environment gives float32, whose numbers lie {_most(apart, dimensions)} apart there; a step changes them "
        f"by {_most(change, dimensions)}",
        "give them in float64 (the space too), or take the offset off in the environment",
    )


def _exploded(states: np.ndarray) -> Found:
    largest = np.abs(states).max(axis=0)
    dimensions = _where(largest > EXPLODED / 10)
    return Found(
        dimensions,
        f"values up to {_most(largest, dimensions)}, and imagined states beyond {EXPLODED:g} count as diverged",
        "observe them in a larger unit (gymnasium.wrappers.TransformObservation)",
    )


def _far_from_1(states: np.ndarray, task: Task) -> Found:
    mean, std = states.mean(axis=0), states.std(axis=0)
    varies = std > 1e-6 * np.abs(mean)
    far = varies & ((np.abs(mean) > FAR * std) | (std < SMALL) | (std > LARGE))
    dimensions = tuple(d for d in _where(far) if d not in task.unseen)
    numbers = ", ".join(f"{mean[d]:.3g} +- {std[d]:.3g}" for d in dimensions[:_NAMED])
    return Found(dimensions, f"far from 0 +- 1 ({numbers}), and the policy sees them so", "set policy.normalise")


def _hidden(config: Config, states: np.ndarray, task: Task) -> Found:
    std, floor = states.std(axis=0), config.ensemble.std_floor
    hidden = (std > 1e-6 * np.abs(states.mean(axis=0))) & (std < floor / FAR)
    return Found(
        tuple(d for d in _where(hidden) if d not in task.unseen),
        f"they vary by less than a hundredth of ensemble.std_floor ({floor:g}), so that models hardly see them",
        "set ensemble.std_floor and ensemble.delta_std_floor lower (1e-8 in the preset fast)",
    )


def _where(condition: np.ndarray) -> tuple[int, ...]:
    return tuple(int(d) for d in np.flatnonzero(condition))


def _most(values: np.ndarray, dimensions: tuple[int, ...]) -> str:
    return f"{max((float(values[d]) for d in dimensions), default=0.0):.3g}"
