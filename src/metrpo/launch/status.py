"""The status of a run, read off its directory, and the reports of its end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from metrpo import budget
from metrpo.console.result_lines import duration, earned
from metrpo.launch.run_spec import RunSpec
from metrpo.run.metrics import Row, read_metrics

Tell = Callable[[str], None]
_TAIL = 5
"""Number of log lines shown of a failed run."""


def rows_of(run: RunSpec, out: Path) -> list[Row]:
    """The run's rows of metrics so far; none when it has not begun."""
    metrics = out / run.name / "metrics.csv"
    return read_metrics(metrics) if metrics.exists() else []


def is_finished(run: RunSpec, out: Path) -> bool:
    """Whether the run has spent its budget, by its metrics alone; it needs no checkpoints."""
    return has_spent(run, rows_of(run, out))


def has_spent(run: RunSpec, rows: Sequence[Row]) -> bool:
    """Whether these rows are a whole run's."""
    return budget.spent(run.config, rows)


def standing(run: RunSpec, rows: Sequence[Row]) -> str:
    """How far the run is."""
    if not rows:
        return "in its first iteration"
    last, config = rows[-1], run.config
    of_steps = f" of {config.real_steps:,}" if config.real_steps else ""
    of_iterations = "" if config.real_steps else f"/{config.iterations}"
    return f"iteration {last['iteration']}{of_iterations}, {last['real_steps']:,}{of_steps} real steps, {earned(last)}"


def words(run: RunSpec, directory: Path) -> list[str]:
    """The words after `python -m metrpo` that start the run in `directory`, or resume it there."""
    return ["train", *run.arguments, "--run-dir", str(directory), "--no-video"]


def log_of(run: RunSpec, out: Path) -> Path:
    """The file of a run's log."""
    return out / f"{run.name}.log"


def tail(log: Path) -> list[str]:
    """The last lines of a run's log."""
    return log.read_text(errors="replace").splitlines()[-_TAIL:]


def tell_success(run: RunSpec, count: str, rows: Sequence[Row], seconds: float, tell: Tell) -> None:
    """Reports that a run is finished."""
    tell(f"[{count}] {run.name}: {standing(run, rows)}, in {duration(seconds)}")


def tell_failure(run: RunSpec, count: str, why: str, lines: Sequence[str], tell: Tell) -> None:
    """Reports that a run failed, and the last lines of its log."""
    tell(f"[{count}] {run.name}: FAILED {why}")
    for line in lines:
        tell(f"      {line}")
