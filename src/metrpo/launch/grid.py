"""A grid of runs: every task with every system, seed and combination of settings, each an ordinary `metrpo train`."""

from __future__ import annotations

import hashlib
import itertools
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args

from metrpo.config import BUDGET_FIELDS, Config, Preset, System, require_consistent, unread
from metrpo.counting import named_value
from metrpo.errors import ConfigError
from metrpo.launch.run_spec import RunSpec
from metrpo.presets import usual_system
from metrpo.world.registry import get_task

if TYPE_CHECKING:
    pass

_LONGEST, _KEPT = 255, 180
"""Bytes that a folder's name may have on common disks, and how many of a longer one stay readable."""


@dataclass(frozen=True)
class Grid:
    """The tasks, systems, seeds and settings to combine."""

    tasks: tuple[str, ...]
    systems: tuple[str, ...] = ()
    """Empty: each task's usual one."""
    seeds: tuple[int, ...] = (0,)
    preset: Preset = "fast"
    settings: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    """Dotted setting -> its values."""
    iterations: int | None = None
    real_steps: int | None = None
    """The budget of every run, one of the two; default: the preset's. Folder names leave it out: it may be raised."""
    budgets: Mapping[str, int] = field(default_factory=dict)
    """System -> real steps of its runs, instead of that budget: a method without models needs more of them."""

    def runs(self) -> list[RunSpec]:
        """Every run of the grid, first seeds first.

        Raises `ConfigError` or `TaskError`, before anything runs, for unknown settings and tasks and impossible values.
        """
        names, columns = list(self.settings), [list(values) for values in self.settings.values()]
        if not self.tasks or not self.seeds or not all(columns):
            raise ConfigError("sweep: expected at least one task, seed and value of each setting, got none")
        if unknown := [s for s in self.systems if s not in get_args(System)]:
            raise ConfigError(f"sweep: systems: expected some of {', '.join(get_args(System))}, got {unknown[0]}")
        budgets, usual = self._budgets()
        if twice := [name for name in names if (budgets or usual) and name in BUDGET_FIELDS]:
            raise ConfigError(f"set: {twice[0]}: expected the budget once, got it as an option too; leave one out")
        runs = []
        for seed, task_name, named, values in itertools.product(
            self.seeds, self.tasks, self.systems or (None,), itertools.product(*columns)
        ):
            overrides = tuple((name, _hashable(value)) for name, value in zip(names, values, strict=True))
            settings = dict(overrides)
            task = get_task(task_name, settings.get("env_kwargs", ()), settings.get("imports", ())).name
            system = named or usual_system(task, self.preset, settings)
            variant = variant_name(system, overrides)
            runs.append(RunSpec(task, system, seed, budgets.get(system, usual) + overrides, self.preset, variant))
        systems = list(dict.fromkeys(run.system for run in runs))
        if unknown := [s for s in self.budgets if s not in systems]:
            raise ConfigError(f"budget: expected a system of the grid ({', '.join(systems)}), got {unknown[0]}")
        configs = [run.config for run in runs]
        for config in configs:
            require_consistent(config)
        for name, values in self.settings.items():
            if len(values) > 1:
                require_read(name, configs)
        return list(dict.fromkeys(runs))

    def _budgets(self) -> tuple[dict[str, tuple[tuple[str, Any], ...]], tuple[tuple[str, Any], ...]]:
        """System -> the settings of its runs' budget, and those of all others."""
        usual = tuple((n, v) for n in BUDGET_FIELDS if (v := getattr(self, n)) is not None)
        if len(usual) > 1:
            raise ConfigError("sweep: expected iterations or real_steps, got both; leave one out")
        return {system: (("real_steps", steps),) for system, steps in self.budgets.items()}, usual


