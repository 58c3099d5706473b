"""`metrpo evaluate` plays real episodes with a policy."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.options import Switch
from metrpo.counting import counted


@dataclass(frozen=True)
class Evaluate:
    """Play real episodes with a run's policy, without noise, and report their returns.

    For example:
        metrpo evaluate runs/Swimmer-fast-seed0
        metrpo evaluate runs/Swimmer-fast-seed0 --episodes 100 --seed 7 --json
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory, its folder best/ (the policy that earned most), zoo:NAME (see: metrpo zoo), or hub:OWNER/NAME
    on the Hugging Face hub."""
    episodes: int = 20
    """Number of episodes."""
    seed: int = 0
    """Seed of the start states."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """The run's task, if its file or module has moved; needed for a policy from the hub whose task is code. May also
    name another task of the same sizes."""
    json: Switch = False
    """Print JSON."""


def run(command: Evaluate) -> int:
    """Returns the exit code."""
    from metrpo.evaluation import evaluate

    result = evaluate(command.dir, command.task, command.episodes, command.seed).summary()
    text = "{task}: return {mean:.2f} ± {std:.2f} (min {min:.2f}, max {max:.2f}) over {over}, seed {seed}"
    over = counted(result["episodes"], "episode")
    print(json.dumps(result) if command.json else text.format(**result, over=over))
    return 0
