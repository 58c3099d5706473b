"""`metrpo watch` shows the progress of many runs."""

from __future__ import annotations

import dataclasses
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.options import Switch, require_directories
from metrpo.errors import ConfigError


@dataclass(frozen=True)
class Watch:
    """Show the progress of many runs in a live table: return, warnings, time left, running or stopped.

    Ctrl-C ends the table, not the runs. For example:
        metrpo watch runs
        metrpo watch runs/sweep runs/Swimmer-fast-seed0 --every 30
        metrpo watch runs --once
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR...")]
    """Run directories, or folders with runs inside."""
    every: float = 5.0
    """Seconds between two updates of the table."""
    once: Switch = False
    """Print the table once."""
    json: Switch = False
    """Print JSON once."""

    def __post_init__(self) -> None:
        require_directories("watch", self.dirs)
        if not 0.1 <= self.every < float("inf"):
            raise ConfigError(f"every: expected at least 0.1 seconds, got {self.every}")


def run(command: Watch) -> int:
    """Returns the exit code."""
    from metrpo.console.live_table import watch
    from metrpo.console.run_status import statuses_of
    from metrpo.run.find import find

    if command.json:
        found = find(command.dirs)
        runs = [dataclasses.asdict(run) for run in statuses_of(found.runs)]
        skipped = [{"path": str(path), "why": why} for path, why in found.skipped]
        print(json.dumps({"runs": runs, "skipped": skipped}))
        return 0
    with suppress(KeyboardInterrupt):  # how to end it
        watch(command.dirs, command.every, command.once)
    return 0
