"""What help shows: the commands on one screen, and the few settings of a run that people use."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Collection
from typing import Annotated, Any

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

    Options beyond `only` (None: all) are left out. Help gives no default for a switch or for None.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    changed = []
    for field in dataclasses.fields(kind):
        value = getattr(default or kind, field.name, dataclasses.MISSING)
        hint: Any = hints[field.name]
        if only is not None and field.name not in only:
            hint = Annotated[hint, tyro.conf.Suppress]
        elif field.default is dataclasses.MISSING and value is dataclasses.MISSING and "tuple" in str(hint):
            hint = Annotated[hint, arg(help_behavior_hint="(required)")]  # it may be empty, to the parser
        elif value is None or isinstance(value, bool) or value == ():
            hint = Annotated[hint, arg(help_behavior_hint="")]
        else:
            continue
        changed.append((field.name, hint, field))
    brief: Any = dataclasses.make_dataclass(kind.__name__, changed, bases=(kind,), frozen=True)
    brief.__doc__ = kind.__doc__
    return brief, default and brief(**{f.name: getattr(default, f.name) for f in dataclasses.fields(kind)})
