"""The dataset of real transitions: training and validation sets split by whole episodes, oldest out first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from metrpo.config import CollectConfig
from metrpo.types import Episode, Transitions

ROOM = 640 << 20
"""Bytes of transitions for which room is made at once: 200,000 of the widest of Gymnasium's robots."""


class Dataset(NamedTuple):
    """All real data that learning sees; host arrays, a pytree."""

    train: Transitions
    validation: Transitions
    starts: np.ndarray
    """[E, S], the first states of all real episodes: where imagined episodes start."""


def empty(state_size: int, action_size: int, learned: int = 0) -> Dataset:
    """A dataset without transitions; `learned` columns more than the state are to be predicted."""

    def none() -> Transitions:
        states, actions, deltas = (
            np.zeros((0, n), np.float32) for n in (state_size, action_size, state_size + learned)
        )
        return Transitions(states, actions, deltas, 0)

    return Dataset(none(), none(), np.zeros((0, state_size), np.float32))


def add(
    dataset: Dataset,
    episodes: list[Episode],
    config: CollectConfig,
    rng: np.random.Generator,
    learned: tuple[str, ...] = (),
) -> Dataset:
    """The dataset with `episodes` added, a share of them (whole ones) to the validation set.

    `learned` names what is to be predicted besides the state (`Task.learned`).

    Both sets get at least one episode where there are two, so that a first, short collection can be validated.
    """
    order = rng.permutation(len(episodes))
    held_out = min(max(1, round(config.validation_fraction * len(episodes))), len(episodes) - 1)
    validation = [episodes[i] for i in order[:held_out]]
    train = [episodes[i] for i in order[held_out:]]
    # A single first episode serves for both: there is nothing else to validate on.
    validation = validation or ([] if dataset.validation.size else train)
    return Dataset(
        append(dataset.train, train, config.max_train, learned),
        append(dataset.validation, validation, config.max_validation, learned),
        np.concatenate([dataset.starts, *(e.states[:1] for e in episodes)]),
    )


def with_capacity(transitions: Transitions, most: int) -> Transitions:
    """The same transitions in longer arrays, of `most` rows at most: the fixed shape that compiled code wants.

    Of `most` at once where that takes little room; else of as many as do, doubled until the transitions fit, so that
    code is compiled anew a few times only.
    """
    capacity = _capacity(transitions, most)

    def padded(rows: np.ndarray) -> np.ndarray:
        out = np.zeros((capacity, rows.shape[1]), np.float32)
        out[: len(rows)] = rows
        return out

    t = transitions
    return Transitions(padded(t.states), padded(t.actions), padded(t.deltas), np.int32(t.size))


def _capacity(transitions: Transitions, most: int) -> int:
    row = 4 * sum(rows.shape[1] for rows in transitions[:3])
    capacity = max(1, ROOM // row)
    while capacity < len(transitions.states):
        capacity *= 2
    return min(capacity, most)


def append(old: Transitions, episodes: list[Episode], most: int, learned: tuple[str, ...] = ()) -> Transitions:
    """The transitions with those of `episodes` added; of more than `most` the oldest go."""
    states = np.concatenate([old.states, *(e.states[:-1] for e in episodes)])[-most:]
    actions = np.concatenate([old.actions, *(e.actions for e in episodes)])[-most:]
    deltas = np.concatenate([old.deltas, *(_deltas(e, learned) for e in episodes)])[-most:]
    return Transitions(states, actions, deltas, len(states))


def _deltas(episode: Episode, learned: tuple[str, ...]) -> np.ndarray:
    ends = np.zeros_like(episode.rewards)
    ends[-1] = episode.terminated
    columns = {"reward": episode.rewards, "end": ends}
    return np.column_stack([np.diff(episode.states, axis=0), *(columns[name] for name in learned)])
