"""`python -m metrpo.launch.tied PID ...`: `metrpo ...` that is killed when its parent PID ends, however that ends.

A worker that is killed could not end its run otherwise, which would go on without anybody's knowledge.
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

    Where there is no such thing (it is Linux's) nothing happens: whoever goes on with the run waits for this process.
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
