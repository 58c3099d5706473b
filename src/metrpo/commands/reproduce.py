"""`metrpo reproduce` runs and draws a figure of the paper."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from metrpo.commands.attend import attended_runs
from metrpo.commands.options import Switch, require_at_least_one
from metrpo.commands.output import exit_code, printer
from metrpo.launch.backend import Means


@dataclass(frozen=True)
class Reproduce:
    """Run the comparison behind a figure of the paper, and draw it. Every run is an ordinary `metrpo train`.

    FIGURE is comparison, optimizers, ensemble-size, overfitting, sampling, validation, wall-clock, or all. Finished
    runs are kept, stopped ones resume, and the figure shows all runs so far. For example:
        metrpo reproduce all --scale smoke
        metrpo reproduce optimizers --tasks Swimmer --seeds 3 --jobs 2
        metrpo reproduce all --scale laptop --no-run
        metrpo reproduce all --scale paper --backend ray --out /shared/paper
    """

    figure: Annotated[Positional[str], arg(metavar="FIGURE")]
    """Which figure, or all."""
    scale: Literal["smoke", "laptop", "paper"] = "laptop"
    """smoke: takes minutes, learns nothing; laptop: days on two cores; paper: as in the paper, weeks on two cores."""
    tasks: tuple[str, ...] = ()
    """Only these tasks of the figure; default: the scale's."""
    seeds: Annotated[int | None, arg(metavar="INT")] = None
    """Seeds 0, 1, ... of each system; default: the scale's."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the runs and for figures/; default: runs/reproduce-<scale>."""
    run: Annotated[Switch, arg(help="Run nothing; draw the runs so far.")] = True
    json: Switch = False
    """Print the figures' numbers as JSON."""
    means: Annotated[Means, OmitArgPrefixes] = field(default_factory=Means)

    def __post_init__(self) -> None:
        require_at_least_one("seeds", self.seeds)


def run(command: Reproduce) -> int:
    """Returns the exit code: 1 where a run failed."""
    from metrpo.launch.dispatch import dispatch
    from metrpo.paper.figures import FIGURES, runs_of
    from metrpo.paper.publish import publish

    runs = runs_of(command.figure, command.scale, command.tasks, command.seeds)
    out = command.out or Path("runs") / f"reproduce-{command.scale}"
    names = list(FIGURES) if command.figure == "all" else [command.figure]
    tell = printer(command.json)
    with attended_runs(out):
        failed = dispatch(runs, out, command.means, tell) if command.run else []
    numbers = publish(names, command.scale, command.tasks, runs, out, tell)
    if command.json:
        print(json.dumps(numbers))
    return exit_code(len(failed), len(runs), "run", "the same command tries them again")
