"""What a run notes about itself in run.json, beside its format and versions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from metrpo.errors import RunDirectoryError
from metrpo.run.files import atomic_write
from metrpo.safe_load import json_of, text_of

_FILE = "run.json"


def about(run_dir: str | Path) -> dict[str, Any]:
    """All that run.json holds; nothing where there is none. Raises `RunDirectoryError` when it is damaged."""
    file = Path(run_dir) / _FILE
    if not file.is_file():  # a policy by itself
        return {}
    found = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
    return found if isinstance(found, dict) else {}


def note(run_dir: str | Path, fields: Mapping[str, Any]) -> None:
    """Adds `fields` to run.json, where they change it. Raises `RunDirectoryError` when it cannot be read or written."""
    before = about(run_dir)
    if (now := {**before, **fields}) != before:
        atomic_write(Path(run_dir) / _FILE, json.dumps(now, indent=2) + "\n")
