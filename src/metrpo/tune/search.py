"""A search over settings: its task, its settings and their ranges, the number of trials, and a trial's value."""

from __future__ import annotations

import dataclasses
import math
import tomllib
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from metrpo import budget
from metrpo.config import Config, Preset, System, flatten, require_consistent
from metrpo.errors import ConfigError
from metrpo.launch.grid import flat, require_read, seeds_of
from metrpo.launch.run_spec import RunSpec
from metrpo.presets import configured, override, usual_system
from metrpo.run.metrics import Row, numbers
from metrpo.tune.space import Span, span
from metrpo.world.registry import get_task
from metrpo.world.task import Task

if TYPE_CHECKING:
    pass

Pruner = Literal["median", "halving", "none"]
LAST = 3
"""Number of last evaluations whose mean counts (one per iteration): a single one is noisy."""
OBJECTIVE = f"mean over the seeds of the mean return_real of the last {LAST} iterations"
_NOT_SEARCHED = ("task", "preset", "system", "seed", "iterations", "real_steps")
"""Settings that all trials share, because they have their own options."""


@dataclass(frozen=True)
class Search:
    """A search.

    Raises `ConfigError` or `TaskError`, before anything runs, for an unknown setting or task, and for an impossible
    value at either end of a range or among the choices.
    """

    task: str
    space: Mapping[str, Span]
    """Dotted setting -> its range or choices."""
    system: System | None = None
    """None: the task's usual one."""
    preset: Preset = "fast"
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of every trial, whose value is their mean."""
    iterations: int | None = None
    real_steps: int | None = None
    """The budget of every run, one of the two; default: the preset's iterations."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Other settings that are not the preset's."""
    trials: int = 20
    pruner: Pruner = "median"
    sampler_seed: int = 0

    def __post_init__(self) -> None:
        for name, least, value in (("trials", 1, self.trials), ("sampler_seed", 0, self.sampler_seed)):
            if type(value) is not int or value < least:
                raise ConfigError(f"{name}: expected a whole number of at least {least}, got {value!r}")
        if self.pruner not in typing.get_args(Pruner):
            raise ConfigError(f"pruner: expected one of {', '.join(typing.get_args(Pruner))}, got {self.pruner!r}")
        if not self.space or not self.seeds:
            raise ConfigError("tune: expected at least one setting to search and one seed; give --search NAME=A..B")
        if self.iterations is not None and self.real_steps is not None:
            raise ConfigError("tune: expected iterations or real_steps, got both; leave one out")
        if self.real_steps is not None and (type(self.real_steps) is not int or self.real_steps < 1):
            raise ConfigError(f"real_steps: expected a whole number of at least 1, got {self.real_steps!r}")
        for name in (*self.space, *self.settings):
            if name in _NOT_SEARCHED or (name in self.space and name in self.settings):
                twice = (
                    "is both fixed and searched" if name in self.space and name in self.settings else "has an option"
                )
                raise ConfigError(f"tune: expected settings of a run, each once, got {name}, which {twice}")
        if "collect.steps" in self.space and self.pruner != "none":
            raise ConfigError(
                "collect.steps: expected a fixed value, because pruning compares trials iteration by iteration, got a "
                "searched one; add --pruner none, and --real-steps, so that all trials cost the same"
            )
        object.__setattr__(self, "task", self._task().name)
        # What is searched may be what only one system can do.
        system = self.system or usual_system(self.task, self.preset, {**self.space, **self.settings})
        object.__setattr__(self, "system", system)
        tried = [override(self.base, {name: v}) for name, over in self.space.items() for v in over.outermost]
        ends = ({name: over.outermost[end] for name, over in self.space.items()} for end in (0, -1))
        tried += [override(self.base, values) for values in ends]
        for config in tried:
            require_consistent(config)
        for name in self.space:
            require_read(name, tried)

    def _task(self) -> Task:
        return get_task(self.task, self.settings.get("env_kwargs", ()), self.settings.get("imports", ()))

    @property
    def base(self) -> Config:
        """The settings that every run starts from."""
        return configured(self.task, self.preset, self.system, dict(self._fixed))

    @property
    def _fixed(self) -> tuple[tuple[str, Any], ...]:
        budget = {"iterations": self.iterations, "real_steps": self.real_steps}
        fixed = {name: value for name, value in budget.items() if value is not None} | dict(self.settings)
        return tuple((name, tuple(v) if isinstance(v, list) else v) for name, v in fixed.items())

    @property
    def usual(self) -> dict[str, Any] | None:
        """The preset's values of the searched settings; None when one lies outside the search."""
        values = flatten(self.base)
        searched = {name: values[name] for name in self.space}
        return searched if all(self.space[name].holds(value) for name, value in searched.items()) else None

    def runs(self, number: int, values: Mapping[str, Any]) -> list[RunSpec]:
        """The runs of trial `number`, one for each seed."""
        overrides = (*self._fixed, *values.items())
        folder = f"trial-{number:03d}"
        assert self.system is not None, "chosen when the search was made"
        return [RunSpec(self.task, self.system, seed, overrides, self.preset, folder) for seed in self.seeds]

    @property
    def steps(self) -> int:
        """About how many iterations a run has; at the fewest, where each plays a whole long episode."""
        base = self.base
        if base.real_steps is None:
            return base.iterations
        longest = min(self._task().horizon, budget.longest_episode(base, base.real_steps))
        return math.ceil(base.real_steps / max(base.collect.steps, longest))

    def is_spent(self, rows: Sequence[Row]) -> bool:
        """Whether a run with these rows of metrics has used up its budget."""
        return budget.spent(self.base, rows)

    def record(self) -> dict[str, Any]:
        """The search as JSON, without the number of trials: equal records mean the same search."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "trials"}
        settings = {name: list(v) if isinstance(v, tuple) else v for name, v in self.settings.items()}
        return fields | {
            "space": {name: str(over) for name, over in self.space.items()},
            "seeds": list(self.seeds),
            "settings": settings,
        }


def worth(returns: Sequence[Sequence[Row]], iterations: int | None = None) -> list[float]:
    """The value of each seed's run after `iterations` (None: all): `OBJECTIVE` is the mean of these."""
    values = []
    for rows in returns:
        last = [row.get("return_real") for row in rows[:iterations][-LAST:]]
        values.append(math.fsum(numbers(last)) / len(last))
    return values


def from_file(path: Path) -> Search:
    """The search in a TOML file: task, trials, seeds ..., and tables [search] and [set] of settings.

    Raises `ConfigError` when it cannot be read or says something else, or what `Search` raises.
    """
    names = [f.name for f in dataclasses.fields(Search) if f.name not in ("space", "settings")]
    try:
        spec = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: expected a TOML file with task and [search], got {error}") from error
    searched, settings = spec.pop("search", {}), spec.pop("set", {})
    if unknown := [key for key in spec if key not in names]:
        raise ConfigError(f"{path}: expected {', '.join(names)}, [search] and [set], got {unknown[0]}")
    if not isinstance(spec.get("task"), str) or not isinstance(searched, dict) or not isinstance(settings, dict):
        raise ConfigError(f'{path}: expected a task such as "Swimmer", and tables [search] and [set]')
    if "seeds" in spec:
        spec["seeds"] = seeds_of(",".join(map(str, s)) if isinstance(s := spec["seeds"], list) else str(s))
    space = {name: span(name, values) for name, values in flat(searched).items()}
    return Search(**cast(Any, {**spec, "space": space, "settings": flat(settings)}))
