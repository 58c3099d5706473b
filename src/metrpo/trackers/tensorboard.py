"""TensorBoard: a run directory has its events in any case; without one they go to runs/events/NAME."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from metrpo.trackers.common import Tracker


class TensorBoard(Tracker):
    """Events with the settings as text, where there is no run directory that has them already."""

    name = "tensorboard"
    _writer: Any = None

    def start(self, title: str, settings: dict[str, Any], run_dir: Path | None, earlier: str | None) -> str | None:
        """As `Tracker.start`."""
        if run_dir is None:
            from tensorboardX import SummaryWriter

            self._writer = SummaryWriter(f"runs/events/{title}")
            self._writer.add_text("settings", "  \n".join(f"{name} = {value}" for name, value in settings.items()))
        return None

    def log(self, numbers: dict[str, float], iteration: int) -> None:
        """As `Tracker.log`."""
        for name, value in numbers.items() if self._writer is not None else ():
            self._writer.add_scalar(name, value, iteration)

    def on_end(self) -> None:
        """Writes what is left."""
        if self._writer is not None:
            self._writer.close()
