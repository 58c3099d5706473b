"""Real episodes on disk from the moment they end: what a run has collected and not yet learned from.

    DIR/episodes/00000012.npz    the thirteenth episode of the run: states, actions, rewards, terminated
    DIR/episodes/failed.json     episodes of the iteration under way in which the environment failed

Episodes are numbered over the whole run, whoever appends them: the loop, or a robot's own program (`append_episode`).
The checkpoint of an iteration says how many it has learned from; their files go once no kept checkpoint needs them.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import secrets
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from metrpo.errors import RunDirectoryError, TaskError
from metrpo.history import History
from metrpo.run.files import atomic_write, length_of, read_arrays, read_meta, sync_directory, write_arrays, writing
from metrpo.run.policy_file import load_policy
from metrpo.safe_load import brief, json_of, text_of
from metrpo.types import Episode

_log = logging.getLogger("metrpo")
_KINDS: dict[str, tuple[Any, ...]] = {"terminated": (bool,), "states": (np.float64, np.float32)}
"""Of numbers in the files; all others are float32, as states were in earlier versions."""


class EpisodeLog:
    """The episodes of one run directory (see above).

    It takes and gives states, with the run's history; its files, which other programs write too, hold observations.
    """

    def __init__(self, run_dir: Path, writer: str | None = None) -> None:
        # The name of the only writer there is may come again, over what a kill has left; others are never the same.
        self.folder, self._writer = run_dir / "episodes", writer or f"{os.getpid()}-{secrets.token_hex(4)}"
        self._failed = self.folder / "failed.json"
        self.layout: History | None = None
        """How the run's states are put together, where that is known; files hold the plain observations."""
        self.start(after=0)

    def start(self, after: int) -> None:
        """The state has learned from the first `after` episodes."""
        self.taken = after
        """Number of the first episode that may be pending."""
        self.read = after
        """Number after the last episode that `pending` gave or `append` wrote."""

    def failures(self) -> dict[int, bool]:
        """The episodes since the state learned in which the environment failed, and whether each is left out for good.

        By their number within the iteration. What cannot be read says nothing: such an episode fails once more.
        """
        return self._failures().get(self.taken, {})

    def note_failures(self, failures: Mapping[int, bool]) -> None:
        """Puts them on disk. Raises `RunDirectoryError` when it cannot be written."""
        # With those of the iteration before, which a damaged checkpoint may lead back to.
        kept = {after: each for after, each in self._failures().items() if after < self.taken}
        kept = dict(sorted(kept.items())[-1:]) | {self.taken: dict(failures)}
        atomic_write(self._failed, json.dumps(kept) + "\n")

    def _failures(self) -> dict[int, dict[int, bool]]:
        try:
            stored = json_of(text_of(self._failed, RunDirectoryError), str(self._failed), RunDirectoryError)
            found = {int(after): {int(n): left_out for n, left_out in each.items()} for after, each in stored.items()}
        except (RunDirectoryError, AttributeError, ValueError):
            return {}
        return {after: each for after, each in found.items() if all(type(x) is bool for x in each.values())}

    def pending(self) -> list[Episode]:
        """The episodes that the state has not learned from, in order, but for `proofs`.

        Raises `DamagedFile` when one is not as it was written, `RunDirectoryError` when one cannot be read.
        """
        numbers = [n for n in self._numbers() if n >= self.taken]
        self.read = max([self.taken, *(n + 1 for n in numbers)])
        if lost := self.read - self.taken - len(numbers):
            span = f"{self.taken:08d} and {self.read - 1:08d}"
            _log.warning("%s: %d real episodes between %s are gone; continuing without them", self.folder, lost, span)
        return [episode for episode, proof in map(self._load, numbers) if not proof]

    def proofs(self) -> list[Episode]:
        """Those of the episodes that wait which tried a policy that the state does not hold yet.

        Raises as `pending`.
        """
        waiting = (self._load(n) for n in self._numbers() if n >= self.taken)
        return [episode for episode, proof in waiting if proof]

    def waiting_steps(self) -> int:
        """Real steps that the state has not learned from, as far as their files say."""
        paths = [self._path(n) for n in self._numbers() if n >= self.taken]
        return sum(_steps_in(path, path.stat().st_mtime_ns) for path in paths)

    def append(self, episode: Episode, proof: bool = False) -> Path:
        """Puts an episode on disk, whole or not at all, under the next free number; others may append meanwhile.

        Raises `RunDirectoryError` when it cannot be written.
        """
        number = max([self.taken, *(n + 1 for n in self._numbers())])
        states = episode.states if self.layout is None else self.layout.newest(episode.states)
        arrays = {**episode._asdict(), "states": states, "terminated": np.bool_(episode.terminated)}
        arrays = {name: np.asarray(array) for name, array in arrays.items()}
        temporary = self.folder / f"from-{self._writer}.npz"
        try:
            with writing(self._path(number)):
                while True:
                    write_arrays(temporary, arrays, {"number": number, "proof": proof})
                    try:
                        os.link(temporary, self._path(number))  # unlike a rename, it never replaces another's episode
                        break
                    except FileExistsError:
                        number += 1
                sync_directory(self.folder)
        finally:
            with contextlib.suppress(OSError):  # a leftover does no harm
                temporary.unlink()
        self.read = number + 1
        return self._path(number)

    def forget(self, before: int) -> None:
        """Deletes the episodes with smaller numbers; the last of all stays, for whoever appends numbers from it on."""
        for number in self._numbers()[:-1]:
            if number < before:
                with contextlib.suppress(OSError):  # costs room only
                    self._path(number).unlink()

    def _numbers(self) -> list[int]:
        # Each number has one name only, so that no episode counts twice.
        found = (re.fullmatch(r"([0-9]{8}|[1-9][0-9]{8,17})\.npz", path.name) for path in self.folder.glob("*.npz"))
        return sorted(int(match[1]) for match in found if match)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:08d}.npz"

    def _load(self, number: int) -> tuple[Episode, bool]:
        """An episode, and whether it is a proof."""
        path = self._path(number)
        arrays, meta = read_arrays(path)
        # Under another's number, it would be learned from twice, and the other one lost.
        if (own := meta.get("number", number)) != number:
            raise RunDirectoryError(
                f"{path} was renamed: expected episode {number}, got {brief(own)}; restore its name, or add its arrays "
                "with metrpo.append_episode"
            )
        try:
            return self._checked(arrays), meta.get("proof") is True
        except ValueError as error:
            raise RunDirectoryError(f"{path} holds no episode of this run ({error}); remove it to continue") from None

    def _checked(self, arrays: dict[str, np.ndarray]) -> Episode:
        if set(arrays) != set(Episode._fields):
            raise ValueError(f"expected {', '.join(Episode._fields)}, got {brief(list(arrays))}")
        steps = arrays["rewards"].size
        layout = self.layout
        widths = (array.shape[-1] if array.ndim else 0 for array in list(arrays.values())[:2])
        states, actions = widths if layout is None else (layout.observation_size, layout.action_size)
        shapes = {"states": (steps + 1, states), "actions": (steps, actions), "rewards": (steps,), "terminated": ()}
        for name, array in arrays.items():
            if array.shape != shapes[name] or steps == 0:
                raise ValueError(f"{name}: expected shape {list(shapes[name])}, got {list(array.shape)}")
            kinds = _KINDS.get(name, (np.float32,))
            if array.dtype not in kinds or not _finite(array):
                expected = np.dtype(kinds[0]).name
                raise ValueError(f"{name}: expected finite numbers of {expected}, got {array.dtype} or others")
        if layout is not None and layout.length > 1:
            arrays["states"] = layout.along(arrays["states"], arrays["actions"])
        return Episode(arrays["states"], arrays["actions"], arrays["rewards"], bool(arrays["terminated"]))


