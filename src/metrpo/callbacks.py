"""Callbacks: a program receives each row of metrics, real episode and checkpoint during training."""

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
    """Subclass it and override the methods that you need; the others do nothing.

    An exception in a callback gives a warning, and that callback is not called again: training must not fail by it.
    """

    def on_begin(self, config: Config, run_dir: Path | None, rows: Sequence[IterationRow]) -> None:
        """Training begins, or resumes after the iterations in `rows`."""

    def on_episode(self, episode: Episode) -> None:
        """One more real episode has been played, exploring or as a proof (only where the method learns models).

        Its states hold the run's history (`config.history`); the newest observation comes first.
        """

    def on_iteration(self, row: IterationRow) -> None:
        """An outer iteration is finished, with this row of `metrics.csv`."""

    def on_checkpoint(self, checkpoint: Path) -> None:
        """The iteration is saved in this file; only with a run directory."""

    def on_end(self) -> None:
        """Training has ended, finished or not."""


class Callbacks(Callback):
    """Several callbacks; one that fails gives one warning and is not called again."""

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
                _log.warning("%s failed and is not called again (%s); training continues", type(one).__name__, why)


class _Telling:
    """A log of episodes that passes each new one to the callbacks."""

    def __init__(self, log: Log, callbacks: Callbacks) -> None:
        self._log, self._callbacks = log, callbacks
        self.pending, self.proofs = log.pending, log.proofs
        self.failures, self.note_failures = log.failures, log.note_failures

    def append(self, episode: Episode, proof: bool = False) -> object:
        """Keeps it, and passes it on."""
        kept = self._log.append(episode, proof)
        self._callbacks.on_episode(episode)
        return kept
