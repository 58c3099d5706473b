"""`metrpo init` starts a run whose episodes your own program plays."""

from __future__ import annotations

import shlex
from dataclasses import dataclass

from metrpo.commands.options import RunOptions, warn_of_unread


@dataclass(frozen=True)
class Init(RunOptions):
    """Start a run whose episodes your own program plays, on a robot, say. Takes the same settings as train.

    Writes the untrained policy. Then repeat: play the policy in DIR, add the episodes
    (or call metrpo.append_episode in your program), improve. For example:
        metrpo init path/to/arm.py:task --run-dir runs/arm
        metrpo collect runs/arm --data today.npz
        metrpo improve runs/arm

    Every setting starts from the task's preset; metrpo init --help-all lists them all.
    """


def run(command: Init) -> int:
    """Returns the exit code."""
    from metrpo.external import begin
    from metrpo.run.policy_file import FILE
    from metrpo.world.registry import task_for

    config, run_dir = command.config, command.directory
    warn_of_unread(config)
    begin(config, run_dir)
    collect = f"metrpo collect {shlex.quote(str(run_dir))}"
    how = collect if task_for(config).playable else f"metrpo.append_episode, or {collect} --data FILE"
    print(f"{run_dir / FILE} is the untrained policy; add episodes ({how}), then run")
    print(f"metrpo improve {shlex.quote(str(run_dir))}")
    return 0
