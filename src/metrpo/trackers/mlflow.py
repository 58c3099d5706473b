"""MLflow; its own variables say where the runs go (`MLFLOW_TRACKING_URI`) and in which experiment they are."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from metrpo.trackers.common import PROJECT, Tracker


class MLflow(Tracker):
    """A run of MLflow."""

    name = "mlflow"

    def start(self, title: str, settings: dict[str, Any], run_dir: Path | None, earlier: str | None) -> str | None:
        """As `Tracker.start`."""
        import mlflow

        self._mlflow = mlflow
        if "MLFLOW_EXPERIMENT_NAME" not in os.environ and "MLFLOW_EXPERIMENT_ID" not in os.environ:
            mlflow.set_experiment(PROJECT)
        run = mlflow.start_run(run_id=earlier, run_name=None if earlier else title)
        if earlier is None:
            mlflow.log_params(settings)
        return str(run.info.run_id)

    def log(self, numbers: dict[str, float], iteration: int) -> None:
        """As `Tracker.log`."""
        self._mlflow.log_metrics(numbers, step=iteration)

    def on_end(self) -> None:
        """Ends the run."""
        self._mlflow.end_run()
