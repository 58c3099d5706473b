"""The presets: one table, task -> what differs from the defaults of `metrpo.config`.

`paper` holds the paper's values (its appendix A.1) and, where it is silent, its authors' settings; the citations stand
in `tests/test_presets.py`, which holds every value against them. `fast` reaches the same return soonest on two CPU
cores; how its values were chosen is in `docs/fast-preset.md`. `long-horizon` is for tasks of 1,000 steps.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, cast

from metrpo.config import Config, Preset, System, convert, difference, flatten, types_of
from metrpo.errors import ConfigError
from metrpo.systems import PAPER as SYSTEMS_PAPER
from metrpo.systems import SYSTEMS, Overrides

PAPER: dict[str, Overrides] = {
    "Swimmer": {"iterations": 100, "collect.max_train": 100_000, "collect.max_validation": 50_000},
    "Snake": {"iterations": 100},
    "Hopper": {"iterations": 100},
    "HalfCheetah": {"iterations": 100},
    "Ant": {"iterations": 200},
    "Humanoid": {
        "iterations": 400,
        "collect.steps": 6000,
        "collect.max_train": 400_000,
        "policy.hidden": (100, 50, 25),
        "validate.starts": 32,
    },
}

FAST_ALL: Overrides = {
    "advantage.baseline": "network",
    "advantage.gae_lambda": 0.95,
    "collect.max_std": 2.0,
    "collect.std_power": 3.0,
    "collect.parameter_noise": 1.0,
    "ensemble.hidden": (200, 200, 200),
    "ensemble.delta_std_floor": 1e-8,
    "ensemble.std_floor": 1e-8,
    "fit.batch_size": 250,
    "fit.learning_rate": 2e-3,
    "fit.loss_units": "std",
    "fit.max_steps": 4000,
    "fit.patience": 10,
    "fit.reinitialise_every": 0,
    "fit.weight_decay": 0.3,
    "imagine.steps": 40_000,
    "policy.mean_penalty": 1.0,
    "policy.min_std": 0.2,
    "policy.normalise": True,
    "validate.max_updates": 100,
    "validate.real_episodes": 4,
    "validate.starts": 50,
}

FAST: dict[str, Overrides] = {
    # Short of real steps: iterations of half the size (too few for a proof), and noise that lasts as long as a stroke.
    "Swimmer": {
        "iterations": 20,
        "collect.noise_correlation": 0.9,
        "collect.steps": 1500,
        "validate.real_episodes": 2,
    },
    "Snake": {"iterations": 20},
    "Hopper": {"iterations": 20},
    "HalfCheetah": {"iterations": 20},
    "Ant": {"iterations": 30},
    # Its policy is three times as wide and as deep, its updates so much dearer: fewer and smaller ones. Not tuned yet.
    "Humanoid": {
        "iterations": 30,
        "collect.steps": 6000,
        "collect.max_train": 400_000,
        "policy.hidden": (100, 50, 25),
        "imagine.steps": 20_000,
        "validate.max_updates": 50,
    },
}

LONG_HORIZON_ALL: Overrides = {
    "advantage.discount": 0.99,
    "collect.max_std": 1.0,
    "collect.std_power": 1.0,
    "collect.parameter_noise": 0.0,
    "collect.steps": 3000,
    "fit.max_steps": 1500,
    "imagine.horizon": 30,
    "imagine.start": "anywhere",
    "imagine.steps": 12_000,
    "iterations": 20,
    "policy.initial_std": 0.5,
    "validate.max_updates": 40,
    "validate.starts": 100,
}
"""On top of `fast`: short imagined episodes from anywhere, valued by a network where they are cut; and, as three real
episodes are all that an iteration gets, no parameter noise in these."""

SAME_AS = {"HopperUpright": "Hopper", "HumanoidStandup": "Humanoid"}
"""Variants share their task's row."""


LONG = 300
"""Episodes of more steps are imagined in parts, and valued by critics where these end (docs/actor-critic.md)."""

SHORT_BY_CRITICS: Overrides = {"advantage.discount": 0.99, "evaluation_episodes": 20}
"""What the actor-critic has where episodes are not that long, on top of `SYSTEMS`."""

LONG_BY_CRITICS: Overrides = {"real_steps": 50_000}
"""What it has where they are: an iteration may take 250 steps or 1,000, so that a number of iterations says little."""

_SLOWER: Overrides = {"gradient.learning_rate": 3e-4}
"""With larger steps of the actor not measured yet."""
BY_CRITICS: dict[str, Overrides] = {
    "Snake": {"iterations": 69, "actor_critic.entropy_target": -2.0} | _SLOWER,  # some 30,000 real steps
    "Hopper": {"iterations": 140},  # some 45,000
    "Ant": {"iterations": 43} | _SLOWER,  # some 15,000
    "Humanoid": {"iterations": 20} | _SLOWER,  # some 8,700
    # The default stays below 100, where models promise twice what any swimmer earns (docs/actor-critic-trials.md).
    "mbbl/Swimmer": {
        "actor_critic.agreement": 0.05,
        "actor_critic.entropy_target": -2.0,
        "collect.noise_correlation": 0.9,
    },
}
"""What differs for tasks of the actor-critic: the paper's tasks that it learns from fewer real steps, and others."""

NOT_BY_CRITICS = frozenset({"HopperUpright"})
"""Variants of these that `me-trpo` learns sooner (docs/fast-preset.md, "Runs of record")."""


ONLY_ME_TRPO = frozenset({"improver", "method", "max_action", "max_change"})
"""Settings that the actor-critic cannot have."""


