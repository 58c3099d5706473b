"""What can be typed: every command with its options, as dataclasses that tyro makes into parsers."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, cast

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, OmitSubcommandPrefixes, Positional, arg

from metrpo.commands.help import FEW, overview, shown
from metrpo.commands.words import command_of, joined, lists_of, understood
from metrpo.config import Config, Preset, System
from metrpo.errors import ConfigError, MetrpoError
from metrpo.launch.backend import Means

Switch = Annotated[bool, FlagCreatePairsOff]
"""A bool with one option, which turns it: --json, or --no-video. Settings of a run have two, for presets differ."""


@dataclass(frozen=True)
class Run(Config):
    """A run's settings as they are typed."""

    task: Annotated[Positional[str], arg(metavar="TASK")] = "Swimmer"
    """Name of the task (see: metrpo tasks), a Gymnasium id, module:name or path/to/file.py:name."""
    preset: Preset = "fast"
    """What all other settings start from. fast: learns soonest on two CPU cores; paper: the paper's values;
    long-horizon: for tasks of 1,000 steps."""
    system: Annotated[System, arg(metavar="NAME")] = "me-trpo"
    """The method: me-trpo, or one to compare it with. trpo, ppo, ddpg, svg-1 and svg-inf learn without the ensemble:
    trpo, ppo and ddpg on real steps alone (ppo and ddpg are Stable-Baselines3's). Others, such as model-ppo and k-1,
    change a few settings of me-trpo."""
    method: Annotated[Literal["model-based", "trpo", "ppo", "ddpg", "svg"], arg(metavar="NAME")] = "model-based"
    """The loop, which --system chooses: model-based (the paper's), or a baseline: trpo, Stable-Baselines3's ppo and
    ddpg, svg."""
    improver: Literal["trpo", "ppo", "vpg", "bptt", "bptt-stochastic"] = "trpo"
    """How the policy is improved on imagined steps: by score functions (trpo, ppo, vpg) or through the models
    (bptt). This ppo is ours, within the ensemble; --ppo.clip and the like are its settings."""
    iterations: int = 10
    """The budget: outer iterations; may be raised later to go on with a finished run."""
    real_steps: Annotated[int | None, arg(metavar="INT")] = None
    """Instead of --iterations: go on until this many real steps have been collected; 0: learn from --data alone."""
    data: Annotated[str | None, arg(metavar="FILE")] = None
    """Logged transitions to begin with: minari:NAME or an .npz of states, actions, rewards, next_states, terminated."""
    run_dir: Annotated[Path | None, arg(metavar="DIR")] = None
    """Where the run lives; default: runs/TASK-[SYSTEM-]PRESET-seedSEED, and the settings that are not the preset's."""
    device: Annotated[Literal["cpu", "gpu"] | None, arg(metavar="{cpu,gpu}")] = None
    """Where JAX computes; default: a GPU if JAX can use one."""


@dataclass(frozen=True)
class Train(Run):
    """Learn a task, or go on with a run: the same command again resumes it.

    For example:
        metrpo train Swimmer
        metrpo train HalfCheetah --seed 1 --real-steps 60000 --run-dir runs/cheetah
        metrpo train Pendulum-v1 --ensemble.members 10 --trpo.max-kl 0.02

    Every setting starts from the task's preset; metrpo train --help-all lists all.
    """

    video: Annotated[Switch, arg(help="Do not record the final policy as a video.")] = True


@dataclass(frozen=True)
class Init(Run):
    """Start a run whose episodes another program plays: a robot's own, say. Takes the same settings as train.

    It writes the untrained policy. Then, again and again: play DIR's policy, add
    the episodes (or call metrpo.append_episode in the program), improve. For example:
        metrpo init path/to/arm.py:task --run-dir runs/arm
        metrpo collect runs/arm --data today.npz
        metrpo improve runs/arm

    Every setting starts from the task's preset; metrpo init --help-all lists all.
    """


