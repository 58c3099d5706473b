"""`metrpo sweep` runs a grid of tasks, seeds and settings."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import OmitArgPrefixes, Positional, arg

from metrpo.commands.attend import attended_runs
from metrpo.commands.options import Switch
from metrpo.commands.output import exit_code, printer
from metrpo.config import Preset, System
from metrpo.counting import counted
from metrpo.launch.backend import Means

if TYPE_CHECKING:
    from metrpo.launch.grid import Grid


@dataclass(frozen=True)
class Sweep:
    """Run a grid: every task with every system, seed and combination of settings, each an ordinary `metrpo train`.

    Finished runs are kept, stopped ones resume, and a run that fails does not stop
    the others. Give lists at once (--set A B) or one by one (--set A --set B).
    For example:
        metrpo sweep --tasks Swimmer HalfCheetah --seeds 0:5 --out runs/seeds
        metrpo sweep --set ensemble.members=1,5,10 trpo.max_kl=0.01,0.03 --jobs 4
        metrpo sweep --systems me-trpo trpo --real-steps 30000 --budget trpo=300000
        metrpo sweep grid.toml --dry-run
        metrpo sweep grid.toml --backend ray --out /shared/sweep

    where grid.toml holds, say:
        tasks = ["Swimmer"]
        seeds = "0:3"
        budget.me-trpo = 30000
        set.ensemble.members = [1, 5, 10]
    """

    spec: Annotated[Positional[Path | None], arg(metavar="SPEC")] = None
    """The grid as a TOML file, instead of options: tasks, systems, seeds, iterations or real_steps, preset, and tables
    [budget] and [set]."""
    tasks: Annotated[tuple[str, ...], arg(metavar="TASK...")] = ("Swimmer",)
    """Tasks, as metrpo train takes them."""
    systems: Annotated[tuple[System, ...], arg(metavar="NAME...")] = ()
    """Systems, as metrpo train takes them; default: the one that it takes for each task."""
    seeds: Annotated[tuple[str, ...], arg(metavar="SEEDS...")] = ("0:3",)
    """Seeds: numbers, ranges such as 0:5 (0 to 4), or lists such as 0,2,7."""
    iterations: Annotated[int | None, arg(metavar="INT")] = None
    """Outer iterations of every run; default: the preset's. Raise it later to continue finished runs."""
    real_steps: Annotated[int | None, arg(metavar="INT")] = None
    """Instead of --iterations: real steps of every run."""
    budget: Annotated[tuple[str, ...], arg(metavar="SYSTEM=STEPS...")] = ()
    """Real steps for the runs of single systems, instead of the above: trpo=300000 ppo=300000."""
    preset: Preset = "fast"
    """The defaults of all other settings."""
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUES...")] = ()
    """Settings and their values: ensemble.members=1,5,10 or ensemble.hidden=[200,200],[512]."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/sweep")
    """Folder for the runs: <task>/<system>,<setting>=<value>/seed-<seed>."""
    dry_run: Switch = False
    """Only list the runs."""
    means: Annotated[Means, OmitArgPrefixes] = field(default_factory=Means)
    APART: ClassVar[tuple[str, ...]] = ("spec", "out", "dry_run", "means")
    """Not in the file."""


def run(command: Sweep) -> int:
    """Returns the exit code: 1 where a run failed."""
    from metrpo.launch.dispatch import dispatch
    from metrpo.launch.grid import from_file

    runs = (grid_of(command) if command.spec is None else from_file(command.spec)).runs()
    print(f"{command.out}: {counted(len(runs), 'run')}", flush=True)
    if command.dry_run:
        for run in runs:
            print(f"{run.name}:  metrpo train {shlex.join(run.arguments)}")
        return 0
    with attended_runs(command.out):
        failed = dispatch(runs, command.out, command.means, printer())
    return exit_code(len(failed), len(runs), "run", "the same command tries them again")


def grid_of(command: Sweep) -> Grid:
    """The grid that the options describe. Raises `ConfigError` if they describe none."""
    from metrpo.launch.grid import Grid, budget_of, require_once, seeds_of, values_of

    settings, budgets = [values_of(text) for text in command.set], [budget_of(text) for text in command.budget]
    require_once("set", [name for name, _ in settings])
    require_once("budget", [name for name, _ in budgets])
    return Grid(
        command.tasks,
        command.systems,
        seeds_of(",".join(command.seeds)),
        command.preset,
        dict(settings),
        command.iterations,
        command.real_steps,
        dict(budgets),
    )
