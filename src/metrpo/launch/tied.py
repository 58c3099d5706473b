"""`python -m metrpo.launch.tied PID ...`: runs `metrpo ...`, and is killed when its parent PID ends in any way.

Otherwise, a killed worker would leave its run behind, unknown to anybody.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

_PR_SET_PDEATHSIG = 1
"""Linux's prctl(2): the signal is sent when the thread ends that started this process."""


def tie(parent: int) -> None:
    """Lets this process be killed with its parent; raises `SystemExit` when that has ended already.

    On other systems than Linux it does nothing: the process that resumes the run waits for this one.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        raise SystemExit(f"metrpo: its parent {parent} has ended")


if __name__ == "__main__":
    tie(int(sys.argv[1]))
    del sys.argv[1]
    runpy.run_module("metrpo", run_name="__main__")
