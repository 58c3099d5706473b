"""Trackio: a local dashboard (`trackio show`), or a Space where `TRACKIO_SPACE_ID` names one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from metrpo.trackers.common import PROJECT, Tracker


class Trackio(Tracker):
    """A run of Trackio, known by its name."""

    name = "trackio"

    def start(self, title: str, settings: dict[str, Any], run_dir: Path | None, earlier: str | None) -> str | None:
        """As `Tracker.start`."""
        import trackio

        self._trackio = trackio
        project = os.environ.get("TRACKIO_PROJECT", PROJECT)
        resume = "never" if earlier is None else "allow"
        run = trackio.init(project=project, name=earlier or title, config=settings, resume=resume, embed=False)
        return str(run.name)

    def log(self, numbers: dict[str, float], iteration: int) -> None:
        """As `Tracker.log`."""
        self._trackio.log(numbers, step=iteration)

    def on_end(self) -> None:
        """Ends the run."""
        self._trackio.finish()
