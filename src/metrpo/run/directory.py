"""A run directory: one run's settings, checkpoints, metrics, policy and curve, written by one process at a time.

    DIR/run.json       format and versions         DIR/metrics.csv      one row per outer iteration
    DIR/config.json    every setting               DIR/diagnostics.csv  the same for each model and state dimension
    DIR/checkpoints/   the newest two states       DIR/policy.npz       the policy (policy.json says what it is)
    DIR/events/        TensorBoard                 DIR/curve.png        the learning curve
    DIR/video.mp4      the final policy at work    DIR/best/            the policy that earned most when evaluated
    DIR/episodes/      real episodes that the state has not learned from (see `metrpo.run.episodes`)

The newest checkpoint is the run: it holds the state and all rows. Everything else is derived from it (best/ from an
earlier one), written after it and again when the run is resumed, so that a kill at any moment leaves nothing twice and
nothing missing.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from metrpo import config as configs
from metrpo.config import Config
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.history import History
from metrpo.run.checkpoint import save_state
from metrpo.run.derived_files import DerivedFiles
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import atomic_write, inside
from metrpo.run.lock import claim
from metrpo.run.metrics import Row, completed, plain, read_metrics, to_csv, without_clocks
from metrpo.run.newest_checkpoint import Saved, State, checkpoints, file_of, iteration_of, load_newest
from metrpo.safe_load import text_of

if TYPE_CHECKING:  # importing a run directory imports no environment
    from metrpo.world.interface import Interface

_log = logging.getLogger("metrpo")
_KEPT = 2
"""Number of checkpoints that stay."""


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
    episodes: EpisodeLog
    """Real episodes, on disk as soon as they end."""

    def __init__(self, path: str | Path, config: Config, interface: Interface | None = None) -> None:
        self.path, self.config, self.rows = Path(path), config, []
        self._lock = claim(self.path, config)
        self.episodes, self._taken = EpisodeLog(self.path, writer="run"), [0]
        self._opened, self._wall_seconds_before = time.monotonic(), 0.0
        self._derived = DerivedFiles(self.path, config, interface)

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
        found = checkpoints(self.path)
        layers = template.policy.layers
        self.episodes.layout = History.of_state(self.config.history, layers[0][0].shape[0], layers[-1][0].shape[1])
        if not found:
            self._require_fresh()
            self._write_config()
            return None
        state, meta = load_newest(self.path, template, self.config)
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
        return checkpoints(self.path)[-1]

    def _write_checkpoint(self, state: Saved, rows: list[Row], taken: int) -> None:
        meta = {"iteration": state.iteration, "config": configs.to_json(self.config), "rows": rows}
        save_state(file_of(self.path, state.iteration), state, {**meta, "episodes": taken})

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
            if finished > iteration_of(newest):
                lost = file_of(self.path, finished).name
                _log.warning("%s has lost its checkpoint %s; resuming from an earlier one", self.path, lost)

    def _write_config(self) -> None:
        # The budget may have changed since last time.
        atomic_write(self.path / "config.json", configs.to_json(self.config))

    def _publish(self, state: Saved) -> None:
        for old in checkpoints(self.path)[:-_KEPT]:
            with contextlib.suppress(OSError):  # costs room only
                old.unlink()
        self._derived.write(state, self.rows)


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