@dataclass(frozen=True)
class Collect:
    """Add real episodes to a run, which its next iteration learns from; one that was stopped goes on.

    It plays the task's environment with exploration, or takes episodes that were
    recorded elsewhere. They are on disk as soon as they end. For example:
        metrpo collect runs/arm
        metrpo collect runs/arm --steps 1000
        metrpo collect runs/arm --data today.npz
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    steps: Annotated[int | None, arg(metavar="INT")] = None
    """Play until at least this many steps wait; default: the run's collect.steps."""
    data: Annotated[str | None, arg(metavar="FILE")] = None
    """Instead: minari:NAME, or an .npz of logged states, actions, rewards, next_states, terminated."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """Where the run's task is, if its file or module has moved."""
    json: Switch = False
    """Print JSON."""

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise ConfigError(f"steps: expected at least 1, got {self.steps}")


@dataclass(frozen=True)
class Improve:
    """Learn from the episodes that wait in a run: fit the models, improve the policy, write it. One iteration.

    For example:
        metrpo improve runs/arm
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """Where the run's task is, if its file or module has moved."""
    json: Switch = False
    """Print the iteration's metrics as JSON."""


@dataclass(frozen=True)
class Evaluate:
    """Play real episodes with a run's policy, without noise, and report what they earn.

    For example:
        metrpo evaluate runs/Swimmer-fast-seed0
        metrpo evaluate runs/Swimmer-fast-seed0 --episodes 100 --seed 7 --json
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    episodes: int = 20
    """How many."""
    seed: int = 0
    """Decides the start states."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """Where the run's task is, if its file or module has moved."""
    json: Switch = False
    """Print JSON."""


@dataclass(frozen=True)
class Render:
    """Record one real episode of a run's policy as a video.

    For example:
        metrpo render runs/Swimmer-fast-seed0
        metrpo render runs/Swimmer-fast-seed0 --out swim.gif --seed 3
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """File to write, .mp4 or .gif; default: video.mp4 in the run directory; missing folders are made."""
    seed: int = 0
    """Decides the start state."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """Where the run's task is, if its file or module has moved."""


@dataclass(frozen=True)
class Export:
    """Write a run's policy as one file that needs no metrpo: Python with NumPy alone, or ONNX.

    For example:
        metrpo export runs/Swimmer-fast-seed0
        metrpo export runs/Swimmer-fast-seed0 --out swim.py && python swim.py
        metrpo export runs/Swimmer-fast-seed0 --out swim.onnx
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """File to write, .py, .onnx or .npz; default: policy.py in the run directory; missing folders are made."""


@dataclass(frozen=True)
class Tasks:
    """List the tasks that can be learnt.

    For example:
        metrpo tasks
        metrpo tasks --json
    """

    json: Switch = False
    """Print JSON."""


@dataclass(frozen=True)
class Doctor:
    """Check this machine: versions, devices, OpenGL and the video encoder, and say what to install.

    The exit code is 0 when training can work. For example:
        metrpo doctor
        metrpo doctor --json
    """

    json: Switch = False
    """Print JSON."""


@dataclass(frozen=True)
class Bench:
    """Measure this machine and our work on it: fitting, imagination, policy updates, whole iterations.

    Run nothing else meanwhile. All pieces are timed in turns, round after round, so that all see the same machine;
    medians count.
    For example:
        metrpo bench
        metrpo bench --peers --rounds 9 --json > bench.json
    """

    peers: Switch = False
    """Measure mbrl-lib, sb3-contrib and PyTorch too; the first time installs them (gigabytes), apart from ours."""
    rounds: int = 7
    """How often each piece is timed."""
    iterations: Annotated[Switch, arg(help="Do not time whole outer iterations and process starts (minutes).")] = True
    json: Switch = False
    """Print JSON."""

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ConfigError(f"rounds: expected at least 1, got {self.rounds}")


@dataclass(frozen=True)
class Reproduce:
    """Run what a figure of the paper compares, and draw it: every run an ordinary `metrpo train`.

    FIGURE is comparison, optimizers, ensemble-size, overfitting, sampling, validation, wall-clock, or all. Finished
    runs are kept, stopped ones go on, and the figure shows what there is. For example:
        metrpo reproduce all --scale smoke
        metrpo reproduce optimizers --tasks Swimmer --seeds 3 --jobs 2
        metrpo reproduce all --scale laptop --no-run
        metrpo reproduce all --scale paper --backend ray --out /shared/paper
    """

    figure: Annotated[Positional[str], arg(metavar="FIGURE")]
    """Which figure, or all."""
    scale: Literal["smoke", "laptop", "paper"] = "laptop"
    """smoke: minutes, learns nothing; laptop: hours on two cores; paper: as in the paper, weeks on two cores."""
    tasks: tuple[str, ...] = ()
    """Only these of the figure's tasks; default: the scale's."""
    seeds: Annotated[int | None, arg(metavar="INT")] = None
    """Seeds 0, 1, ... of each system; default: the scale's."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of the runs and of figures/; default: runs/reproduce-<scale>."""
    run: Annotated[Switch, arg(help="Run nothing: draw what is there.")] = True
    json: Switch = False
    """Print the figures' numbers as JSON."""
    means: Annotated[Means, OmitArgPrefixes] = field(default_factory=Means)

    def __post_init__(self) -> None:
        if self.seeds is not None and self.seeds < 1:
            raise ConfigError(f"seeds: expected at least 1, got {self.seeds}")


