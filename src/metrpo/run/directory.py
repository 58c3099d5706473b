"""A run directory: one run's settings, checkpoints, metrics, policy and curve, written by one process at a time.

    DIR/run.json       format and versions         DIR/metrics.csv      one row per outer iteration
    DIR/config.json    every setting               DIR/diagnostics.csv  the same for each model and state dimension
    DIR/checkpoints/   the newest two states       DIR/policy.npz       the policy (policy.json says what it is)
    DIR/events/        TensorBoard                 DIR/curve.png        the learning curve
    DIR/video.mp4      the final policy at work
    DIR/episodes/      real episodes that the state has not learned from (see `metrpo.run.episodes`)

The newest checkpoint is the run: it holds the state and all rows. Everything else is derived from it, written after it
and again when the run is resumed, so that a kill at any moment leaves nothing twice and nothing missing.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import jax
import numpy as np

from metrpo import config as configs
from metrpo.config import Config
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.history import History
from metrpo.run import yardstick_record
from metrpo.run.checkpoint import load_state, save_state
from metrpo.run.curve import draw_curve
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import DamagedFile, atomic_write, inside, writing
from metrpo.run.lock import claim, require_same
from metrpo.run.metrics import (
    Events,
    Row,
    checked,
    completed,
    details,
    overview,
    plain,
    read_metrics,
    to_csv,
    without_clocks,
)
from metrpo.run.policy_file import Learned, Weights, save_policy
from metrpo.safe_load import text_of

if TYPE_CHECKING:  # importing a run directory imports no environment
    from metrpo.world.interface import Interface

_log = logging.getLogger("metrpo")
_KEPT = 2
_PATIENCE = 120.0
"""Seconds to write a file derived from a checkpoint; the first curve ever drawn on a machine looks for fonts."""


class Saved(Protocol):
    """A training state, as a run directory sees it: a pytree with these fields."""

    @property
    def iteration(self) -> int:
        """Outer iterations finished."""

    @property
    def real_steps(self) -> int:
        """Real steps collected."""

    @property
    def policy(self) -> Weights:
        """The accepted policy."""


State = TypeVar("State", bound=Saved)


class RunDirectory:
    """One run on disk, locked by this process until `close` (or the end of a `with` block).

    Opening creates the directory, or checks that it holds a run of this version with the same settings; only the budget
    (`config.BUDGET_FIELDS`) may have changed. Use: `load` once, then `save` after every outer iteration.

    Raises `RunDirectoryError` when the directory cannot be written, is in use by another process, holds something else,
    a run of another version or one with other settings; nothing in it has been changed then.
    """

    path: Path
    config: Config
    rows: list[Row]
    """Every finished iteration, as in metrics.csv."""
    interface: Interface | None
    """What the task's environment shows and takes, for the policy's file; None: unknown."""
    episodes: EpisodeLog
    """Real episodes, on disk as soon as they end."""

    def __init__(self, path: str | Path, config: Config, interface: Interface | None = None) -> None:
        self.path, self.config, self.interface, self.rows = Path(path), config, interface, []
        self._lock = claim(self.path, config)
        self.episodes, self._taken = EpisodeLog(self.path, writer="run"), [0]
        self._opened, self._wall_seconds_before = time.monotonic(), 0.0
        self._events: Events | None = None
        self._failed: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Unlocks the directory."""
        self._lock.close()

    def load(self, template: State) -> State | None:
        """The state of the newest checkpoint, in `template`'s structure; None in a fresh directory.

        A damaged checkpoint loses only its iteration: the one before takes its place, with a warning, and the real
        episodes of the lost iteration are still there.

        Raises `RunDirectoryError` when no checkpoint is sound, or it is of another structure or version.
        """
        found = self._checkpoints()
        layers = template.policy.layers
        self.episodes.layout = History.of_state(self.config.history, layers[0][0].shape[0], layers[-1][0].shape[1])
        if not found:
            self._require_fresh()
            self._write_config()
            return None
        state, meta = self._load_newest(found, template)
        self._look_for_more(found[-1])
        self.rows = meta["rows"]
        self._wall_seconds_before = (self.rows[-1]["wall_seconds"] or 0.0) if self.rows else 0.0
        self.episodes.start(after=meta.get("episodes", 0))
        self._taken = [self.episodes.taken]
        self._write_config()
        self._publish(state)
        return state

    def begin(self, state: Saved) -> None:
        """Saves the state before the first iteration, for callers who run the loop's steps one at a time.

        Raises `RunDirectoryError` when a file cannot be written.
        """
        self._write_checkpoint(state, [], taken=0)
        self._publish(state)

    def save(self, state: Saved, row: Mapping[str, Any]) -> Row:
        """Ends an outer iteration: checkpoint, metrics, policy, curve, events. Returns the row as written.

        `row` holds at least `iteration` and `real_steps`; `wall_seconds`, the time this run has taken over all its
        resumes, is added as its last column. A deterministic run leaves clock columns empty.

        Raises `RunDirectoryError` when a file cannot be written; the last checkpoint is then still whole.
        """
        elapsed = self._wall_seconds_before + time.monotonic() - self._opened
        written = plain({**row, "wall_seconds": round(elapsed, 3)})
        written = without_clocks(written) if self.config.deterministic else written
        rows = [*(completed(row, written) for row in self.rows), written]
        to_csv(rows)  # columns that differ are an error before anything is written
        self._write_checkpoint(state, rows, taken=self.episodes.read)
        self.rows = rows
        self.episodes.start(after=self.episodes.read)
        self._taken = [*self._taken, self.episodes.taken][-_KEPT:]
        self._publish(state)
        self.episodes.forget(before=self._taken[0])  # last: the checkpoint that would need them is gone
        return written

    @property
    def newest(self) -> Path:
        """The file of the newest checkpoint."""
        return self._checkpoints()[-1]

    def _load_newest(self, found: list[Path], template: State) -> tuple[State, dict[str, Any]]:
        """The newest intact checkpoint; damaged ones are set aside."""
        damaged: list[tuple[Path, DamagedFile]] = []
        for path in reversed(found):
            try:
                state, meta = load_state(path, template)
                _check(path, state, meta)
            except DamagedFile as error:
                damaged.append((path, error))
                continue
            require_same(_config(path, meta), self.config, f"{path}, unlike config.json,", self.path)
            for old, why in damaged:
                _log.warning("%s; resuming from %s, the damaged file is kept as %s.damaged", why, path.name, old.name)
                with writing(aside := old.with_name(f"{old.name}.damaged")):
                    old.rename(aside)
            return state, meta
        what = " and ".join(str(why) for _, why in damaged)
        raise DamagedFile(
            f"{what}. Nothing was changed. There is no earlier checkpoint: put the file back, or start anew in another "
            "directory (--run-dir)"
        )

    def _write_checkpoint(self, state: Saved, rows: list[Row], taken: int) -> None:
        path = self.path / "checkpoints" / f"iteration-{state.iteration:05d}.npz"
        meta = {"iteration": state.iteration, "config": configs.to_json(self.config), "rows": rows}
        save_state(path, state, {**meta, "episodes": taken})

    def _checkpoints(self) -> list[Path]:
        names = (self.path / "checkpoints").glob("iteration-*.npz")
        return sorted((n for n in names if re.fullmatch(r"iteration-[0-9]{5,18}", n.stem)), key=_number)

    def _require_fresh(self) -> None:
        metrics = self.path / "metrics.csv"
        if metrics.exists():
            finished = len(read_metrics(metrics))
            raise RunDirectoryError(
                f"{self.path} has lost its checkpoints: expected one of iteration {finished}, the last in "
                f"{metrics.name}, got none; put the files back or choose another directory"
            )

    def _look_for_more(self, newest: Path) -> None:
        # A row is written after its checkpoint. A file that cannot be read is written anew anyway.
        with contextlib.suppress(RunDirectoryError):
            finished = len(read_metrics(self.path / "metrics.csv"))
            if finished > _number(newest):
                lost = f"iteration-{finished:05d}.npz"
                _log.warning("%s has lost its checkpoint %s; resuming from an earlier one", self.path, lost)

    def _write_config(self) -> None:
        # The budget may have changed since last time.
        atomic_write(self.path / "config.json", configs.to_json(self.config))

    def _publish(self, state: Saved) -> None:
        # Rewrite all of it at every start, too: no check tells whether a picture or an event file is damaged.
        for old in self._checkpoints()[:-_KEPT]:
            with contextlib.suppress(OSError):  # costs room only
                old.unlink()
        self._write_policy(state)
        if not self.rows:
            return
        self._derive("learning curve", self._draw_curve)
        self._derive("TensorBoard events", self._write_events)
        if all(rows := [details(row) for row in self.rows]):
            atomic_write(self.path / "diagnostics.csv", to_csv(rows))
        # Last: the rows in this file decide whether a run is finished.
        atomic_write(self.path / "metrics.csv", to_csv([overview(row) for row in self.rows]))

    def _write_policy(self, state: Saved) -> None:
        result = self.rows[-1].get("return_real") if self.rows else None
        result = result if result is not None and math.isfinite(result) else None
        learned = Learned(state.iteration, state.real_steps, result)
        origin = getattr(state, "origin", None)  # baselines have none
        save_policy(self.path, state.policy, self.config.task, learned, self.interface, origin, self.config)

    def _draw_curve(self) -> None:
        title = f"{self.config.task}, {self.config.system}, {self.config.preset}, seed {self.config.seed}"
        draw_curve(self.rows, self.path / "curve.png", title, yardstick_record.kept(self.path))

    def _write_events(self) -> None:
        if self._events is None or not self._events.path.exists():
            self._events = Events(self.path / "events", self.rows)
        else:
            self._events.add(self.rows[-1])

    def _derive(self, what: str, write: Callable[[], None]) -> None:
        # A picture that fails, or takes forever, must not cost hours of training.
        if what in self._failed:
            return
        try:
            _within(_PATIENCE, write)
        except Exception as error:
            self._failed.add(what)
            _log.warning("no %s any more (%s: %s); training continues", what, type(error).__name__, error)


