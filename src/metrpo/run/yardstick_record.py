"""What no skill earns on a run's task, as its run.json keeps it (measured by `metrpo.world.yardsticks`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from metrpo.errors import RunDirectoryError
from metrpo.run.about import about, note

NAMES = {"zero": "doing nothing", "random": "random actions"}


def keep(run_dir: Path, task: str, record: Mapping[str, Any]) -> None:
    """Adds the record of `task` to run.json. Raises `RunDirectoryError` when it cannot be written."""
    note(run_dir, {"yardsticks": {"task": task, **record}})


def are_kept(run_dir: Path, task: str) -> bool:
    """Whether they have been measured: of this task, for a directory that lost nothing may be another's now."""
    return bool(kept(run_dir)) and about(run_dir)["yardsticks"].get("task") == task


def kept(run_dir: Path) -> dict[str, float]:
    """Mean return of each way to act, by its name; empty where nothing was measured or run.json cannot be read."""
    try:
        record = about(run_dir)["yardsticks"]
        means = {name: float(record[key]["mean"]) for key, name in NAMES.items()}
    except (RunDirectoryError, OSError, KeyError, TypeError, ValueError):
        return {}
    return means if all(map(math.isfinite, means.values())) else {}
