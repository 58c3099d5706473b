"""What no skill earns on a run's task, as its run.json keeps it (measured by `metrpo.world.yardsticks`)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from metrpo.errors import RunDirectoryError
from metrpo.run.files import atomic_write
from metrpo.safe_load import json_of, text_of

NAMES = {"zero": "doing nothing", "random": "random actions"}


def keep(run_dir: Path, task: str, record: Mapping[str, Any]) -> None:
    """Adds the record of `task` to run.json. Raises `RunDirectoryError` when it cannot be written."""
    file = run_dir / "run.json"
    about = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
    atomic_write(file, json.dumps({**about, "yardsticks": {"task": task, **record}}, indent=2) + "\n")


def are_kept(run_dir: Path, task: str) -> bool:
    """Whether they have been measured: of this task, for a directory that lost nothing may be another's now."""
    file = run_dir / "run.json"
    about = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
    record = about.get("yardsticks")
    return bool(kept(run_dir)) and record.get("task") == task


def kept(run_dir: Path) -> dict[str, float]:
    """Mean return of each way to act, by its name; empty where nothing was measured or run.json cannot be read."""
    file = run_dir / "run.json"
    try:
        record = json_of(text_of(file, RunDirectoryError), str(file), RunDirectoryError)["yardsticks"]
        means = {name: float(record[key]["mean"]) for key, name in NAMES.items()}
    except (RunDirectoryError, OSError, KeyError, TypeError, ValueError):
        return {}
    return means if all(map(math.isfinite, means.values())) else {}
