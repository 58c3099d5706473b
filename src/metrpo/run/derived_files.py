"""What a run directory derives from its newest checkpoint: policies, curve, events, diagnostics and metrics."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from metrpo.config import Config
from metrpo.run import yardstick_record
from metrpo.run.curve import draw_curve
from metrpo.run.files import BEST, atomic_write
from metrpo.run.metrics import Events, Row, details, overview, to_csv
from metrpo.run.newest_checkpoint import Saved
from metrpo.run.policy_file import Learned, save_policy

if TYPE_CHECKING:  # importing a run directory imports no environment
    from metrpo.world.interface import Interface

_log = logging.getLogger("metrpo")
_PATIENCE = 120.0
"""Seconds to write a file derived from a checkpoint; the first curve ever drawn on a machine looks for fonts."""


class DerivedFiles:
    """The files of one run; a picture that cannot be drawn costs a warning, and no more is drawn of its kind."""

    def __init__(self, run_dir: Path, config: Config, interface: Interface | None) -> None:
        self._run_dir, self._config, self._interface = run_dir, config, interface
        self._events: Events | None = None
        self._failed: set[str] = set()

    def write(self, state: Saved, rows: Sequence[Row]) -> None:
        """Writes all of them, for no check tells whether a picture or an event file is damaged.

        Raises `RunDirectoryError` when the policy or the metrics cannot be written.
        """
        self._write_policy(state, rows)
        if not rows:
            return
        self._derive("learning curve", lambda: self._draw_curve(rows))
        self._derive("TensorBoard events", lambda: self._write_events(rows))
        if all(of_parts := [details(row) for row in rows]):
            atomic_write(self._run_dir / "diagnostics.csv", to_csv(of_parts))
        # Last: the rows in this file decide whether a run is finished.
        atomic_write(self._run_dir / "metrics.csv", to_csv([overview(row) for row in rows]))

    def _write_policy(self, state: Saved, rows: Sequence[Row]) -> None:
        result = rows[-1].get("return_real") if rows else None
        result = result if result is not None and math.isfinite(result) else None
        learned = Learned(state.iteration, state.real_steps, result)
        origin = getattr(state, "origin", None)  # baselines have none
        folders = [self._run_dir, self._run_dir / BEST] if _is_best(rows) else [self._run_dir]
        for folder in folders:
            save_policy(folder, state.policy, self._config.task, learned, self._interface, origin, self._config)

    def _draw_curve(self, rows: Sequence[Row]) -> None:
        title = f"{self._config.task}, {self._config.system}, {self._config.preset}, seed {self._config.seed}"
        draw_curve(rows, self._run_dir / "curve.png", title, yardstick_record.kept(self._run_dir))

    def _write_events(self, rows: Sequence[Row]) -> None:
        if self._events is None or not self._events.path.exists():
            self._events = Events(self._run_dir / "events", rows)
        else:
            self._events.add(rows[-1])

    def _derive(self, what: str, write: Callable[[], None]) -> None:
        # A picture that fails, or takes forever, must not cost hours of training.
        if what in self._failed:
            return
        try:
            _within(_PATIENCE, write)
        except Exception as error:
            self._failed.add(what)
            _log.warning("no %s any more (%s: %s); training continues", what, type(error).__name__, error)


def _is_best(rows: Sequence[Row]) -> bool:
    """Whether no policy has earned more than the newest."""
    returns = [value for row in rows if (value := row.get("return_real")) is not None and math.isfinite(value)]
    return bool(returns) and rows[-1].get("return_real") == max(returns)


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
