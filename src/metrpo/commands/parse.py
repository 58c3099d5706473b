"""From the words of a command line to the options of its command."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any, NoReturn

import tyro
from tyro.conf import OmitSubcommandPrefixes

from metrpo.commands.command_table import NAMES, options_class
from metrpo.commands.help import overview, shown
from metrpo.commands.options import FEW, RunOptions, require_file_alone
from metrpo.commands.words import command_of, joined, lists_of, understood
from metrpo.config import Config
from metrpo.errors import MetrpoError
from metrpo.systems import Overrides

_HELP = ("-h", "--help", "--help-all")


def parse(arguments: list[str]) -> Any:
    """The options of a command as typed; for `train` and `init`, with the task's preset as the defaults.

    Raises `SystemExit` after printing help, `MetrpoError` for unknown words, impossible values and unknown tasks.
    """
    if arguments[0] in _HELP:
        print(overview())
        raise SystemExit(0)
    kind = options_class(command_of(arguments, NAMES))
    arguments = joined(arguments, lists_of(kind))
    asked = next((word for word in arguments if word in _HELP), None)
    if issubclass(kind, RunOptions):
        return _parse_run(kind, [a for a in arguments if a not in _HELP], asked)
    if asked is None:
        parsed = understood(lambda: _tyro(kind, None, arguments), kind, arguments)
        require_file_alone(parsed, _asked(arguments))
        return parsed
    _show(kind, None, arguments[0])


def _parse_run(kind: type[RunOptions], arguments: list[str], asked: str | None) -> Any:
    from metrpo.presets import preset

    only = FEW if asked in ("-h", "--help") else None
    # The arguments decide the defaults, so they are read twice.
    any_task = _defaults(kind, preset("Swimmer"))
    try:
        first = understood(lambda: _tyro(kind, any_task, arguments), kind, arguments)
    except MetrpoError:
        if asked is None:
            raise
        _show(kind, any_task, arguments[0], only)
    from metrpo.run import machine

    machine.prepare(first.device, first.deterministic)
    from metrpo.world.registry import get_task

    task = get_task(first.task, first.env_kwargs, first.imports).name
    of_task = {"env_kwargs": first.env_kwargs, "imports": first.imports}
    asked_for = _asked(arguments)
    system = _system(first, task, of_task, asked_for)
    defaults = _defaults(kind, preset(task, first.preset, system, **of_task))
    if asked is not None:
        _show(kind, defaults, arguments[0], only)
    if defaults.real_steps and "iterations" in asked_for:
        defaults = dataclasses.replace(defaults, real_steps=None)
    parsed = understood(lambda: _tyro(kind, defaults, arguments), kind, arguments)
    return dataclasses.replace(parsed, task=task)


def _asked(arguments: list[str]) -> set[str]:
    """Names of the options that are given."""
    named = (word.partition("=")[0] for word in arguments if word.startswith("--"))
    return {option.removeprefix("--").replace("-", "_") for option in named}


def _system(options: RunOptions, task: str, of_task: Overrides, asked: set[str]) -> str:
    """The system that is asked for by its name, or the usual one with what else is asked for."""
    from metrpo.presets import ONLY_ME_TRPO, usual_system

    if "system" in asked:
        return options.system
    return usual_system(task, options.preset, of_task | {name: getattr(options, name) for name in asked & ONLY_ME_TRPO})


def _defaults(kind: type[RunOptions], config: Config) -> RunOptions:
    return kind(**{f.name: getattr(config, f.name) for f in dataclasses.fields(Config)} | {"task": tyro.MISSING})


def _show(kind: type, default: Any, name: str, only: Collection[str] | None = None) -> NoReturn:
    """Prints help and raises `SystemExit`."""
    brief, default = shown(kind, default, only)
    print(end="", flush=True)
    _tyro(brief, default, [name, "--help"])
    raise SystemExit(0)


def _tyro(kind: type, default: Any, arguments: list[str]) -> Any:
    name, *rest = arguments
    return tyro.cli(kind, prog=f"metrpo {name}", default=default, args=rest, config=(OmitSubcommandPrefixes,))