def usual_system(task: str, name: str, settings: Mapping[str, Any]) -> System:
    """The system that a task has where none is asked for: `me-trpo`; under `fast` `actor-critic` for long episodes and
    for the tasks of `BY_CRITICS`.

    Where `settings` say how to learn, or limit the actions (`ONLY_ME_TRPO`), it is `me-trpo`; but `actor-critic` where
    that is the improver.
    """
    if settings.get("improver") == "actor-critic":
        return "actor-critic"
    if name != "fast" or settings.keys() & ONLY_ME_TRPO:
        return "me-trpo"
    row = SAME_AS.get(task, task)
    if row in PAPER:
        return "actor-critic" if row in BY_CRITICS and task not in NOT_BY_CRITICS else "me-trpo"
    return "actor-critic" if _horizon(task, _chosen(settings)) > LONG else "me-trpo"


def preset(task: str, name: str = "fast", system: str | None = None, **top_level: Any) -> Config:
    """The config of a preset for a task and a system, with `top_level` settings such as `seed=1`.

    A system of None is the task's usual one (`usual_system`). Raises `ConfigError` for an unknown preset, system or
    setting, and for two budgets.
    """
    _require_one_budget(top_level)
    if "preset" in top_level:
        got = top_level["preset"]
        raise ConfigError(f"preset: expected its name as the second argument, or as name=, got preset={got!r}")
    if name not in typing.get_args(Preset):
        raise ConfigError(f"preset: expected one of {', '.join(typing.get_args(Preset))}, got {name!r}")
    row = SAME_AS.get(task, task)
    horizon = None if row in PAPER else _horizon(task, _chosen(top_level))
    own = {} if horizon is None else _generic(horizon)
    overrides = (PAPER.get(row, {}) if name == "paper" else FAST_ALL | FAST.get(row, {})) | own
    if name == "long-horizon":
        overrides |= LONG_HORIZON_ALL
    if system is None:
        system = usual_system(task, name, top_level)
    if system not in SYSTEMS:
        raise ConfigError(f"system: expected one of {', '.join(SYSTEMS)}, got {system!r}")
    overrides = overrides | SYSTEMS[system] | (SYSTEMS_PAPER.get(system, {}) if name == "paper" else {})
    if system == "actor-critic":
        short = horizon is None or horizon <= LONG  # the paper's tasks have 100 or 200 steps
        overrides |= (SHORT_BY_CRITICS if short else LONG_BY_CRITICS) | BY_CRITICS.get(row, {})
    config = Config(task=task, preset=cast(Preset, name))
    return override(override(config, overrides | {"system": system}), top_level)


def _require_one_budget(settings: Mapping[str, Any]) -> None:
    """`real_steps` would end the run, and `iterations` be passed over in silence."""
    if settings.get("iterations") is not None and settings.get("real_steps"):
        raise ConfigError("expected iterations or real_steps, got both; leave one out")


def _chosen(settings: Mapping[str, Any]) -> Overrides:
    """Those of the settings that a task may need to be found, or to have its horizon."""
    return {name: settings[name] for name in ("env_kwargs", "imports") if name in settings}


def bare(task: str, name: str, system: str | None, settings: Overrides) -> Config:
    """The config of a preset, with only those of the dotted `settings` that create the environment."""
    system = system or usual_system(task, name, settings)
    return preset(task, name, system, **_chosen(settings))


def configured(task: str, name: str, system: str | None, settings: Overrides) -> Config:
    """The config of a preset with dotted `settings` on top. Raises `ConfigError` as `preset` and `override`."""
    _require_one_budget(settings)
    return override(bare(task, name, system, settings), settings)


def changed(config: Config) -> dict[str, Any]:
    """Dotted setting -> value where it is not the preset's, budget aside; what creates the environment counts."""
    usual = bare(config.task, config.preset, config.system, flatten(config))
    differing = difference(dataclasses.replace(usual, env_kwargs=(), imports=()), config)
    return {name: value for name, (_, value) in differing.items()}


def _horizon(task: str, chosen: Overrides) -> int:
    from metrpo.world.registry import get_task  # needed only for a task that is not in these tables

    return get_task(task, **chosen).horizon


def _generic(horizon: int) -> Overrides:
    """For a task of the user's own: about five episodes an iteration, validated on about 10,000 steps of each model."""
    return {
        "iterations": 10,
        "collect.steps": min(max(5 * horizon, 1000), 5000),
        "validate.starts": min(max(10_000 // horizon, 10), 50),
    }


def override(config: Config, values: Overrides) -> Config:
    """The config with dotted settings replaced, all at once: `override(config, {"fit.learning_rate": 1e-3})`.

    A budget of `iterations` takes the place of one of `real_steps`.

    Raises `ConfigError` for an unknown setting, a value of the wrong type or an impossible one.
    """
    if config.real_steps and "iterations" in values and "real_steps" not in values:
        values = {**values, "real_steps": None}
    return cast(Config, _replaced(config, values, ""))


def _replaced(node: Any, values: Overrides, section: str) -> Any:
    known = {f.name for f in dataclasses.fields(node)} if dataclasses.is_dataclass(node) else set()
    changes: dict[str, Any] = {}
    within: dict[str, Overrides] = {}
    for name, value in values.items():
        first, dot, rest = name.partition(".")
        if first not in known:
            raise ConfigError(f"unknown setting {section + name!r} (see: metrpo train --help-all)")
        if dot:
            within.setdefault(first, {})[rest] = value
        else:
            changes[first] = convert(types_of(type(node))[first], value, section + name)
    for first, inner in within.items():
        changes[first] = _replaced(changes.get(first, getattr(node, first)), inner, f"{section}{first}.")
    return dataclasses.replace(cast(Any, node), **changes)