def waiting_steps(run_dir: Path) -> int:
    """Real steps that wait in a run's directory, as one sees it from outside; 0 where that cannot be read."""
    log = EpisodeLog(run_dir)
    try:
        if not log.folder.is_dir():
            return 0
        if newest := max(run_dir.glob("checkpoints/iteration-*.npz"), default=None):
            log.start(after=_taken_by(newest, newest.stat().st_mtime_ns))
        return log.waiting_steps()
    except (OSError, RunDirectoryError):
        return 0


@lru_cache(maxsize=1000)
def _taken_by(checkpoint: Path, written: int) -> int:
    taken = read_meta(checkpoint).get("episodes", 0)
    return taken if type(taken) is int else 0


@lru_cache(maxsize=10_000)
def _steps_in(path: Path, written: int) -> int:
    return length_of(path, "rewards")


def _finite(array: np.ndarray) -> bool:
    """Whether all numbers are finite, also in float32, in which everything is learned."""
    with np.errstate(over="ignore"):
        return bool(np.isfinite(array.astype(np.float32)).all())


def append_episode(
    run_dir: str | Path, states: Sequence[Any], actions: Sequence[Any], rewards: Sequence[float], terminated: bool
) -> Path:
    """Adds one real episode of L steps to a run, which learns from it in its next iteration; needs NumPy only.

    `states` [L + 1, O] are the observations, including the one after the last step (also where the policy has a
    history); `actions` [L, A] in [-1, 1] as executed; `rewards` [L]; `terminated`: whether the task, not the time
    limit, ended the episode. May be called while another program improves the policy. Returns the episode's file.

    Raises `TaskError` when the arrays do not fit each other or the run's policy, or are not finite;
    `RunDirectoryError` when `run_dir` holds no run or cannot be written.
    """
    info = load_policy(run_dir).info
    lists = {"states": states, "actions": actions, "rewards": rewards}
    with np.errstate(over="ignore"):  # infinity is refused below
        arrays = {n: np.asarray(value, np.float64 if n == "states" else np.float32) for n, value in lists.items()}
    length = len(arrays["rewards"])
    shapes = {
        "states": (length + 1, info.observation_size),
        "actions": (length, info.action_size),
        "rewards": (length,),
    }
    for name, array in arrays.items():
        if array.shape != shapes[name] or length == 0:
            expected = list(shapes[name]) if length else "at least one step"
            raise TaskError(f"append_episode: {name}: expected {expected}, got shape {list(array.shape)}")
        if not _finite(array):
            raise TaskError(f"append_episode: {name}: expected finite numbers; cut the episode before the others")
    if np.ndim(terminated) != 0:
        raise TaskError(f"append_episode: terminated: expected one truth value, got {np.size(terminated)} of them")
    beyond = float(np.abs(arrays["actions"]).max())
    if beyond > 1 + 1e-6:
        raise TaskError(f"append_episode: actions: expected numbers in [-1, 1], got {beyond:.4g}; divide by the range")
    return EpisodeLog(Path(run_dir)).append(Episode(**arrays, terminated=bool(terminated)))
