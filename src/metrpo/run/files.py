"""Files that are whole or not there: atomic writes, and arrays with JSON beside them under one SHA-256.

An array file is an ordinary `.npz` (any NumPy reads it; no pickle) whose zip comment is the SHA-256 of all bytes before
it, so that a file cut short or changed in any bit is refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import subprocess
import zipfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from metrpo.errors import RunDirectoryError

FORMAT = 1
"""Raised whenever a file of a run directory changes its meaning; other formats are refused by name."""

_META = "meta.json"
_DIGEST_SIZE = 64


class DamagedFile(RunDirectoryError):
    """A file is truncated or was edited."""


def atomic_write(path: Path, content: bytes | str) -> None:
    """Writes a file such that a crash at any moment leaves the old one or the new one, never a part.

    Raises `RunDirectoryError` when it cannot be written.
    """
    temporary = temporary_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_directory(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise RunDirectoryError(
            f"cannot write {path}: {error.strerror or error}; make room or choose a writable directory"
        ) from error


def temporary_path(path: Path) -> Path:
    """Where a file is written before it is renamed: hidden, in the same directory, with the same suffix."""
    return path.with_name(f".{path.stem}.tmp{path.suffix}")


def folder_name(task: str) -> str:
    """A task's name as that of a folder: path/to/file.py:task has more in it than a folder may have."""
    return re.sub(r"[^\w.-]+", "-", task)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Writes named arrays and JSON-able `meta` to one `.npz`, atomically; the format and metrpo's version go with them.

    Raises `TypeError` for an array that only pickle could hold, `RunDirectoryError` when the file cannot be written.
    """
    for name, array in arrays.items():
        if array.dtype.kind not in "biufc":
            raise TypeError(f"{path}: {name} has dtype {array.dtype}; expected numbers or booleans")
    buffer = io.BytesIO()
    text = json.dumps({"format": FORMAT, "metrpo": metrpo_version(), **meta})
    np.savez(buffer, allow_pickle=False, **{_META: np.frombuffer(text.encode(), np.uint8)}, **arrays)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = b"0" * _DIGEST_SIZE
    body = buffer.getvalue()[:-_DIGEST_SIZE]
    atomic_write(path, body + _digest(body))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the `meta` that `write_arrays` wrote.

    Raises `DamagedFile` when the file is not byte for byte as written, `RunDirectoryError` when it cannot be read
    or is of another format.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunDirectoryError(f"cannot read {path}: {error.strerror or error}") from error
    body, found = content[:-_DIGEST_SIZE], content[-_DIGEST_SIZE:]
    expected = _digest(body)
    if found != expected:
        got = found.decode("ascii", "backslashreplace")[:16] or "nothing"
        raise DamagedFile(
            f"{path} is damaged (truncated or edited): expected SHA-256 {expected.decode()[:16]} at its end, got {got}"
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    meta = json.loads(arrays.pop(_META).tobytes())
    check_format(meta, path)
    return arrays, meta


def check_format(meta: Mapping[str, Any], path: Path) -> None:
    """Raises `RunDirectoryError` when `path`, whose `meta` says how it was written, is of another format than ours."""
    if meta.get("format") != FORMAT:
        writer = meta.get("metrpo", "of another version")
        raise RunDirectoryError(
            f"{path} has format {meta.get('format')} (written by metrpo {writer}), but metrpo {metrpo_version()} reads "
            f"format {FORMAT}: use metrpo {writer}, or another directory"
        )


def metrpo_version() -> str:
    """The installed version, "unknown" when run from a bare source tree."""
    try:
        return version("metrpo")
    except PackageNotFoundError:
        return "unknown"


def source_commit() -> str | None:
    """The git commit of the source that runs, "-dirty" appended when it was edited; None outside a git checkout."""
    source = Path(__file__).resolve().parents[2]
    try:
        head = _git(source, "rev-parse", "HEAD")
        # A package installed inside somebody else's checkout (a .venv there) is not that checkout's.
        if not _git(source, "ls-files", str(Path(__file__).resolve())):
            return None
        return f"{head}-dirty" if _git(source, "status", "--porcelain", "--", str(source)) else head
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(directory: Path, *arguments: str) -> str:
    command = ["git", "-C", str(directory), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _digest(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest().encode()


def sync_directory(directory: Path) -> None:
    """Puts on disk which files a directory has."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