@dataclass(frozen=True)
class Sweep:
    """Run a grid: every task with every system, seed and combination of settings, each an ordinary `metrpo train`.

    Finished runs are kept, stopped ones go on, a run that fails does not stop the
    others. Lists may be given at once (--set A B) or one by one (--set A --set B).
    For example:
        metrpo sweep --tasks Swimmer HalfCheetah --seeds 0:5 --out runs/seeds
        metrpo sweep --set ensemble.members=1,5,10 trpo.max_kl=0.01,0.03 --jobs 4
        metrpo sweep grid.toml --dry-run
        metrpo sweep grid.toml --backend ray --out /shared/sweep

    where grid.toml holds, say:
        tasks = ["Swimmer"]
        seeds = "0:3"
        set.ensemble.members = [1, 5, 10]
    """

    spec: Annotated[Positional[Path | None], arg(metavar="SPEC")] = None
    """The grid as a TOML file: tasks, systems, seeds, iterations or real_steps, preset and a table [set]; instead of
    the options of these names."""
    tasks: Annotated[tuple[str, ...], arg(metavar="TASK...")] = ("Swimmer",)
    """Tasks, as metrpo train takes them."""
    systems: Annotated[tuple[System, ...], arg(metavar="NAME...")] = ("me-trpo",)
    """Systems, as metrpo train takes them."""
    seeds: Annotated[tuple[str, ...], arg(metavar="SEEDS...")] = ("0:3",)
    """Seeds: numbers, ranges such as 0:5 (0 to 4), or lists such as 0,2,7."""
    iterations: Annotated[int | None, arg(metavar="INT")] = None
    """Outer iterations of every run; default: the preset's. May be raised later to go on with finished runs."""
    real_steps: Annotated[int | None, arg(metavar="INT")] = None
    """Instead of --iterations: real steps of every run."""
    preset: Preset = "fast"
    """What all other settings start from."""
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUES...")] = ()
    """Settings and their values: ensemble.members=1,5,10 or ensemble.hidden=[200,200],[512]."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/sweep")
    """Folder of the runs: <task>/<system>,<setting>=<value>/seed-<seed>."""
    dry_run: Switch = False
    """Only say what would be run."""
    means: Annotated[Means, OmitArgPrefixes] = field(default_factory=Means)

    def __post_init__(self) -> None:
        _require_file_alone(self, self.spec, apart=("spec", "out", "dry_run", "means"))


@dataclass(frozen=True)
class Tune:
    """Search over settings with Optuna: trials are ordinary runs, bad ones stopped early on their real return.

    Give several seeds: what one run earns is noise. The same command goes on. Needs: pip install 'metrpo[tune]'.
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
    """The search as a TOML file: task, trials, seeds, iterations or real_steps, system, preset, pruner, sampler_seed,
    and tables [search] and [set]; instead of the options of these names."""
    task: str = "Swimmer"
    """Task, as metrpo train takes it."""
    search: Annotated[tuple[str, ...], arg(metavar="NAME=RANGE...")] = ()
    """Settings, each with its range, A..B, log A..B or A..B step C, or its choices, such as 1,3,5 or [64],[200,200]."""
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE...")] = ()
    """Other settings that are not the preset's."""
    trials: int = 20
    """Trials in all; may be raised later."""
    seeds: Annotated[tuple[str, ...], arg(metavar="SEEDS...")] = ("0:2",)
    """Seeds of every trial, side by side: numbers, ranges such as 0:3 (0 to 2), or lists such as 0,2,7."""
    iterations: Annotated[int | None, arg(metavar="INT")] = None
    """Outer iterations of every run; default: the preset's."""
    real_steps: Annotated[int | None, arg(metavar="INT")] = None
    """Instead of --iterations: real steps of every run."""
    system: Annotated[System, arg(metavar="NAME")] = "me-trpo"
    """System, as metrpo train takes it."""
    preset: Preset = "fast"
    """What all other settings start from."""
    pruner: Literal["median", "halving", "none"] = "median"
    """Stop a trial when its best return so far is below the median of the others' after as many iterations, when it is
    not among the best third (successive halving), or never."""
    sampler_seed: int = 0
    """Decides which settings are tried."""
    jobs: Annotated[int | None, arg(metavar="INT")] = None
    """Trials at a time, on cores of their own; default: as many as their seeds have a core each."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of the study, its picture and the runs: <task>/trial-<number>/seed-<seed>; default: runs/tune-<task>."""
    json: Switch = False
    """Print all trials and the best one as JSON."""
    dry_run: Switch = False
    """Only say what would be searched."""

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise ConfigError(f"jobs: expected at least 1, got {self.jobs}")
        _require_file_alone(self, self.spec, apart=("spec", "jobs", "out", "json", "dry_run"))


