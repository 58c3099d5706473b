"""What a machine of a Ray cluster does for one run: starts `metrpo train` as a process, and watches it to its end.

JAX stays out of Ray's worker, which may serve other runs afterwards; the worker's process only waits.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.run.lock import wait_until_free
from metrpo.run.machine import MAX_CPU_DEVICES
from metrpo.run.metrics import Row, read_metrics

FORWARDED = (
    "JAX_",
    "XLA_",
    "TF_CPP_",
    "OMP_",
    "OPENBLAS_",
    "MKL_",
    "NPROC",
    "MUJOCO_",
    "PYOPENGL_",
    "METRPO",
    "MINARI_",
    "PYTHONPATH",
)
"""Prefixes of the environment variables that a run depends on; Ray itself forwards none."""
_POLL = 0.2
"""Seconds between two looks at the process."""
PATIENCE = 300.0
"""Seconds to wait for a run directory that another process holds: a machine that lost its cluster takes a minute to
notice, and then ends its run."""


@dataclass(frozen=True)
class Order:
    """One run, for whichever machine takes it."""

    words: tuple[str, ...]
    """What follows `metrpo`."""
    directory: str
    """The run directory."""
    log: str
    folder: str
    """Where the command was typed: relative paths among the words start here."""
    environment: Mapping[str, str]
    cpus: int
    gpus: float


@dataclass(frozen=True)
class Ended:
    """How a run ended."""

    code: int
    rows: tuple[Row, ...]
    """Its metrics, as its own machine sees them: another machine's view of a shared disk may be seconds old."""
    seconds: float


def forwarded(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment variables that a run on another machine needs."""
    return {name: value for name, value in environment.items() if name.startswith(FORWARDED)}


def surroundings(order: Order, here: Mapping[str, str]) -> dict[str, str]:
    """The environment of a run: this machine's, with Ray's choice of GPUs, the forwarded variables and the run's share.

    Ray counts cores without assigning them: by themselves, XLA and BLAS would take the whole machine.
    """
    threads = ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    share = dict.fromkeys(threads, str(order.cpus))
    if order.gpus == 0:
        share["JAX_PLATFORMS"] = "cpu"
    elif order.gpus < 1:  # by itself JAX takes three quarters of a GPU's memory
        share["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 * order.gpus:.3f}"
    variables = {**here, **share, **order.environment}
    devices, flags = "--xla_force_host_platform_device_count", variables.get("XLA_FLAGS", "")
    if devices not in flags:
        variables["XLA_FLAGS"] = f"{flags} {devices}={min(order.cpus, MAX_CPU_DEVICES)}".strip()
    return variables


def attend(order: Order, look: Callable[[], None] = lambda: None) -> Ended:
    """Runs it to its end, from its last checkpoint on; passes a request to stop (Ray's KeyboardInterrupt) to the run.

    Calls `look` repeatedly, and once after the end; when `look` raises, the run is killed. Raises `MetrpoError` when
    this machine cannot run it: a folder is missing, or another process holds the run.
    """
    began, node = time.monotonic(), os.uname().nodename
    if not Path(order.folder).is_dir():
        raise MetrpoError(f"{node}: expected the folder {order.folder}, got none; start from a shared disk")
    directory = Path(order.directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        wait_until_free(directory, PATIENCE)
        log = os.open(order.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        raise MetrpoError(f"{node}: cannot write {directory}: {error.strerror or error}") from error
    os.write(log, f"metrpo: on {node}\n".encode())
    process = subprocess.Popen(
        [sys.executable, "-m", "metrpo.launch.tied", str(os.getpid()), *order.words],
        stdout=log,
        stderr=subprocess.STDOUT,
        cwd=order.folder,
        env=surroundings(order, os.environ),
        start_new_session=True,
    )
    os.close(log)  # the process has its own
    code = _wait(process, look)
    return Ended(code, _last_row(directory), time.monotonic() - began)


def _wait(process: subprocess.Popen[bytes], look: Callable[[], None]) -> int:
    # Python's own wait would not hear Ray's KeyboardInterrupt, which is no signal.
    code, looked = None, False
    while code is None or not looked:
        code, looked = process.poll(), False
        try:
            look()
            looked = True
            if code is None:
                time.sleep(_POLL)
        except Exception:
            process.kill()
            process.wait()
            raise
        except BaseException:
            process.terminate()
    return code


def _last_row(directory: Path) -> tuple[Row, ...]:
    try:
        return tuple(read_metrics(directory / "metrics.csv")[-1:])
    except (OSError, RunDirectoryError):
        return ()
