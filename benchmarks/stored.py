"""A stored run, for the tools beside this file."""

from __future__ import annotations

import sys
from pathlib import Path

from metrpo import State, config, init
from metrpo.config import Config
from metrpo.run.checkpoint import load_state


def newest_of(run_dir: Path) -> tuple[Config, State]:
    """Settings and newest state of a run, whose directory stays as it is: it may be in use.

    Exits where there is no checkpoint.
    """
    found = sorted((run_dir / "checkpoints").glob("*.npz"))
    if not found:
        sys.exit(f"{run_dir}: expected a run with a checkpoint, got none")
    settings = config.from_json((run_dir / "config.json").read_text())
    return settings, load_state(found[-1], init(settings))[0]
