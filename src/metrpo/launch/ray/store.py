"""The run directories of machines without a shared disk, kept by the driver's machine (see `metrpo.launch.ray.sync`).

Files arrive in the order in which a run writes them, each whole or not at all. So at every moment a run directory looks
as a kill of the run itself would have left it.
"""

from __future__ import annotations

import contextlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TextIO

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.run.files import atomic_write, make_directory, writing
from metrpo.run.lock import hold

Mark = tuple[int, int, int]
"""Tells versions of a file apart: time of writing, size, inode."""


class Superseded(MetrpoError):
    """The run was started again elsewhere."""


@dataclass(frozen=True)
class Changes:
    """The changes in a run's folder since the last time."""

    files: tuple[tuple[str, bytes], ...]
    """Names and contents of new and changed files, in the order in which to write them."""
    gone: tuple[str, ...]
    log: bytes
    """New output of the run."""
    log_start: int
    """Bytes of its earlier output in this attempt."""


class Store:
    """The run directories under `out`, each held by the newest attempt at its run. One call at a time."""

    def __init__(self, out: str) -> None:
        self._out = Path(out)
        self._locks: dict[str, TextIO] = {}
        self._attempts: dict[str, int] = {}
        self._logs: dict[str, int] = {}

    def begin(self, run: str) -> tuple[int, dict[str, bytes]]:
        """Starts a new attempt at a run: returns its number, and all files by name. Ends all earlier attempts.

        Raises `DirectoryInUse` when another process holds the run, `RunDirectoryError` when it cannot be used.
        """
        directory, log = self._places(run)
        with writing(directory):
            make_directory(directory)
            if run not in self._locks:
                self._locks[run] = hold(directory)
            files = {name: (directory / name).read_bytes() for name in marks(directory)}
            self._logs[run] = log.stat().st_size if log.exists() else 0
        self._attempts[run] = self._attempts.get(run, 0) + 1
        return self._attempts[run], files

    def take(self, run: str, attempt: int, changes: Changes) -> None:
        """Writes the changes, each file whole or not at all; writing them twice does no harm.

        Raises `Superseded` when the attempt is not the newest, `RunDirectoryError` for a name that is none of a run's
        files, before anything is written, and when something cannot be written.
        """
        if attempt != self._attempts.get(run):
            raise Superseded(f"{run}: attempt {self._attempts.get(run)} continues it; attempt {attempt} ends")
        directory, log = self._places(run)
        files = [(within(directory, name), content) for name, content in changes.files]
        gone = [within(directory, name) for name in changes.gone]
        if changes.log:
            with writing(log):
                log.touch()
                with open(log, "r+b") as file:
                    file.seek(self._logs[run] + changes.log_start)
                    file.write(changes.log)
        for path, content in files:
            atomic_write(path, content)
        for path in gone:
            with contextlib.suppress(OSError):  # costs room only
                path.unlink()

    def end(self, run: str, attempt: int) -> None:
        """Unlocks the run, unless another attempt has it."""
        if attempt == self._attempts.get(run) and run in self._locks:
            self._locks.pop(run).close()

    def _places(self, run: str) -> tuple[Path, Path]:
        """Its directory and its log."""
        if any(part in ("", ".", "..") for part in run.split("/")):
            raise RunDirectoryError(f"expected the name of a run below {self._out}, got {run!r}")
        return self._out / run, self._out / f"{run}.log"


def within(directory: Path, name: str) -> Path:
    """The file `name` of a run directory. Raises `RunDirectoryError` when it would lie elsewhere, or is hidden."""
    if any(part.startswith(".") or not part or "\0" in part for part in name.split("/")):
        raise RunDirectoryError(f"expected the name of a file below {directory}, got {name!r}")
    return directory / name


def marks(directory: Path) -> dict[str, Mark]:
    """The files of a run directory, except hidden ones: its lock, and files that are being written."""
    versions = {}
    for folder, folders, names in os.walk(directory):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(folder, name) for name in names if not name.startswith(".")):
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                if stat.S_ISREG(status.st_mode):
                    name = PurePosixPath(path.relative_to(directory)).as_posix()
                    versions[name] = (status.st_mtime_ns, status.st_size, status.st_ino)
    return versions