def _require_file_alone(command: Any, spec: Path | None, apart: tuple[str, ...]) -> None:
    """Raises `ConfigError` when a file says what is run and options other than `apart` say so too."""
    if spec is None:
        return
    fields = [f for f in dataclasses.fields(command) if f.name not in apart]
    if twice := [f.name for f in fields if getattr(command, f.name) != f.default]:
        raise ConfigError(f"{twice[0]}: expected it in {spec} alone; write it there, or leave the file out")


@dataclass(frozen=True)
class Report:
    """Write one HTML page about some runs: health warnings in plain words, learning curves, diagnostics, videos.

    The page works without a network, on a phone too. Folders are searched for runs. For example:
        metrpo report runs/Swimmer-fast-seed0
        metrpo report runs/sweep --out sweep.html
        metrpo report runs --json
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN_OR_FOLDER...")]
    """Run directories, or folders with runs inside."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("report.html")
    """File to write; missing folders are made."""
    json: Switch = False
    """Print what the page says as JSON, besides writing it."""

    def __post_init__(self) -> None:
        _require_dirs("report", self.dirs)


@dataclass(frozen=True)
class Plot:
    """Draw learning curves: a line with a band over the seeds for every group of runs that share their settings.

    For example:
        metrpo plot runs/sweep
        metrpo plot runs/sweep --out sweep.pdf --x wall_seconds
        metrpo plot runs --y gap --x iteration
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN_OR_FOLDER...")]
    """Run directories, or folders with runs inside."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("curves.png")
    """File to write, .png, .svg or .pdf; missing folders are made."""
    x: Literal["real_steps", "wall_seconds", "iteration"] = "real_steps"
    """What the curves are drawn against."""
    y: Annotated[str, arg(metavar="COLUMN")] = "return_real"
    """Column of metrics.csv or diagnostics.csv to draw, such as gap, outside, error_T, error_10_3 or improved_0."""

    def __post_init__(self) -> None:
        _require_dirs("plot", self.dirs)


