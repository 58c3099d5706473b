"""The grid of a command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from metrpo.launch.grid import Grid, require_once, seeds_of, values_of

if TYPE_CHECKING:
    from metrpo.commands.options import Sweep


def as_typed(command: Sweep) -> Grid:
    """The grid of a command line. Raises `ConfigError` for what is none."""
    settings = [values_of(text) for text in command.set]
    require_once("set", [name for name, _ in settings])
    return Grid(
        command.tasks,
        command.systems,
        seeds_of(",".join(command.seeds)),
        command.preset,
        dict(settings),
        command.iterations,
        command.real_steps,
    )
