"""Weights & Biases.

`WANDB_MODE=offline` keeps all on this machine, `WANDB_PROJECT` names another project, `WANDB_DIR` another folder.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from metrpo.trackers.common import PROJECT, Tracker


class Wandb(Tracker):
    """A run of Weights & Biases, whose files lie in the run directory, unless `WANDB_DIR` says otherwise."""

    name = "wandb"

    def start(self, title: str, settings: dict[str, Any], run_dir: Path | None, earlier: str | None) -> str | None:
        """As `Tracker.start`."""
        import wandb

        more: dict[str, Any] = {} if earlier is None else {"id": earlier, "resume": "allow"}
        project, folder = os.environ.get("WANDB_PROJECT", PROJECT), os.environ.get("WANDB_DIR", run_dir)
        self._run: Any = wandb.init(project=project, name=title, config=settings, dir=folder, **more)
        return str(self._run.id)

    def log(self, numbers: dict[str, float], iteration: int) -> None:
        """As `Tracker.log`."""
        self._run.log(numbers, step=iteration)

    def on_end(self) -> None:
        """Ends the run."""
        self._run.finish()
