"""Runs in other processes: started here, or still running after the process that started them was killed."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from metrpo.console.run_status import is_running
from metrpo.launch.local import start
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import is_finished

Cores = tuple[int, ...]
_POLL = 0.5
"""Seconds between two looks at a run."""


class Worker(Protocol):
    """A run in another process; `subprocess.Popen` is one."""

    def poll(self) -> int | None:
        """Its exit code once it has ended."""

    def terminate(self) -> None:
        """Asks it to stop after its iteration; a second call, at once. Does nothing once it has ended."""

    def wait(self) -> int:
        """Waits for its end and returns its exit code."""


Begin = Callable[[RunSpec, Path, Cores], Worker]


def begin(run: RunSpec, out: Path, cores: Cores) -> Worker:
    """Starts the run as its own `metrpo train` on these cores, unless it is still running."""
    return Orphan(run, out, cores) if is_running(out / run.name) else start(run, out, cores)


class Orphan:
    """A run that outlived its `metrpo tune`, which was killed: watched, and taken over once it ends."""

    def __init__(self, run: RunSpec, out: Path, cores: Cores) -> None:
        self._run, self._out, self._cores = run, out, cores
        self._asked = False
        self._process: Worker | None = None

    def poll(self) -> int | None:
        """Its exit code; 0 for one that was finished or stopped before it was ours."""
        if self._process is None:
            if is_running(self._out / self._run.name):
                return None
            if self._asked or is_finished(self._run, self._out):
                return 0
            self._process = start(self._run, self._out, self._cores)
        return self._process.poll()

    def terminate(self) -> None:
        """Asks the process that holds the run's lock."""
        self._asked = True
        if self._process is not None:
            self._process.terminate()
        elif is_running(self._out / self._run.name):
            with suppress(OSError, ValueError):
                os.kill(int((self._out / self._run.name / ".lock").read_text()), signal.SIGTERM)

    def wait(self) -> int:
        """Waits for its end."""
        while (code := self.poll()) is None:
            time.sleep(_POLL)
        return code
