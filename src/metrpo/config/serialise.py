"""A config to and from JSON, and as a flat dictionary of dotted settings."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import types
import typing
from typing import Any, Literal

from metrpo.config import env_kwargs
from metrpo.config.schema import BUDGET_FIELDS, Config
from metrpo.errors import ConfigError
from metrpo.safe_load import brief, json_of

ADDED = (
    "config.collect.std_power",
    "config.collect.noise_correlation",
    "config.ensemble.activation",
    "config.ensemble.probabilistic",
    "config.fit.decay",
    "config.fit.products",
    "config.policy.normalise",
    "config.policy.min_std",
    "config.policy.mean_penalty",
    "config.imagine.horizon",
    "config.imagine.products",
    "config.imagine.disagreement",
    "config.advantage.baseline",
    "config.advantage.value_hidden",
    "config.advantage.value_steps",
    "config.advantage.value_batch_size",
    "config.advantage.value_learning_rate",
    "config.trpo.fisher_every",
    "config.validate.real_episodes",
    "config.system",
    "config.method",
    "config.gradient",
    "config.ppo",
    "config.svg",
    "config.data",
    "config.env_kwargs",
    "config.imports",
    "config.max_action",
    "config.max_change",
    "config.history",
    "config.learn_reward",
    "config.trust_reward",
    "config.collect.piece",
    "config.actor_critic.agreement",
    "config.actor_critic",
)
"""Settings newer than the first config.json files: where one is missing, the run used its default."""


def to_json(config: Config) -> str:
    """The config as JSON text, one setting a line."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(text: str) -> Config:
    """The config that `to_json` wrote.

    Raises `ConfigError` when the text is no JSON, or a setting is missing, unknown, repeated, of the wrong type or
    impossible.
    """
    return _build(Config, json_of(text, "config", ConfigError), "config")


def flatten(config: Config) -> dict[str, Any]:
    """Every setting by its dotted name, as on the command line: `{"fit.learning_rate": 0.001, ...}`."""

    def walk(value: Any, prefix: str) -> typing.Iterator[tuple[str, Any]]:
        for f in dataclasses.fields(value):
            inner = getattr(value, f.name)
            name = f"{prefix}{f.name}"
            if dataclasses.is_dataclass(inner):
                yield from walk(inner, f"{name}.")
            else:
                yield name, inner

    return dict(walk(config, ""))


def difference(old: Config, new: Config) -> dict[str, tuple[Any, Any]]:
    """Settings that differ, budget aside: `{"fit.learning_rate": (old, new)}`."""
    ours, theirs = flatten(old), flatten(new)
    return {
        name: (ours[name], theirs[name]) for name in ours if name not in BUDGET_FIELDS and ours[name] != theirs[name]
    }


_hints = functools.cache(typing.get_type_hints)


def types_of(section: Any) -> dict[str, Any]:
    """The type of each setting of a section, by its name."""
    return _hints(section)


def _build(cls: type, data: object, where: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected an object with its settings, got {brief(data)}")
    hints = types_of(cls)
    names = [f.name for f in dataclasses.fields(cls)]
    missing = [n for n in names if n not in data and f"{where}.{n}" not in ADDED]
    wrong = [f"missing {n}" for n in missing] + [f"unknown {brief(n)[1:-1]}" for n in data if n not in names]
    if wrong:
        raise ConfigError(f"{where}: expected exactly the settings of this version, got {', '.join(wrong[:40])}")
    return cls(**{name: convert(hints[name], data[name], f"{where}.{name}") for name in names if name in data})


def convert(kind: Any, value: Any, where: str) -> Any:
    """`value` converted to a setting's type `kind`: a whole number to a float, a list to a tuple.

    Raises `ConfigError`, which begins with `where`, for another type and for none of the choices.
    """
    if dataclasses.is_dataclass(kind):
        return value if isinstance(value, typing.cast(type, kind)) else _build(typing.cast(type, kind), value, where)
    if isinstance(value, dict) and where.rpartition(".")[2] == "env_kwargs":
        return env_kwargs.canonical(value)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return None if value is None else convert(arguments[0], value, where)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{where}: expected one of {', '.join(map(str, arguments))}, got {brief(value)}")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{where}: expected a list, got {brief(value)}")
        return tuple(convert(arguments[0], item, where) for item in value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            return float(value)
    if type(value) is int and abs(value) >= 2**63:
        raise ConfigError(f"{where}: expected less than 2^63, got {brief(value)}")
    if type(value) is not kind:
        raise ConfigError(f"{where}: expected {kind.__name__}, got {brief(value)}")
    return value
