"""The dataset of real transitions: training and validation sets split by whole episodes, oldest out first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from metrpo.config import CollectConfig
from metrpo.types import Episode, Transitions


class Dataset(NamedTuple):
    """All real data that learning sees; host arrays, a pytree."""

    train: Transitions
    validation: Transitions
    starts: np.ndarray
    """[E, S], the first states of all real episodes: where imagined episodes start."""


def empty(state_size: int, action_size: int) -> Dataset:
    """A dataset without transitions."""

    def none() -> Transitions:
        states = np.zeros((0, state_size), np.float32)
        return Transitions(states, np.zeros((0, action_size), np.float32), states, 0)

    return Dataset(none(), none(), np.zeros((0, state_size), np.float32))


def add(dataset: Dataset, episodes: list[Episode], config: CollectConfig, rng: np.random.Generator) -> Dataset:
    """The dataset with `episodes` added, a share of them (whole ones) to the validation set.

    Both sets get at least one episode where there are two, so that a first, short collection can be validated.
    """
    order = rng.permutation(len(episodes))
    held_out = min(max(1, round(config.validation_fraction * len(episodes))), len(episodes) - 1)
    validation = [episodes[i] for i in order[:held_out]]
    train = [episodes[i] for i in order[held_out:]]
    return Dataset(
        append(dataset.train, train, config.max_train),
        # A single first episode serves for both: there is nothing else to validate on.
        append(dataset.validation, validation or ([] if dataset.validation.size else train), config.max_validation),
        np.concatenate([dataset.starts, *(e.states[:1] for e in episodes)]),
    )


def with_capacity(transitions: Transitions, capacity: int) -> Transitions:
    """The same transitions in arrays of `capacity` rows: the fixed shape that compiled code wants."""

    def padded(rows: np.ndarray) -> np.ndarray:
        out = np.zeros((capacity, rows.shape[1]), np.float32)
        out[: len(rows)] = rows
        return out

    t = transitions
    return Transitions(padded(t.states), padded(t.actions), padded(t.deltas), np.int32(t.size))


def append(old: Transitions, episodes: list[Episode], most: int) -> Transitions:
    """The transitions with those of `episodes` added; of more than `most` the oldest go."""
    states = np.concatenate([old.states, *(e.states[:-1] for e in episodes)])[-most:]
    actions = np.concatenate([old.actions, *(e.actions for e in episodes)])[-most:]
    deltas = [np.diff(e.states, axis=0) for e in episodes]
    return Transitions(states, actions, np.concatenate([old.deltas, *deltas])[-most:], len(states))
