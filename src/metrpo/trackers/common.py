"""What the trackers share: one shape of a run's name, its settings and its numbers, and what they note in run.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from metrpo.callbacks import Callback, IterationRow
from metrpo.config import Config, flatten
from metrpo.run.about import about, note
from metrpo.run.metrics import overview

PROJECT = "metrpo"
"""Project or experiment of the runs, unless the tracker's own variable says another."""


class Tracker(Callback):
    """A callback that logs rows; one that goes on with a run finds its own run of before by what `start` returned."""

    name: str

    def start(self, title: str, settings: dict[str, Any], run_dir: Path | None, earlier: str | None) -> str | None:
        """Begins a run, or goes on with the run `earlier`; returns what finds it again (None: nothing does)."""
        raise NotImplementedError

    def log(self, numbers: dict[str, float], iteration: int) -> None:
        """Logs an iteration's numbers."""
        raise NotImplementedError

    def on_begin(self, config: Config, run_dir: Path | None, rows: Sequence[IterationRow]) -> None:
        """Begins, with the rows that the tracker has not had; or goes on."""
        noted = about(run_dir) if run_dir is not None else {}
        earlier = noted.get(f"tracked_by_{self.name}")
        earlier = earlier if isinstance(earlier, str) else None
        title = run_dir.resolve().name if run_dir is not None else f"{config.task}-seed{config.seed}"
        found = self.start(title, _plain(flatten(config)), run_dir, earlier)
        if found is not None and run_dir is not None:
            note(run_dir, {f"tracked_by_{self.name}": found})
        for row in rows if earlier is None else ():
            self.on_iteration(row)

    def on_iteration(self, row: IterationRow) -> None:
        """Logs it."""
        self.log(numbers_of(row), int(row["iteration"] or 0))


def numbers_of(row: IterationRow) -> dict[str, float]:
    """A row's finite numbers by column; not those of single models and dimensions."""
    found = overview(dict(row))
    return {name: float(value) for name, value in found.items() if value is not None and math.isfinite(value)}


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in settings.items()}
