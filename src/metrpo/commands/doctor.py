"""`metrpo doctor` checks the installation."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from metrpo.commands.options import Switch


@dataclass(frozen=True)
class Doctor:
    """Check this machine (versions, devices, OpenGL, video encoder) and say what to install.

    The exit code is 0 if training can work. For example:
        metrpo doctor
        metrpo doctor --json
    """

    json: Switch = False
    """Print JSON."""


def run(command: Doctor) -> int:
    """Returns the exit code: 1 where training cannot work."""
    from metrpo.run import machine

    machine.set_variables(None, deterministic=False)  # doctor itself reports what is wrong with them
    from metrpo.run.installation import diagnose

    diagnosis = diagnose()
    print(json.dumps(dataclasses.asdict(diagnosis)) if command.json else diagnosis.text())
    return 1 if diagnosis.problems else 0