def _within(seconds: float, act: Callable[[], None]) -> None:
    """Calls `act`; raises `TimeoutError` when it takes longer, and leaves it running. It must not touch shared data."""
    raised: list[BaseException] = []

    def attempt() -> None:
        try:
            act()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        raise TimeoutError(f"not finished within {seconds:g} s")
    if raised:
        raise raised[0]


def _number(path: Path) -> int:
    return int(path.stem.removeprefix("iteration-"))


def _config(path: Path, meta: Mapping[str, Any]) -> Config:
    text = meta.get("config")
    try:
        return configs.from_json(text if isinstance(text, str) else "")
    except ConfigError as error:
        raise RunDirectoryError(f"{path} does not fit this version: {error}; choose another directory") from None


def _check(path: Path, state: Saved, meta: Mapping[str, Any]) -> None:
    """Checks that a checkpoint's name, state and record agree, for people rename and copy files by hand.

    Raises `DamagedFile` when it is another iteration's, `RunDirectoryError` when no run can have written it.
    """
    if state.iteration != _number(path):
        raise DamagedFile(f"{path} is damaged (renamed): expected iteration {_number(path)}, got {state.iteration}")
    episodes = meta.get("episodes", 0)
    try:
        checked(meta.get("rows"), state.iteration)
        if type(episodes) is not int or episodes < 0 or state.real_steps < 0:
            raise ValueError("expected counts of episodes and real steps")
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
            raise ValueError("expected finite numbers, got some that are infinite or NaN")
    except ValueError as error:
        raise RunDirectoryError(f"{path} holds no state to resume from: {error}; choose another directory") from None


def stored_config(run_dir: str | Path) -> Config:
    """The settings of the run in `run_dir`.

    Raises `RunDirectoryError` when it holds none, or what it holds cannot be read.
    """
    file = Path(run_dir) / "config.json"
    if Path(run_dir).is_file():
        raise RunDirectoryError(f"{run_dir} is a file; expected a run directory")
    try:
        if not file.exists():
            if run := inside(Path(run_dir), file.name):
                raise RunDirectoryError(f"{run_dir}: expected one run's directory, got a folder of runs, such as {run}")
            raise RunDirectoryError(
                f"{run_dir} holds no run: expected {file}; start one with: metrpo init TASK --run-dir {run_dir}"
            )
        return configs.from_json(text_of(file, ConfigError))
    except (OSError, ConfigError) as error:
        raise RunDirectoryError(f"{file} cannot be read: {error}; put it back or choose another directory") from None
