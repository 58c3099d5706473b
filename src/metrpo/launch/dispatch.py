"""Runs the missing runs of a figure of the paper or of a grid, each as its own `metrpo train`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from metrpo.config import difference, from_json
from metrpo.counting import counted
from metrpo.launch.backend import Backend, Means
from metrpo.launch.local import run_locally
from metrpo.launch.ray.driver import run_on_ray
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import Tell, is_finished

BACKENDS: dict[Backend, Callable[[list[RunSpec], Path, Means, Tell], list[RunSpec]]] = {
    "local": run_locally,
    "ray": run_on_ray,
}
"""Name -> function that runs all runs under a folder, reports how they end, and returns those that failed."""


def differences(run: RunSpec, out: Path) -> dict[str, tuple[object, object]]:
    """Settings in which the run on disk differs from `run`."""
    path = out / run.name / "config.json"
    if not path.exists():
        return {}
    return difference(from_json(path.read_text()), run.config)


def dispatch(runs: list[RunSpec], out: Path, means: Means, tell: Tell) -> list[RunSpec]:
    """Runs all unfinished runs, several at a time, and returns those that failed; these do not stop the others.

    Started again, it resumes where it was stopped. Ctrl-C or SIGTERM stops the runs too, each with its iteration
    saved; a second one stops them at once.

    Raises `MetrpoError` when `out` cannot be written or the backend is not there.
    """
    missing = [run for run in runs if not is_finished(run, out)]
    tell(f"{len(runs) - len(missing)} of {counted(len(runs), 'run')} are finished; {len(missing)} to go")
    return BACKENDS[means.backend](missing, out, means, tell) if missing else []
