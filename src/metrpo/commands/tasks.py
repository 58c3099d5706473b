"""`metrpo tasks` lists the tasks."""

from __future__ import annotations

import json
from dataclasses import dataclass

from metrpo.commands.options import Switch


@dataclass(frozen=True)
class Tasks:
    """List the tasks to learn.

    For example:
        metrpo tasks
        metrpo tasks --json
    """

    json: Switch = False
    """Print JSON."""


def run(command: Tasks) -> int:
    """Returns the exit code."""
    from metrpo.world.registry import tasks
    from metrpo.world.tasks.gymnasium_formulas import KNOWN

    columns = ("name", "env_id", "state_size", "action_size", "horizon", "description")
    rows = [{column: getattr(task, column) for column in columns} for task in tasks().values()]
    if command.json:
        print(json.dumps(rows))
        return 0
    print(f"{'task':<17} {'states':>6} {'actions':>7} {'steps':>5}  description")
    for row in rows:
        print("{name:<17} {state_size:>6} {action_size:>7} {horizon:>5}  {description}".format(**row))
    print(f"\nalso, with their reward formulas: {', '.join(KNOWN)}")
    others = "other Gymnasium ids with continuous actions, module:name or path/to/file.py:name"
    print(f"and, with a learned reward: {others}")
    return 0
