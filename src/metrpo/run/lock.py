"""Locks a run directory: creates or recognises it, and checks its settings before anything is written."""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import platform
import shlex
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TextIO

from metrpo import config as configs
from metrpo.config import Config
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.run.files import BEST, FORMAT, atomic_write, check_format, make_directory, metrpo_version, source_commit
from metrpo.safe_load import json_of, text_of

_log = logging.getLogger("metrpo")
_version = functools.cache(version)
_POLL = 1.0
"""Seconds between two looks at a lock."""


class DirectoryInUse(RunDirectoryError):
    """Another process holds the run directory."""


def claim(path: Path, config: Config) -> TextIO:
    """Makes `path` the run directory of `config`, or checks that it is; returns its lock, held until closed.

    A run without an episode or a checkpoint has nothing to lose: its settings are replaced.

    Raises `RunDirectoryError` when it cannot be written, is in use by another process, holds something else, a run of
    another version or one with other settings; nothing in it has been changed then.
    """
    _create(path)
    lock = hold(path)
    try:
        _check_or_describe(path / "run.json")
        _check_or_write_config(path / "config.json", config, _has_begun(path))
    except BaseException:
        lock.close()
        raise
    return lock


def wait_until_free(path: Path, seconds: float) -> None:
    """Returns as soon as no process holds the run directory `path`, an existing folder.

    Raises `DirectoryInUse` when one still does after so many seconds, `RunDirectoryError` when it cannot be locked.
    """
    deadline = time.monotonic() + seconds
    while True:
        try:
            hold(path).close()
            return
        except DirectoryInUse:
            if time.monotonic() > deadline:
                raise
            time.sleep(_POLL)


def _create(path: Path) -> None:
    if path.is_file():
        raise RunDirectoryError(f"{path} is a file; --run-dir expects a directory")
    try:
        make_directory(path)
        foreign = [p.name for p in path.iterdir() if p.name != ".lock" and ".tmp" not in p.name]
    except OSError as error:
        raise RunDirectoryError(
            f"cannot use {path} as a run directory: {error.strerror}; choose a writable one"
        ) from error
    if foreign and "run.json" not in foreign:
        raise RunDirectoryError(
            f"{path} is no run directory: expected an empty one or a run.json, got {', '.join(sorted(foreign)[:3])}; "
            f"choose another directory (--run-dir), such as {path / 'new'}"
        )


def hold(path: Path) -> TextIO:
    """Locks a directory for this process, until the file is closed. Raises `RunDirectoryError` when another has it."""
    # The kernel drops the lock when the process ends, however it ends: no stale locks to clean up.
    try:
        file = open(path / ".lock", "a+", errors="replace")  # noqa: SIM115 - it stays open as long as the run
    except OSError as error:
        raise RunDirectoryError(f"cannot write in {path}: {error.strerror}; choose a writable directory") from error
    try:
        _lock(file)
    except BlockingIOError:
        file.seek(0)
        holder = file.read(20).strip() or "unknown"
        file.close()
        raise DirectoryInUse(
            f"{path} is in use by another process (pid {holder}): wait for it, end it, or choose another directory"
        ) from None
    except OSError as error:
        file.close()
        raise RunDirectoryError(f"cannot lock {path}: {error.strerror}; choose a directory on another disk") from error
    with contextlib.suppress(OSError):  # on a full disk the lock holds anyway, without the holder's name
        os.ftruncate(file.fileno(), 0)
        os.write(file.fileno(), str(os.getpid()).encode())
    return file


def _lock(file: TextIO) -> None:
    """Raises `BlockingIOError` when another process has locked it, `OSError` when that cannot be done here."""
    try:
        import fcntl  # Unix only
    except ImportError:
        _log.warning("this system has no Unix file locks: make sure that no other process writes to this directory")
        return
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _check_or_describe(file: Path) -> None:
    if file.exists():
        about = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
        if not isinstance(about, dict):
            raise RunDirectoryError(f"{file} is damaged (no object): put it back or choose another directory")
        check_format(about, file)
        return
    about = {"format": FORMAT, "metrpo": metrpo_version(), "commit": source_commit()}
    about["python"] = platform.python_version()
    about |= {name: _version(name) for name in ("jax", "mujoco", "gymnasium", "numpy")}
    about["created"] = datetime.now(UTC).isoformat(timespec="seconds")
    atomic_write(file, json.dumps(about, indent=2) + "\n")


def _has_begun(path: Path) -> bool:
    """Whether the run in `path` has anything to lose."""
    kept = [*path.glob("checkpoints/*.npz*"), *path.glob("episodes/*.npz*"), path / "metrics.csv", path / BEST]
    return any(file.exists() and ".tmp" not in file.name for file in kept)


def _check_or_write_config(file: Path, config: Config, begun: bool) -> None:
    if not file.exists():
        if begun:
            raise RunDirectoryError(f"{file} is missing: put it back or choose another directory")
        atomic_write(file, configs.to_json(config))
        return
    try:
        stored = configs.from_json(text_of(file, ConfigError))
    except ConfigError as error:
        raise RunDirectoryError(f"{file} is damaged: {error}; put it back or choose another directory") from None
    if begun:
        require_same(stored, config, file, file.parent)
    elif configs.difference(stored, config):
        atomic_write(file, configs.to_json(config))


def require_same(stored: Config, asked: Config, where: Path | str, folder: Path) -> None:
    """Raises `RunDirectoryError` with a table of the settings in which `where` differs from `asked`."""
    changed = configs.difference(stored, asked)
    if changed:
        width = max(len(name) for name in changed)
        table = "\n".join(
            f"  {name:<{width}}  directory has {old}, asked for {new}" for name, (old, new) in changed.items()
        )
        raise RunDirectoryError(
            f"{where} holds a run with other settings:\n{table}\nask for the same settings, choose another directory "
            f"(--run-dir DIR), or start anew: delete {shlex.quote(str(folder))} first"
        )
