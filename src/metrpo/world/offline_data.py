"""Real transitions that somebody else has recorded, as episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from metrpo.errors import TaskError
from metrpo.safe_load import arrays_of, opened
from metrpo.types import Episode
from metrpo.world import minari_data
from metrpo.world.origin import origin_of, relative
from metrpo.world.task import Task

ARRAYS = ("states", "actions", "rewards", "next_states", "terminated")


def load(path: str | Path, task: Task) -> list[Episode]:
    """The episodes of an `.npz` of n transitions, one after the other; or of `minari:NAME` (see `world.minari_data`).

    Its arrays: `states` and `next_states` [n, S], `actions` [n, A] in [-1, 1], `rewards` [n], and `terminated` [n] (1
    where the task, not the clock, ended the episode).

    An episode goes on where the next transition starts in the state in which this one ended. For a task with a history
    the arrays hold observations all the same, [n, O], and the episodes its states. Files with pickled objects
    and archives that do not hold what they claim are refused (see `metrpo.safe_load`). Raises `TaskError` when the file
    cannot be read, lacks an array, or one does not fit the task.
    """
    plain = minari_data.load(str(path), task) if str(path).startswith(minari_data.PREFIX) else _read(path, task)
    if task.history == 1:
        return plain
    return [e._replace(states=task.layout.along(e.states, e.actions)) for e in plain]


def _read(path: str | Path, task: Task) -> list[Episode]:
    if not Path(path).exists():
        raise TaskError(f"{path}: expected an .npz of {', '.join(ARRAYS)}, got no such file")
    with opened(Path(path), TaskError) as file:
        found = arrays_of(file, Path(path), TaskError, compressed=True, only=ARRAYS)
    if missing := [name for name in ARRAYS if name not in found]:
        raise TaskError(f"{path}: expected the arrays {', '.join(ARRAYS)}; {', '.join(missing)} missing")
    count = found["rewards"].size
    size = (task.observation_size,)
    widths = {"states": size, "next_states": size, "actions": (task.action_size,)}
    for name, array in found.items():
        _check(f"{path}: {name}", array, (count, *widths.get(name, ())))
    if count == 0:
        raise TaskError(f"{path}: expected transitions, got none")
    beyond = float(np.abs(found["actions"]).max())
    if beyond > 1 + 1e-6:
        raise TaskError(f"{path}: actions: expected numbers in [-1, 1], got {beyond:.4g}; divide by their range")
    return _episodes(found)


def _check(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype.kind not in "biuf":
        expected, got = list(shape), list(array.shape)
        raise TaskError(f"{name}: expected numbers of shape {expected}, got {array.dtype} of shape {got}")
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold counts as infinite
        if not np.isfinite(array.astype(np.float32)).all():
            raise TaskError(f"{name}: expected finite numbers, got some that are not; leave these transitions out")


def _episodes(found: dict[str, np.ndarray]) -> list[Episode]:
    kinds = {"states": np.float64, "next_states": np.float64}
    arrays = {name: found[name].astype(kinds.get(name, np.float32)) for name in ARRAYS[:4]}
    ended = found["terminated"].astype(bool)
    # The same state may have been written twice with another rounding.
    origin = origin_of(arrays["states"])
    starts, ends_in = (relative(arrays[name], origin).astype(np.float32) for name in kinds)
    broken = np.any(ends_in[:-1] != starts[1:], axis=1)
    ends = np.flatnonzero(np.append(broken | ended[:-1], True)) + 1
    episodes = []
    for first, last in zip(np.append(0, ends[:-1]), ends, strict=True):
        rows = slice(first, last)
        states = np.concatenate([arrays["states"][rows], arrays["next_states"][last - 1 : last]])
        episodes.append(Episode(states, arrays["actions"][rows], arrays["rewards"][rows], bool(ended[last - 1])))
    return episodes
