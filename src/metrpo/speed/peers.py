"""Other libraries doing the same work, each in a process of its own, in a Python environment apart from ours."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import IO

from metrpo.errors import MetrpoError
from metrpo.run.machine import cache_folder, cores

REQUIREMENTS = (
    "torch==2.13.0",
    "sb3-contrib==2.9.2",
    "stable-baselines3==2.9.2",
    "gymnasium==1.4.0",
    "numpy==2.4.6",
    # What mbrl imports: of its own pins, hydra-core 1.0.3 does not run on Python >= 3.11.
    "hydra-core==1.3.8",
    "omegaconf==2.3.1",
    "termcolor==3.3.0",
    "tqdm==4.70.1",
)
ALONE = ("mbrl==0.2.0",)
"""Installed without their dependencies: mbrl demands a Gymnasium that sb3-contrib refuses."""

WORK = {
    "mbrl-lib": ("fit-1024", "fit-200x4", "fit-1024-basic", "imagine-1024", "imagine-200x4"),
    "sb3-contrib": ("trpo", "trpo-value"),
    "pytorch": (
        "actor-critic",
        "fit-1024",
        "fit-200x4",
        "fit-1024-bfloat16",
        "imagine-1024",
        "imagine-200x4",
        "imagine-1024-bfloat16",
        "trpo",
    ),
}
"""The names of the work that each peer offers; benchmarks compare work of one name."""

PEERS = tuple(WORK)

SCRIPTS = {
    "mbrl-lib": Path(__file__).with_name("peer_mbrl.py"),
    "sb3-contrib": Path(__file__).with_name("peer_sb3.py"),
    "pytorch": Path(__file__).with_name("peer_torch.py"),
}

_IMPORTS = "import torch, sb3_contrib, mbrl.models"
_STAMP = "complete"
_TAIL = 2000
"""Characters of another program's output that an error quotes."""


def is_installed() -> bool:
    """Whether the peers' environment is complete, so that `environment` returns at once."""
    return (_folder() / _STAMP).exists() and _python().exists()


def environment() -> Path:
    """The Python of the peers' environment, made on first use (minutes, and gigabytes where PyTorch brings CUDA).

    It lies in metrpo/peers-<hash of requirements and Python> in the user's cache directory; pip's own settings apply.

    Raises `MetrpoError` when it cannot be made.
    """
    if is_installed():
        return _python()
    folder, python = _folder(), str(_python())
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        advice = "install Python's venv module (on Debian: apt install python3-venv)"
        _run([sys.executable, "-m", "venv", str(folder)], "make a virtual environment", advice)
        pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--quiet"]
        advice = "look at the network, the free space and pip's settings, then try again"
        _run([*pip, *REQUIREMENTS], f"install {' '.join(REQUIREMENTS)}", advice)
        _run([*pip, "--no-deps", *ALONE], f"install {' '.join(ALONE)}", advice)
        _run([python, "-c", _IMPORTS], "import the peers", "try again, or with another version of Python")
        # Last, so that an interrupted set-up starts anew.
        (folder / _STAMP).write_text("\n".join([*REQUIREMENTS, *ALONE, ""]))
    except OSError as error:
        raise MetrpoError(
            f"cannot make the peers' environment {folder}: {error}; make room, or set XDG_CACHE_HOME to a directory "
            "that can be written"
        ) from error
    return _python()


def _folder() -> Path:
    content = "\n".join([*REQUIREMENTS, *ALONE, f"{sys.version_info.major}.{sys.version_info.minor}"])
    return cache_folder() / f"peers-{hashlib.sha256(content.encode()).hexdigest()[:10]}"


def _python() -> Path:
    return _folder() / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def _run(command: list[str], what: str, advice: str) -> None:
    done = subprocess.run(command, env=_isolated(), capture_output=True, encoding="utf-8", errors="replace")
    if done.returncode:
        output = (done.stderr.strip() or done.stdout.strip())[-_TAIL:]
        raise MetrpoError(f"the peers' environment: cannot {what} (exit code {done.returncode}); {advice}\n{output}")


def _isolated() -> dict[str, str]:
    """Our environment variables, without those that would let our packages into another Python."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    return kept | {"PYTHONNOUSERSITE": "1"}


class PeerWorker:
    """One peer's process, a context manager; it may use all cores of this process and rests between requests.

    Raises `MetrpoError` for an unknown peer, and (on entering) when the peers' environment cannot be made.
    """

    def __init__(self, name: str) -> None:
        if name not in WORK:
            raise MetrpoError(f"peer: expected one of {', '.join(PEERS)}, got {name}")
        self.name = name
        self._process: subprocess.Popen[str] | None = None
        self._stderr: IO[str] | None = None

    def __enter__(self) -> PeerWorker:
        """Starts the process."""
        python = environment()
        # A file, for nobody empties a pipe while the worker works.
        self._stderr = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")
        try:
            self._process = subprocess.Popen(
                [str(python), str(SCRIPTS[self.name])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                encoding="utf-8",
                env=_isolated() | _threads(),
            )
        except OSError as error:
            self._stderr.close()
            raise MetrpoError(f"{self.name}: cannot start {python}: {error}; remove {python.parent.parent}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends the process: it is asked to, then (after 5 s, or at once after an error) killed."""
        process, stderr = self._running()
        with stderr:
            if error is not None:
                process.kill()
            try:
                process.communicate(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
        self._process = self._stderr = None

    def measure(self, work: str, repeat: int) -> list[float]:
        """Seconds of wall-clock that each of `repeat` repetitions of `work` took; the first request also warms up.

        Raises `MetrpoError` when the peer reports an error or has died.
        """
        process, _ = self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps({"work": work, "repeat": repeat}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:
            line = ""
        if not line:
            raise MetrpoError(f"{self.name}, {work}: {self._death()}")
        answer = json.loads(line)
        if "error" in answer:
            raise MetrpoError(f"{self.name}, {work}: {answer['error']}")
        return [float(seconds) for seconds in answer["seconds"]]

    def _running(self) -> tuple[subprocess.Popen[str], IO[str]]:
        assert self._process is not None, "a PeerWorker works between `with` and the end of its block"
        assert self._stderr is not None
        return self._process, self._stderr

    def _death(self) -> str:
        process, stderr = self._running()
        code = process.wait()
        stderr.seek(0)
        words = stderr.read().strip()[-_TAIL:] or "it left no message; was it killed, for want of memory perhaps?"
        return f"expected an answer, but its process has ended (exit code {code}): {words}"


def _threads() -> dict[str, str]:
    # OpenMP's threads would otherwise spin after their work, on the cores that the next one to be measured needs.
    return {
        "OMP_NUM_THREADS": str(cores()),
        "MKL_NUM_THREADS": str(cores()),
        "OMP_WAIT_POLICY": "PASSIVE",
        "KMP_BLOCKTIME": "0",
    }
