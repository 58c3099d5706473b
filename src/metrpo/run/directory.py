"""A run directory: one run's settings, checkpoints, metrics, policy and curve, written by one process at a time.

    DIR/run.json       format and versions         DIR/metrics.csv   one row per outer iteration
    DIR/config.json    every setting               DIR/curve.png     the learning curve
    DIR/checkpoints/   the newest two states       DIR/policy.npz    the policy (policy.json says what it is)
    DIR/events/        TensorBoard                 DIR/video.mp4     the final policy at work
    DIR/episodes/      real episodes that the state has not learned from (see `metrpo.run.episodes`)

The newest checkpoint is the run: it holds the state and all rows. Everything else is derived from it, written after it
and again when the run is resumed, so that a kill at any moment leaves nothing twice and nothing missing.
"""

from __future__ import annotations

import logging
import math
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

from metrpo import config as configs
from metrpo.config import Config
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.run.checkpoint import load_state, save_state
from metrpo.run.claim import claim, require_same
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import DamagedFile, atomic_write
from metrpo.run.metrics import Events, Row, plain, read_metrics, to_csv, without_clocks
from metrpo.run.policy_file import Weights, save_policy
from metrpo.run.report import draw_curve

_log = logging.getLogger("metrpo")
_KEPT = 2


class Saved(Protocol):
    """What a run directory must know of a training state: a pytree with these fields."""

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
    """One run on disk, held by this process until `close` (or the end of a `with` block).

    Opening creates the directory, or checks that it holds a run of this version with the same settings; only the budget
    (`config.BUDGET_FIELDS`) may have changed. Use: `load` once, then `save` after every outer iteration.

    Raises `RunDirectoryError` when the directory cannot be written, is in use by another process, holds something else,
    a run of another version or one with other settings; nothing in it has been changed then.
    """

    path: Path
    config: Config
    rows: list[Row]
    """Every finished iteration, as in metrics.csv."""
    episodes: EpisodeLog
    """Real episodes, on disk as soon as they end."""

    def __init__(self, path: str | Path, config: Config) -> None:
        self.path, self.config, self.rows = Path(path), config, []
        self._lock = claim(self.path, config)
        self.episodes, self._taken = EpisodeLog(self.path), [0]
        self._opened, self._wall_seconds_before = time.monotonic(), 0.0
        self._events: Events | None = None
        self._failed: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of the directory."""
        if self._events is not None:
            self._derive("TensorBoard events", self._events.close)
        self._lock.close()

    def load(self, template: State) -> State | None:
        """The state of the newest checkpoint, in `template`'s structure; None in a fresh directory.

        A damaged checkpoint costs its iteration only: the one before it takes its place, with a warning, and the real
        episodes of that iteration are still there.

        Raises `RunDirectoryError` when no checkpoint is sound, or it is of another structure or version.
        """
        found = self._checkpoints()
        if not found:
            self._require_fresh()
            self._write_config()
            return None
        state, meta = self._load_newest(found, template)
        self.rows = meta["rows"]
        self._wall_seconds_before = (self.rows[-1]["wall_seconds"] or 0.0) if self.rows else 0.0
        self.episodes.start(after=meta.get("episodes", 0))
        self._taken = [self.episodes.taken]
        self._write_config()
        self._publish(state)
        return state

    def begin(self, state: Saved) -> None:
        """Saves the state before the first iteration: for those who take the loop's steps one at a time.

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
        rows = [*self.rows, written]
        to_csv(rows)  # columns that differ are an error before anything is written
        self._write_checkpoint(state, rows, taken=self.episodes.read)
        self.rows = rows
        self.episodes.start(after=self.episodes.read)
        self._taken = [*self._taken, self.episodes.taken][-_KEPT:]
        self.episodes.forget(before=self._taken[0])
        self._publish(state)
        return written

    def _load_newest(self, found: list[Path], template: State) -> tuple[State, dict[str, Any]]:
        """The newest checkpoint that is as it was written; damaged ones are set aside."""
        damaged: list[tuple[Path, DamagedFile]] = []
        for path in reversed(found):
            try:
                state, meta = load_state(path, template)
            except DamagedFile as error:
                damaged.append((path, error))
                continue
            require_same(configs.from_json(meta["config"]), self.config, path)
            for old, why in damaged:
                _log.warning("%s; going on from %s, the damaged file is kept as %s.damaged", why, path.name, old.name)
                old.rename(old.with_name(f"{old.name}.damaged"))
            return state, meta
        what = " and ".join(str(why) for _, why in damaged)
        raise DamagedFile(
            f"{what}. Nothing was changed. There is no earlier checkpoint: put the file back, or start anew in another "
            "directory"
        )

    def _write_checkpoint(self, state: Saved, rows: list[Row], taken: int) -> None:
        path = self.path / "checkpoints" / f"iteration-{state.iteration:05d}.npz"
        meta = {"iteration": state.iteration, "config": configs.to_json(self.config), "rows": rows}
        save_state(path, state, {**meta, "episodes": taken})

    def _checkpoints(self) -> list[Path]:
        names = (self.path / "checkpoints").glob("iteration-*.npz")
        return sorted(n for n in names if re.fullmatch(r"iteration-\d{5,}", n.stem))

    def _require_fresh(self) -> None:
        metrics = self.path / "metrics.csv"
        if metrics.exists():
            finished = len(read_metrics(metrics))
            raise RunDirectoryError(
                f"{self.path} has lost its checkpoints: expected one for the {finished} iterations in {metrics.name}, "
                "got none; put the files back or choose another directory"
            )

    def _write_config(self) -> None:
        # The budget may be another one than last time.
        atomic_write(self.path / "config.json", configs.to_json(self.config))

    def _publish(self, state: Saved) -> None:
        for old in self._checkpoints()[:-_KEPT]:
            old.unlink()
        result = self.rows[-1].get("return_real") if self.rows else None
        result = result if result is not None and math.isfinite(result) else None
        if self.rows:
            atomic_write(self.path / "metrics.csv", to_csv(self.rows))
        save_policy(self.path, state.policy, self.config.task, state.iteration, state.real_steps, result)
        if not self.rows:
            return
        title = f"{self.config.task}, {self.config.system}, {self.config.preset}, seed {self.config.seed}"
        self._derive("learning curve", lambda: draw_curve(self.rows, self.path / "curve.png", title))
        self._derive("TensorBoard events", self._write_events)

    def _write_events(self) -> None:
        if self._events is None:
            self._events = Events(self.path / "events", self.rows)
        else:
            self._events.add(self.rows[-1])

    def _derive(self, what: str, write: Callable[[], None]) -> None:
        # A picture that cannot be drawn must not cost hours of training.
        if what in self._failed:
            return
        try:
            write()
        except Exception as error:
            self._failed.add(what)
            _log.warning("no %s from here on (%s: %s); training goes on", what, type(error).__name__, error)


def stored_config(run_dir: str | Path) -> Config:
    """The settings of the run in `run_dir`.

    Raises `RunDirectoryError` when it holds none, or what it holds cannot be read.
    """
    file = Path(run_dir) / "config.json"
    try:
        return configs.from_json(file.read_text())
    except FileNotFoundError:
        raise RunDirectoryError(
            f"{run_dir} holds no run: expected {file}; start one with: metrpo init TASK --run-dir {run_dir}"
        ) from None
    except (OSError, ConfigError, UnicodeDecodeError) as error:
        raise RunDirectoryError(f"{file} cannot be read: {error}; put it back or choose another directory") from None
