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
    place = Path(run_dir).absolute()
    folder = place.parent if place.is_file() else place
    file = folder / _FILE
    return _read(folder.with_name(_FILE) if folder.name == BEST and not file.is_file() else file)


def note(run_dir: str | Path, fields: Mapping[str, Any]) -> None:
    """Adds `fields` to run.json, where they change it. Raises `RunDirectoryError` when it cannot be read or written."""
    file = Path(run_dir) / _FILE
    before = _read(file)
    if (now := {**before, **fields}) != before:
        atomic_write(file, json.dumps(now, indent=2) + "\n")


def _read(file: Path) -> dict[str, Any]:
    if not file.is_file():  # a policy by itself
        return {}
    found = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
    return found if isinstance(found, dict) else {}