def from_file(path: Path) -> Grid:
    """The grid in a TOML file: tasks, systems, seeds (a list or "0:5"), preset, budget, and tables [budget] of single
    systems' real steps and [set] of settings.

    Raises `ConfigError` when it cannot be read or holds something else.
    """
    try:
        spec = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: expected a TOML file with tasks, seeds and [set], got {error}") from error
    settings, budgets = spec.pop("set", {}), spec.pop("budget", {})
    plain = ("preset", *BUDGET_FIELDS)
    if unknown := [key for key in spec if key not in ("tasks", "systems", "seeds", *plain)]:
        raise ConfigError(
            f"{path}: expected tasks, systems, seeds, {', '.join(plain)}, [budget] and [set], got {unknown[0]}"
        )
    if isinstance(spec.get("seeds"), str):
        spec["seeds"] = seeds_of(spec["seeds"])
    if not isinstance(settings, dict) or not all(isinstance(spec.get(k, []), list | tuple) for k in ("tasks", "seeds")):
        raise ConfigError(f"{path}: expected lists of tasks and seeds, and a table [set]")
    lists = {key: value if key in plain else tuple(value) for key, value in spec.items()}
    columns = {name: value if isinstance(value, list) else [value] for name, value in flat(settings).items()}
    if not isinstance(budgets, dict):
        raise ConfigError(f"{path}: budget: expected a table of systems and their real steps, got {budgets}")
    return Grid(**cast(Any, {"tasks": (), **lists, "settings": columns, "budgets": budgets}))


def budget_of(text: str) -> tuple[str, int]:
    """A system with its real steps as typed: "trpo=300000". Raises `ConfigError` for anything else."""
    system, _, steps = text.partition("=")
    try:
        return system, int(steps)
    except ValueError:
        raise ConfigError(f"budget: expected SYSTEM=REAL_STEPS such as trpo=300000, got {text!r}") from None


def require_read(name: str, configs: Sequence[Config]) -> None:
    """Raises `ConfigError` where none of the runs reads the setting, so that its values would all give the same."""
    owners = [unread(config, [name]).get(name) for config in configs]
    if owners and all(owners):
        raise ConfigError(
            f"{name}: expected a setting that some run reads, got one of {owners[0]}, and every run is "
            f"{' or '.join(sorted({config.system for config in configs}))}; all its values would give the same"
        )


def require_once(option: str, names: Sequence[str]) -> None:
    """Raises `ConfigError` when an option names something twice."""
    if len(set(names)) < len(names):
        raise ConfigError(f"{option}: expected each name once, got {', '.join(names)}")


def seeds_of(text: str) -> tuple[int, ...]:
    """Seeds as typed: "3" is 3, "0:5" is 0 to 4, "0,2,7" these, each once. Raises `ConfigError` for anything else."""
    seeds: list[int] = []
    for part in text.split(","):
        first, colon, end = part.partition(":")
        try:
            seeds += range(int(first or 0), int(end)) if colon else [int(part)]
        except ValueError:
            seeds.append(-1)
    if not seeds or min(seeds) < 0:
        raise ConfigError(
            f"seeds: expected a number, a range such as 0:5 (0 to 4) or a list such as 0,2,7, got {text!r}"
            f"{'' if seeds else ', which holds none'}"
        )
    return tuple(dict.fromkeys(seeds))


def values_of(text: str) -> tuple[str, list[Any]]:
    """A setting with its values as typed: "ensemble.members=1,5,10", "ensemble.hidden=[200,200],[512,512]"."""
    name, equals, values = text.partition("=")
    if not equals or not name or not values:
        raise ConfigError(f"set: expected NAME=VALUE,VALUE,... such as ensemble.members=1,5,10, got {text!r}")
    try:
        return name, json.loads(f"[{values}]")
    except json.JSONDecodeError:
        return name, [_plain(word) for word in values.split(",")]


def _plain(word: str) -> Any:
    try:
        return (
            {"True": True, "False": False, "None": None}[word]
            if word in ("True", "False", "None")
            else json.loads(word)
        )
    except json.JSONDecodeError:
        return word


def flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The table with dotted names: in TOML, ensemble.members is a table in a table."""
    dotted: dict[str, Any] = {}
    for name, value in table.items():
        dotted |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return dotted


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def variant_name(system: str, overrides: tuple[tuple[str, Any], ...]) -> str:
    """The folder of a combination, such as "me-trpo,ensemble.members=5"; a hash replaces the end of a long name."""

    name = ",".join([system, *(f"{name}={named_value(value)}" for name, value in overrides)]).replace("/", "-")
    if len(encoded := name.encode()) <= _LONGEST:
        return name
    return f"{encoded[:_KEPT].decode(errors='ignore')},{hashlib.sha256(encoded).hexdigest()[:16]}"