@dataclass(frozen=True)
class Watch:
    """Show where many runs stand, in a table that stays up to date: returns, warnings, time left, running or stopped.

    Ctrl-C ends it; the runs go on. For example:
        metrpo watch runs
        metrpo watch runs/sweep runs/Swimmer-fast-seed0 --every 30
        metrpo watch runs --once
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR...")]
    """Run directories, or folders with runs inside."""
    every: float = 5.0
    """Seconds between two looks."""
    once: Switch = False
    """Look once."""
    json: Switch = False
    """Print JSON, once."""

    def __post_init__(self) -> None:
        _require_dirs("watch", self.dirs)
        if not 0.1 <= self.every < float("inf"):
            raise ConfigError(f"every: expected at least 0.1 seconds, got {self.every}")


def _require_dirs(command: str, dirs: tuple[Path, ...]) -> None:
    if not dirs:
        raise ConfigError(f"{command} needs run directories, or folders with runs inside: metrpo {command} runs")


Command = (
    Train
    | Init
    | Collect
    | Improve
    | Evaluate
    | Render
    | Export
    | Tasks
    | Doctor
    | Bench
    | Reproduce
    | Sweep
    | Tune
    | Report
    | Plot
    | Watch
)

COMMANDS: dict[str, type] = {command.__name__.lower(): command for command in typing.get_args(Command)}
"""Every command by its name."""

_HELP = ("-h", "--help", "--help-all")


def parse(arguments: list[str]) -> Command:
    """The command as typed; for `train` and `init`, with the task's preset as the defaults.

    Raises `SystemExit` after printing help, `MetrpoError` for what makes no sense, an impossible value or an unknown
    task.
    """
    if arguments[0] in _HELP:
        print(overview())
        raise SystemExit(0)
    kind = COMMANDS[command_of(arguments, COMMANDS)]
    arguments = joined(arguments, lists_of(kind))
    asked = next((word for word in arguments if word in _HELP), None)
    if issubclass(kind, Run):
        return _parse_run(kind, [a for a in arguments if a not in _HELP], asked)
    if asked is None:
        return cast(Command, understood(lambda: _tyro(kind, None, arguments), kind, arguments))
    _show(kind, None, arguments[0])


def _parse_run(kind: type[Run], arguments: list[str], asked: str | None) -> Command:
    from metrpo.presets import preset

    only = FEW if asked in ("-h", "--help") else None
    # Which defaults? That is among the arguments: they are read twice.
    any_task = _defaults(kind, preset("Swimmer"))
    try:
        first = cast(Run, understood(lambda: _tyro(kind, any_task, arguments), kind, arguments))
    except MetrpoError:
        if asked is None:
            raise
        _show(kind, any_task, arguments[0], only)
    from metrpo.run import machine

    machine.prepare(first.device, first.deterministic)
    from metrpo.world.registry import get_task

    task = get_task(first.task).name
    defaults = _defaults(kind, preset(task, first.preset, first.system))
    if asked is not None:
        _show(kind, defaults, arguments[0], only)
    parsed = understood(lambda: _tyro(kind, defaults, arguments), kind, arguments)
    return cast(Command, dataclasses.replace(cast(Run, parsed), task=task))


def _defaults(kind: type[Run], config: Config) -> Run:
    return kind(**{f.name: getattr(config, f.name) for f in dataclasses.fields(Config)} | {"task": tyro.MISSING})


def _show(kind: type, default: Any, name: str, only: Collection[str] | None = None) -> NoReturn:
    """Prints help and raises `SystemExit`."""
    brief, default = shown(kind, default, only)
    print(end="", flush=True)
    _tyro(brief, default, [name, "--help"])
    raise SystemExit(0)


def _tyro(kind: type, default: Any, arguments: list[str]) -> object:
    name, *rest = arguments
    return tyro.cli(kind, prog=f"metrpo {name}", default=default, args=rest, config=(OmitSubcommandPrefixes,))
