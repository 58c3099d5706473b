"""Runs what a figure of the paper or a grid needs and is missing, each run a `metrpo train` of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from metrpo.config import difference, from_json
from metrpo.counting import counted
from metrpo.experiments.figures import FIGURES, Run, run_of
from metrpo.experiments.local import run_locally
from metrpo.experiments.means import Backend, Means
from metrpo.experiments.on_ray import run_on_ray
from metrpo.experiments.standing import Tell, is_finished, rows_of

BACKENDS: dict[Backend, Callable[[list[Run], Path, Means, Tell], list[Run]]] = {
    "local": run_locally,
    "ray": run_on_ray,
}
"""Name -> what runs all the given runs under a folder, tells of their ends, and returns those that failed."""


def differences(run: Run, out: Path) -> dict[str, tuple[object, object]]:
    """Settings with which the run on disk was made, and others that it would have today."""
    path = out / run.name / "config.json"
    if not path.exists():
        return {}
    return difference(from_json(path.read_text()), run.config)


def runs_there(figure: str, scale: str, tasks: tuple[str, ...], out: Path) -> list[Run]:
    """The runs of a figure that lie under `out`, of any seed; of all its tasks unless `tasks` names some."""
    found = []
    for task in tasks or FIGURES[figure].tasks:
        for system in FIGURES[figure].systems.values():
            numbers = [d.name.removeprefix("seed-") for d in (out / task / system).glob("seed-*/")]
            found += [run_of(scale, task, system, seed) for seed in sorted(int(n) for n in numbers if n.isdecimal())]
    return [run for run in found if rows_of(run, out)]


def reproduce(runs: list[Run], out: Path, means: Means, tell: Tell) -> list[Run]:
    """Runs all that is not finished, several at a time, and returns those that failed, which stop no others.

    Started anew it goes on where it was stopped. Ctrl-C or SIGTERM stops the runs too, each with its iteration
    saved; once more stops them at once.

    Raises `MetrpoError` when `out` cannot be written or the backend is not there.
    """
    missing = [run for run in runs if not is_finished(run, out)]
    tell(f"{len(runs) - len(missing)} of {counted(len(runs), 'run')} are finished; {len(missing)} to go")
    return BACKENDS[means.backend](missing, out, means, tell) if missing else []
