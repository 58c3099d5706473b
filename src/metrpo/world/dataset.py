"""The dataset of real transitions: training and validation sets split by whole episodes, oldest out first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from metrpo.config import CollectConfig
from metrpo.history import tied
from metrpo.types import Episode, Transitions
from metrpo.world.origin import origin_of, relative

ROOM = 640 << 20
"""Bytes of transitions for which room is made at once: 200,000 of the widest of Gymnasium's robots."""


class Dataset(NamedTuple):
    """All real data that learning sees; host arrays, a pytree."""

    train: Transitions
    validation: Transitions
    starts: np.ndarray
    """[E, S], the first states of all real episodes, counted from the origin: where imagined episodes start."""
    origin: np.ndarray
    """[S], float64: what states are counted from (`world.origin`); the first data decide it."""


def empty(state_size: int, action_size: int, predicted: int | None = None) -> Dataset:
    """A dataset without transitions, of which so many columns are to be `predicted`; by default those of the state."""

    def none() -> Transitions:
        states, actions, deltas = (
            np.zeros((0, n), np.float32) for n in (state_size, action_size, predicted or state_size)
        )
        return Transitions(states, actions, deltas, 0)

    return Dataset(none(), none(), np.zeros((0, state_size), np.float32), np.zeros(state_size))


def add(
    dataset: Dataset,
    episodes: list[Episode],
    config: CollectConfig,
    rng: np.random.Generator,
    learned: tuple[str, ...] = (),
    carried: tuple[int, ...] = (),
) -> Dataset:
    """The dataset with `episodes` added, a share of them (whole ones, or whole pieces) to the validation set.

    `learned` names what is to be predicted besides the state (`Task.learned`); the part of the state that is `carried`
    over (`Task.carried`) is not.

    Both sets get at least one episode where there are two, so that a first, short collection can be validated.
    """
    origin = dataset.origin
    if episodes and not len(dataset.starts):
        seen = np.concatenate([e.states for e in episodes])
        # What is copied from state to state must not change by where it is counted from.
        origin = tied(origin_of(seen[:, : seen.shape[1] - len(carried)]), carried)
    starts = [_counted_from(origin, e)[:1].astype(np.float32) for e in episodes]
    if config.piece is not None:
        episodes = [part for e in episodes for part in pieces(e, config.piece)]
    order = rng.permutation(len(episodes))
    held_out = min(max(1, round(config.validation_fraction * len(episodes))), len(episodes) - 1)
    validation = [episodes[i] for i in order[:held_out]]
    train = [episodes[i] for i in order[held_out:]]
    # A single first episode serves for both: there is nothing else to validate on.
    validation = validation or ([] if dataset.validation.size else train)
    return Dataset(
        append(dataset.train, train, config.max_train, learned, origin, carried),
        append(dataset.validation, validation, config.max_validation, learned, origin, carried),
        np.concatenate([dataset.starts, *starts]),
        origin,
    )


def pieces(episode: Episode, longest: int) -> list[Episode]:
    """The episode cut into parts of at most `longest` steps, as episodes of their own."""
    length = len(episode.rewards)
    return [
        Episode(
            episode.states[first : end + 1],
            episode.actions[first:end],
            episode.rewards[first:end],
            episode.terminated and end >= length,
        )
        for first, end in ((i, i + longest) for i in range(0, length, longest))
    ]


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


def append(
    old: Transitions,
    episodes: list[Episode],
    most: int,
    learned: tuple[str, ...] = (),
    origin: np.ndarray | None = None,
    carried: tuple[int, ...] = (),
) -> Transitions:
    """The transitions with those of `episodes` added, counted from `origin`; of more than `most` the oldest go.

    `learned` and `carried` as in `add`.
    """
    exact = [e.states.astype(np.float32) if origin is None else _counted_from(origin, e) for e in episodes]
    states = np.concatenate([old.states, *(x[:-1].astype(np.float32) for x in exact)])[-most:]
    actions = np.concatenate([old.actions, *(e.actions for e in episodes)])[-most:]
    changed = states.shape[1] - len(carried)
    changes = [_deltas(x[:, :changed], e, learned) for x, e in zip(exact, episodes, strict=True)]
    deltas = np.concatenate([old.deltas, *changes])[-most:]
    return Transitions(states, actions, deltas, len(states))


def _counted_from(origin: np.ndarray, episode: Episode) -> np.ndarray:
    """[L + 1, S], float64. Where there is no origin the numbers are those of float32, which deltas then add up to."""
    exact = relative(episode.states, origin)
    return np.where(origin != 0, exact, exact.astype(np.float32)).astype(np.float64)


def _deltas(states: np.ndarray, episode: Episode, learned: tuple[str, ...]) -> np.ndarray:
    ends = np.zeros_like(episode.rewards)
    ends[-1] = episode.terminated
    columns = {"reward": episode.rewards, "end": ends}
    change = np.diff(states, axis=0).astype(np.float32)
    return np.column_stack([change, *(columns[name] for name in learned)])
