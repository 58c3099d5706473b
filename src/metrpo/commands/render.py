"""`metrpo render` records an episode as a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Render:
    """Record one real episode of a run's policy as a video.

    For example:
        metrpo render runs/Swimmer-fast-seed0
        metrpo render runs/Swimmer-fast-seed0 --out swim.gif --seed 3
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory, its folder best/ (the policy that earned most), zoo:NAME (see: metrpo zoo), or hub:OWNER/NAME
    on the Hugging Face hub."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """File to write, .mp4 or .gif; missing folders are created; default: video.mp4 in the run directory."""
    seed: int = 0
    """Seed of the start state."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """The run's task, if its file or module has moved."""


def run(command: Render) -> int:
    """Returns the exit code."""
    from metrpo.evaluation import render

    print(render(command.dir, command.out, command.seed, command.task))
    return 0
