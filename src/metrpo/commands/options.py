"""Options that several commands share: the settings of a run, switches, and folders of runs."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from metrpo.config import Config, ImproverName, Method, Preset, System, unread
from metrpo.errors import ConfigError

_log = logging.getLogger("metrpo")
Switch = Annotated[bool, FlagCreatePairsOff]
"""A bool with one option, which flips it: --json, or --no-video. Settings of a run have two, for presets differ."""


@dataclass(frozen=True)
class RunOptions(Config):
    """A run's settings as they are typed."""

    task: Annotated[Positional[str], arg(metavar="TASK")] = "Swimmer"
    """Name of the task (see: metrpo tasks), a Gymnasium id, module:name or path/to/file.py:name."""
    env_kwargs: Annotated[tuple[str, ...], arg(metavar="KEY=VALUE...")] = ()
    """Keyword arguments of the environment: g=5.0 mode=easy 'size=[1, 2]'."""
    imports: Annotated[tuple[str, ...], arg(name="import", aliases=("--imports",), metavar="MODULE...")] = ()
    """Modules to import first, because they register the environment."""
    preset: Preset = "fast"
    """The defaults of all other settings. fast: learns soonest on two CPU cores; paper: the paper's values;
    long-horizon: me-trpo for tasks of 1,000 steps, which fast leaves to the actor-critic."""
    system: Annotated[System, arg(metavar="NAME")] = "me-trpo"
    """The method: me-trpo; actor-critic, the usual one for episodes of more than 300 steps, Snake, Hopper, Ant and
    the humanoids; or one to compare these with. trpo, ppo, ddpg, svg-1 and svg-inf learn without the ensemble; trpo,
    ppo and ddpg learn from real steps only (ppo and ddpg are Stable-Baselines3's). The others, such as model-ppo and
    k-1, change a few settings of me-trpo."""
    method: Annotated[Method, arg(metavar="NAME")] = "model-based"
    """The training loop, which --system chooses: model-based (the paper's), or a baseline: trpo, svg, or
    Stable-Baselines3's ppo and ddpg."""
    improver: ImproverName = "trpo"
    """How to improve the policy on imagined steps: by score functions (trpo, ppo, vpg), by backpropagation through
    the models (bptt), or by critics and backpropagation (actor-critic). This ppo learns in the ensemble; --ppo.clip
    and the like are its settings."""
    iterations: int = 10
    """The budget: outer iterations. Raise it later to continue a finished run."""
    real_steps: Annotated[int | None, arg(metavar="INT")] = None
    """Instead of --iterations: train until this many real steps are collected; 0: learn from --data alone."""
    data: Annotated[str | None, arg(metavar="FILE")] = None
    """Offline data to start from: minari:NAME, or an .npz of states, actions, rewards, next_states, terminated."""
    history: Annotated[int, arg(metavar="N")] = 1
    """How many of the latest observations the policy and the models see, with the actions between them. Take 3 if
    actions take effect two steps late, or if no sensor measures velocities."""
    run_dir: Annotated[Path | None, arg(metavar="DIR")] = None
    """The run directory; default: runs/TASK-[SYSTEM-]PRESET-seedSEED, and the settings that are not the preset's."""
    device: Annotated[Literal["cpu", "gpu"] | None, arg(metavar="{cpu,gpu}")] = None
    """Where JAX computes; default: a GPU if JAX finds one."""

    @property
    def config(self) -> Config:
        """The settings alone."""
        return Config(**{f.name: getattr(self, f.name) for f in dataclasses.fields(Config)})

    @property
    def directory(self) -> Path:
        """The run directory."""
        from metrpo.commands.default_dir import default_run_dir

        return self.run_dir or default_run_dir(self.config)


def warn_of_unread(config: Config) -> None:
    """Says which settings were changed from the preset's in vain."""
    from metrpo.presets import changed

    for name, owner in unread(config, changed(config)).items():
        _log.warning("%s is a setting of %s; it has no effect on this run (%s)", name, owner, config.system)


FEW = frozenset(
    {
        "task",
        "preset",
        "seed",
        "iterations",
        "real_steps",
        "system",
        "data",
        "learn_reward",
        "env_kwargs",
        "history",
        "track",
        "evaluation_episodes",
        "run_dir",
        "device",
        "video",
    }
)
"""The options of a run that `--help` shows; `--help-all` shows all."""


def require_directories(command: str, directories: tuple[Path, ...]) -> None:
    """Raises `ConfigError` when there are no directories."""
    if not directories:
        raise ConfigError(f"{command} needs run directories, or folders with runs inside: metrpo {command} runs")


def require_at_least_one(name: str, count: int | None) -> None:
    """Raises `ConfigError` when the option `name` is given and below 1."""
    if count is not None and count < 1:
        raise ConfigError(f"{name}: expected at least 1, got {count}")


def require_file_alone(command: object, asked: Collection[str]) -> None:
    """Raises `ConfigError` when options that a command's file `spec` holds are `asked` for as well.

    Such a command names the options that its file does not hold in `APART`.
    """
    apart, spec = getattr(command, "APART", None), getattr(command, "spec", None)
    if apart is None or spec is None:
        return
    held = [f.name for f in dataclasses.fields(command) if f.name not in apart]  # type: ignore[arg-type]
    if twice := [name for name in held if name in asked]:
        raise ConfigError(f"{twice[0]}: expected it in {spec} alone, got it as an option; write it there")
