"""What a program may do as a run goes on: a callback hears of each row of metrics, real episode and checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from metrpo.config import Config
from metrpo.stages.log import Log
from metrpo.types import Episode

_log = logging.getLogger("metrpo")
IterationRow = Mapping[str, int | float | None]


class Callback(Protocol):
    """Subclass it and override what you want to hear of; what you leave out does nothing.

    What a callback raises costs a warning, and that callback is called no more: it may not cost what is learned.
    """

    def on_begin(self, config: Config, run_dir: Path | None, rows: Sequence[IterationRow]) -> None:
        """Training begins, or goes on after the iterations in `rows`."""

    def on_episode(self, episode: Episode) -> None:
        """One more real episode has been played, exploring or as a proof (only where the method learns models).

        Its states hold the run's history (`config.history`); the newest observation comes first.
        """

    def on_iteration(self, row: IterationRow) -> None:
        """An outer iteration is finished, with this row of `metrics.csv`."""

    def on_checkpoint(self, checkpoint: Path) -> None:
        """It is saved in this file; only with a run directory."""

    def on_end(self) -> None:
        """Training has ended, finished or not."""


class Callbacks(Callback):
    """Several callbacks, of which one that fails is warned of once and called no more."""

    def __init__(self, callbacks: Sequence[Callback]) -> None:
        self._callbacks = list(callbacks)

    def on_begin(self, config: Config, run_dir: Path | None, rows: Sequence[IterationRow]) -> None:
        """Passed on."""
        self._tell(lambda one: one.on_begin(config, run_dir, rows))

    def on_episode(self, episode: Episode) -> None:
        """Passed on."""
        self._tell(lambda one: one.on_episode(episode))

    def on_iteration(self, row: IterationRow) -> None:
        """Passed on."""
        self._tell(lambda one: one.on_iteration(row))

    def on_checkpoint(self, checkpoint: Path) -> None:
        """Passed on."""
        self._tell(lambda one: one.on_checkpoint(checkpoint))

    def on_end(self) -> None:
        """Passed on."""
        self._tell(lambda one: one.on_end())

    def log(self, log: Log) -> Log:
        """A log of episodes that tells the callbacks of each one."""
        return _Telling(log, self) if self._callbacks else log

    def _tell(self, what: Callable[[Callback], None]) -> None:
        for one in list(self._callbacks):
            try:
                what(one)
            except Exception as error:  # whatever somebody's code raises
                self._callbacks.remove(one)
                why = f"{type(error).__name__}: {error}"
                _log.warning("%s is called no more (%s); training goes on", type(one).__name__, why)


class _Telling:
    """A log of episodes that tells of each one that is added."""

    def __init__(self, log: Log, callbacks: Callbacks) -> None:
        self._log, self._callbacks = log, callbacks
        self.pending, self.proofs = log.pending, log.proofs
        self.failures, self.note_failures = log.failures, log.note_failures

    def append(self, episode: Episode, proof: bool = False) -> object:
        """Keeps it, and tells of it."""
        kept = self._log.append(episode, proof)
        self._callbacks.on_episode(episode)
        return kept
