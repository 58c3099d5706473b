"""What a run notes about itself in run.json, beside its format and versions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from metrpo.errors import RunDirectoryError
from metrpo.run.files import BEST, atomic_write
from metrpo.safe_load import json_of, text_of

_FILE = "run.json"


def about(run_dir: str | Path) -> dict[str, Any]:
    """All that run.json holds; nothing where there is none. A policy's file and the folder best/ lead to their run's.

    Raises `RunDirectoryError` when it is damaged.
    """
    folder = Path(run_dir).parent if Path(run_dir).suffix == ".npz" else Path(run_dir)
    file = folder / _FILE
    if folder.name == BEST and not file.is_file():
        file = folder.with_name(_FILE)
    if not file.is_file():  # a policy by itself
        return {}
    found = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
    return found if isinstance(found, dict) else {}


def note(run_dir: str | Path, fields: Mapping[str, Any]) -> None:
    """Adds `fields` to run.json, where they change it. Raises `RunDirectoryError` when it cannot be read or written."""
    before = about(run_dir)
    if (now := {**before, **fields}) != before:
        atomic_write(Path(run_dir) / _FILE, json.dumps(now, indent=2) + "\n")
