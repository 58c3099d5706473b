"""What help shows: the commands on one screen, and the few settings of a run that people use."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Collection
from typing import Annotated, Any

import docstring_parser
import tyro
from tyro.conf import arg

from metrpo.commands.command_table import COMMANDS


def overview() -> str:
    """All commands, within 24 lines of 80 columns."""
    lines = ["usage: metrpo COMMAND [OPTIONS]    control learned from few real steps (ME-TRPO)", ""]
    for purpose, commands in COMMANDS.items():
        for i, (name, text) in enumerate(commands.items()):
            lines.append(f"{purpose if i == 0 else '':<14}{name:<11}{text}")
    lines += ["", 'Start with: metrpo train Swimmer. "metrpo COMMAND --help" explains a command,']
    return "\n".join([*lines, '"metrpo train --help-all" lists every setting, "metrpo --version" the version.'])


def shown(kind: Any, default: Any, only: Collection[str] | None = None) -> tuple[Any, Any]:
    """The class of a command as help shows it, and `default` (None: the class's own values) as an instance of it.

    Options beyond `only` (None: all) are left out. Help gives no default for None, nor for what is off or a switch.
    """
    hints, texts = typing.get_type_hints(kind, include_extras=True), _texts(kind)
    changed, values = [], {}
    for field in dataclasses.fields(kind):
        value = getattr(default or kind, field.name, dataclasses.MISSING)
        hint: Any = hints[field.name]
        marks = getattr(hint, "__metadata__", ())
        if only is not None and field.name not in only:
            hint = Annotated[hint, tyro.conf.Suppress]
        elif dataclasses.is_dataclass(section := getattr(hint, "__origin__", hint)) and default:
            section, value = shown(section, value)
            hint = Annotated[(section, *marks)] if marks else section
        elif field.default is dataclasses.MISSING and value is dataclasses.MISSING and "tuple" in str(hint):
            hint = Annotated[hint, arg(help_behavior_hint="(required)")]  # it may be empty, to the parser
        elif value is None or value is False or value == () or tyro.conf.FlagCreatePairsOff in marks:
            hint = Annotated[hint, arg(help_behavior_hint="")]
        if field.name in texts:
            hint = Annotated[hint, arg(help=texts[field.name])]
        changed.append((field.name, hint, field))
        values[field.name] = value
    brief: Any = dataclasses.make_dataclass(kind.__name__, changed, bases=(kind,), frozen=True)
    brief.__doc__ = kind.__doc__
    return brief, default and brief(**values)


def _texts(kind: Any) -> dict[str, str]:
    """What the class says of each field, in one line: the parser would keep the lines of the source."""
    params = (param for base in kind.__mro__[-2::-1] for param in docstring_parser.parse_from_object(base).params)
    return {param.arg_name: " ".join(param.description.split()) for param in params if param.description}
