"""`metrpo improve` learns from a run's new episodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.attend import attended_run
from metrpo.commands.options import Switch
from metrpo.commands.output import as_json
from metrpo.console.interrupt import Interruptible


@dataclass(frozen=True)
class Improve:
    """Learn from a run's new episodes, in one iteration: fit the models, improve the policy and save it.

    For example:
        metrpo improve runs/arm
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """The run's task, if its file or module has moved."""
    json: Switch = False
    """Print the iteration's metrics as JSON."""


def run(command: Improve) -> int:
    """Returns the exit code."""
    from metrpo.run import machine
    from metrpo.run.directory import stored_config

    machine.prepare(None, stored_config(command.dir).deterministic)
    from metrpo.console.progress import SILENT, default_progress
    from metrpo.external import improve
    from metrpo.run.policy_file import FILE

    def complete(progress: Interruptible) -> str | None:
        note = f"{command.dir} has learned from the new episodes: nothing is lost, and nothing is left to do."
        return note if progress.ended else None

    with attended_run(command.dir, SILENT if command.json else default_progress(), complete=complete) as progress:
        row = improve(command.dir, progress, command.task)
    print(as_json(row) if command.json else f"  policy   {command.dir / FILE}")
    return 0
