"""`metrpo collect` adds real episodes to a run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.attend import attended_run
from metrpo.commands.options import Switch, require_at_least_one
from metrpo.counting import counted


@dataclass(frozen=True)
class Collect:
    """Add real episodes to a run. Its next iteration learns from them.

    Plays the task's environment with exploration, or takes recorded episodes. Each episode is saved as soon as it
    ends, so the same command resumes a stopped collection. For example:
        metrpo collect runs/arm
        metrpo collect runs/arm --steps 1000
        metrpo collect runs/arm --data today.npz
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    steps: Annotated[int | None, arg(metavar="INT")] = None
    """Play until at least this many new steps wait to be learned from; default: as many as
    its next iteration collects."""
    data: Annotated[str | None, arg(metavar="FILE")] = None
    """Instead of playing: minari:NAME, or an .npz of states, actions, rewards, next_states, terminated."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """The run's task, if its file or module has moved."""
    json: Switch = False
    """Print JSON."""

    def __post_init__(self) -> None:
        require_at_least_one("steps", self.steps)


def run(command: Collect) -> int:
    """Returns the exit code."""
    from metrpo.run import machine

    machine.prepare(None, deterministic=False)
    from metrpo.console.progress import SILENT, default_progress
    from metrpo.external import collect

    with attended_run(command.dir, SILENT if command.json else default_progress()) as progress:
        waiting = collect(command.dir, command.steps, command.data, progress, command.task)
    episodes, steps = len(waiting), sum(len(e.rewards) for e in waiting)
    mean = sum(float(e.rewards.sum()) for e in waiting) / max(episodes, 1)
    if command.json:
        print(json.dumps({"episodes": episodes, "steps": steps, "return": mean}))
        return 0
    wait = f"{counted(episodes, 'episode')} of {counted(steps, 'step')} {'waits' if episodes == 1 else 'wait'}"
    print(f"{wait}, mean return {mean:.1f}; next: metrpo improve {command.dir}")
    return 0
