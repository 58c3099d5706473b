"""`metrpo tune` searches over settings."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

from tyro.conf import Positional, arg

from metrpo.commands.attend import attended_runs
from metrpo.commands.options import Switch, require_at_least_one
from metrpo.commands.output import exit_code, printer
from metrpo.config import Preset, System
from metrpo.errors import ConfigError

if TYPE_CHECKING:
    from metrpo.tune.search import Search


@dataclass(frozen=True)
class Tune:
    """Search over settings with Optuna. Trials are ordinary runs; a low real return stops bad ones early.

    Give several seeds: one run's return is noisy. The same command resumes. Needs: pip install 'metrpo[tune]'.
    For example:
        metrpo tune --search "trpo.max_kl=log 0.003..0.1" ensemble.members=1,3,5
        metrpo tune --search "validate.patience=10..50 step 10" --dry-run
        metrpo tune search.toml --jobs 2 --out runs/tune-Swimmer

    where search.toml holds, say:
        task = "Swimmer"
        trials = 30
        real_steps = 15000
        search.trpo.max_kl = "log 0.003..0.1"
        search.ensemble.members = [1, 3, 5]
    """

    spec: Annotated[Positional[Path | None], arg(metavar="SPEC")] = None
    """The search as a TOML file, instead of options: task, trials, seeds, iterations or real_steps, system, preset,
    pruner, sampler_seed, and tables [search] and [set]."""
    task: str = "Swimmer"
    """Task, as metrpo train takes it."""
    search: Annotated[tuple[str, ...], arg(metavar="NAME=RANGE...")] = ()
    """Settings to search, each with a range (A..B, log A..B, A..B step C) or choices (1,3,5 or [64],[200,200])."""
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE...")] = ()
    """Other settings, fixed to values that are not the preset's."""
    trials: int = 20
    """Trials in all. Raise it later to search on."""
    seeds: Annotated[tuple[str, ...], arg(metavar="SEEDS...")] = ("0:2",)
    """Seeds of every trial, which run in parallel: numbers, ranges such as 0:3 (0 to 2), or lists such as 0,2,7."""
    iterations: Annotated[int | None, arg(metavar="INT")] = None
    """Outer iterations of every run; default: the preset's."""
    real_steps: Annotated[int | None, arg(metavar="INT")] = None
    """Instead of --iterations: real steps of every run."""
    system: Annotated[System | None, arg(metavar="NAME")] = None
    """System, as metrpo train takes it; default: the one that it takes."""
    preset: Preset = "fast"
    """The defaults of all other settings."""
    pruner: Literal["median", "halving", "none"] = "median"
    """Stop a trial when its best return so far is below the median of the others at the same iteration (median), when
    it is not among the best third (halving: successive halving), or never (none)."""
    sampler_seed: int = 0
    """Seed of the sampler, which chooses the settings to try."""
    jobs: Annotated[int | None, arg(metavar="INT")] = None
    """Trials at a time, each on its own cores; default: as many as give every seed a core."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the study, its figure and the runs (trial-<number>/seed-<seed>); default: runs/tune-<task>."""
    json: Switch = False
    """Print all trials and the best one as JSON."""
    dry_run: Switch = False
    """Only print the search."""
    APART: ClassVar[tuple[str, ...]] = ("spec", "jobs", "out", "json", "dry_run")
    """Not in the file."""

    def __post_init__(self) -> None:
        require_at_least_one("jobs", self.jobs)


def run(command: Tune) -> int:
    """Returns the exit code: 1 where a trial failed."""
    from metrpo.run.files import folder_name
    from metrpo.run.machine import cores
    from metrpo.tune.picture import draw
    from metrpo.tune.results import PICTURE, describe
    from metrpo.tune.search import from_file
    from metrpo.tune.trials import tune

    tell = printer(command.json)
    search = search_of(command) if command.spec is None else from_file(command.spec)
    out = command.out or Path("runs") / f"tune-{folder_name(search.task)}"
    tell(describe(search, out))
    if command.dry_run:
        return 0
    with attended_runs(out):
        tuned = tune(search, out, command.jobs or max(1, cores() // len(search.seeds)), tell)
    picture = out / PICTURE if draw(tuned, out / PICTURE) else None
    if command.json:
        print(json.dumps({**tuned.record(), "out": str(out), "picture": picture and str(picture)}))
    else:
        tuned.print()
        print(picture or f"{out}: nothing to draw yet")
    return exit_code(len(tuned.failed), len(tuned.records), "trial", f"the ends of their logs are in {out}")


def search_of(command: Tune) -> Search:
    """The search that the options describe. Raises `ConfigError` if they describe none."""
    from metrpo.launch.grid import require_once, seeds_of, values_of
    from metrpo.tune.search import Search
    from metrpo.tune.space import span_of

    searched, fixed = [span_of(text) for text in command.search], [values_of(text) for text in command.set]
    require_once("search", [name for name, _ in searched])
    require_once("set", [name for name, _ in fixed])
    if several := [name for name, values in fixed if len(values) != 1]:
        raise ConfigError(f"set: {several[0]}: expected one value, got several; to choose among them, use --search")
    names = [f.name for f in dataclasses.fields(Search) if f.name not in ("space", "settings", "seeds")]
    return Search(
        **cast(Any, {name: getattr(command, name) for name in names}),
        space=dict(searched),
        seeds=seeds_of(",".join(command.seeds)),
        settings={name: values[0] for name, values in fixed},
    )
