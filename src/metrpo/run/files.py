"""Files that are whole or not there: atomic writes, and arrays with JSON beside them under one SHA-256.

An array file is an ordinary `.npz` (any NumPy reads it; no pickle) whose zip comment is the SHA-256 of all bytes before
it, so that a file cut short or changed in any bit is refused.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import os
import re
import subprocess
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from metrpo.errors import RunDirectoryError
from metrpo.safe_load import LARGEST_FILE, LARGEST_TEXT, arrays_of, brief, json_of, opened

FORMAT = 1
"""Raised whenever a file of a run directory changes its meaning; other formats are refused by name."""
BEST = "best"
"""Folder in a run directory: the policy that earned most when it was evaluated."""

_META = "meta.json"
_DIGEST_SIZE = 64
_HEADER = 10_000
"""Most bytes of an array's header."""


class DamagedFile(RunDirectoryError):
    """A file is truncated or was edited."""


def atomic_write(path: Path, content: bytes | str) -> None:
    """Writes a file such that a crash at any moment leaves the old one or the new one, never a part.

    Raises `RunDirectoryError` when it cannot be written.
    """
    temporary = temporary_path(path)
    with writing(path):
        try:
            make_directory(path.parent)
            with open(temporary, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
            sync_directory(path.parent)
        except OSError:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raises `RunDirectoryError` where `path` cannot be written in this block."""
    try:
        yield
    except OSError as error:
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
    if len(body) > LARGEST_FILE - _DIGEST_SIZE or len(text) > LARGEST_TEXT:
        raise RunDirectoryError(
            f"cannot write {path}: {len(body):,} bytes are more than can be read again; keep fewer transitions"
        )
    atomic_write(path, body + _digest(body))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the `meta` that `write_arrays` wrote.

    Raises `DamagedFile` when the file is not byte for byte as written, `RunDirectoryError` when it cannot be read,
    is of another format, or was made to look like one of ours (see `metrpo.safe_load`).
    """
    with opened(path, RunDirectoryError) as file:
        found, expected = _digests(file)
        if found != expected:
            got = found.decode("latin-1")[:16] if re.fullmatch(rb"[0-9a-f]{64}", found) else "none: its end is missing"
            raise DamagedFile(
                f"{path} is damaged (truncated or edited): expected SHA-256 {expected.decode()[:16]} at its end, "
                f"got {got}"
            )
        arrays = arrays_of(file, path, RunDirectoryError, compressed=False)
    text = arrays.pop(_META, None)
    if text is None or text.dtype != np.uint8:
        raise RunDirectoryError(f"{path}: expected {_META} in it, as text, got none")
    meta = json_of(text.tobytes(), f"{path}: {_META}", RunDirectoryError)
    if not isinstance(meta, dict):
        raise RunDirectoryError(f"{path}: {_META}: expected an object, got {type(meta).__name__}")
    check_format(meta, path)
    return arrays, meta


def read_meta(path: Path) -> dict[str, Any]:
    """The `meta` alone, without a look at the arrays, however large; for those who only watch.

    Raises `RunDirectoryError` when there is none to be read.
    """
    with _member(path, _META) as file:
        text = np.lib.format.read_array(file, allow_pickle=False, max_header_size=_HEADER).tobytes()
    meta = json_of(text, f"{path}: {_META}", RunDirectoryError)
    if not isinstance(meta, dict):
        raise RunDirectoryError(f"{path}: {_META}: expected an object, got {type(meta).__name__}")
    return meta


def length_of(path: Path, name: str) -> int:
    """Length of the array `name`, by its header. Raises `RunDirectoryError` when there is none to be read."""
    with _member(path, name) as file:
        np.lib.format.read_magic(file)
        shape, _, _ = np.lib.format.read_array_header_1_0(file, max_header_size=_HEADER)
    return int(shape[0]) if shape else 0


@contextmanager
def _member(path: Path, name: str) -> Iterator[IO[bytes]]:
    try:
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo(f"{name}.npy")
            if info.file_size > LARGEST_TEXT:
                raise RunDirectoryError(
                    f"{path}: {name}: expected at most {LARGEST_TEXT:,} bytes, got {info.file_size:,}"
                )
            with archive.open(info) as file:
                yield file
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise RunDirectoryError(f"{path} cannot be read: {error}") from None


def check_format(meta: Mapping[str, Any], path: Path) -> None:
    """Raises `RunDirectoryError` when `path`, whose `meta` says how it was written, is of another format than ours."""
    if type(meta.get("format")) is not int or meta["format"] != FORMAT:
        writer = str(meta.get("metrpo", "of another version"))[:100]
        raise RunDirectoryError(
            f"{path} has format {brief(meta.get('format'))} (written by metrpo {writer}), "
            f"but metrpo {metrpo_version()} reads format {FORMAT}: use metrpo {writer}, or another directory"
        )


def inside(folder: Path, file: str) -> Path | None:
    """The first folder up to three levels below `folder` that holds `file`; None where there is none."""
    with contextlib.suppress(OSError):
        for depth in range(1, 4):
            if found := sorted(folder.glob("*/" * depth + file))[:1]:
                return found[0].parent
    return None


@functools.cache
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


def _digests(file: BinaryIO) -> tuple[bytes, bytes]:
    """The digest at the end of a file, and the one of all before it; a damaged file of any size takes no memory."""
    left, digest = max(file.seek(0, os.SEEK_END) - _DIGEST_SIZE, 0), hashlib.sha256()
    file.seek(0)
    while left and (part := file.read(min(left, 1 << 20))):
        digest.update(part)
        left -= len(part)
    return file.read(_DIGEST_SIZE), digest.hexdigest().encode()


def make_directory(directory: Path) -> None:
    """Makes a directory and those above it, and puts on disk that they are there. Raises `OSError`."""
    if directory.is_dir():
        return
    try:
        directory.mkdir(exist_ok=True)
    except FileNotFoundError:
        make_directory(directory.parent)
        directory.mkdir(exist_ok=True)
    with contextlib.suppress(OSError):  # one may make a directory in another that one may not read
        sync_directory(directory.parent)


def sync_directory(directory: Path) -> None:
    """Puts on disk which files a directory has."""
    if os.name == "nt":  # a directory is no file there
        return
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
