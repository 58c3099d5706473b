"""Where a run stands, read off its directory, and the words in which its end is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from metrpo import budget
from metrpo.console.progress import duration, earned
from metrpo.launch.run_spec import RunSpec
from metrpo.run.metrics import Row, read_metrics

Tell = Callable[[str], None]
_TAIL = 5
"""Lines of a failed run's log that are shown."""


def rows_of(run: RunSpec, out: Path) -> list[Row]:
    """What the run has measured so far; nothing when it has not begun."""
    metrics = out / run.name / "metrics.csv"
    return read_metrics(metrics) if metrics.exists() else []


def is_finished(run: RunSpec, out: Path) -> bool:
    """Whether the run has spent its budget: its metrics alone say so, checkpoints need not be there."""
    return has_spent(run, rows_of(run, out))


def has_spent(run: RunSpec, rows: Sequence[Row]) -> bool:
    """Whether these rows are the whole run's."""
    return budget.spent(run.config, rows)


def standing(run: RunSpec, rows: Sequence[Row]) -> str:
    """How far the run has got."""
    if not rows:
        return "in its first iteration"
    last, config = rows[-1], run.config
    of_steps = f" of {config.real_steps:,}" if config.real_steps else ""
    of_iterations = "" if config.real_steps else f"/{config.iterations}"
    return f"iteration {last['iteration']}{of_iterations}, {last['real_steps']:,}{of_steps} real steps, {earned(last)}"


def words(run: RunSpec, directory: Path) -> list[str]:
    """What follows `python -m metrpo` to run it in `directory`, or to go on there."""
    return ["train", *run.arguments, "--run-dir", str(directory), "--no-video"]


def log_of(run: RunSpec, out: Path) -> Path:
    """Where what a run says is kept."""
    return out / f"{run.name}.log"


def tail(log: Path) -> list[str]:
    """The last words of a run."""
    return log.read_text(errors="replace").splitlines()[-_TAIL:]


def tell_success(run: RunSpec, count: str, rows: Sequence[Row], seconds: float, tell: Tell) -> None:
    """Tells that a run is finished."""
    tell(f"[{count}] {run.name}: {standing(run, rows)}, in {duration(seconds)}")


def tell_failure(run: RunSpec, count: str, why: str, lines: Sequence[str], tell: Tell) -> None:
    """Tells that a run has failed, and its last words."""
    tell(f"[{count}] {run.name}: FAILED {why}")
    for line in lines:
        tell(f"      {line}")
