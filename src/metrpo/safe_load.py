"""Reading what may be damaged or hostile: whatever a file holds, it costs one clear error at most.

Nothing in it is run, unpickled or evaluated, and no memory is taken that the file does not account for: a member of an
archive is allocated only once its header fits the bytes that are there. Needs NumPy only.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import reprlib
import stat
import zipfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from metrpo.errors import MetrpoError

if TYPE_CHECKING:
    import numpy as np

LARGEST_FILE = 16 << 30
"""Bytes of the largest archive that is read."""
LARGEST_EXPANSION = 1 << 30
"""Bytes that the compressed arrays of an archive may expand to, together."""
LARGEST_TEXT = 64 << 20
"""Bytes of the largest text (JSON, CSV) that is read."""
_READ = 1 << 20
_LARGEST_READ = 4 * _READ
_HEADER = re.compile(
    rb"\{\s*'descr'\s*:\s*'([^']{1,20})'\s*,\s*'fortran_order'\s*:\s*(True|False)\s*,\s*"
    rb"'shape'\s*:\s*\(((?:[0-9]{1,20}, ?)*(?:[0-9]{1,20})?)\)\s*,?\s*\}\s*"
)
"""What NumPy writes before an array of plain numbers; read as it stands, never evaluated."""
_MOST_AXES = 8


@contextlib.contextmanager
def opened(path: Path, error: type[MetrpoError], most: int = LARGEST_FILE) -> Iterator[BinaryIO]:
    """Opens an ordinary file of at most `most` bytes for reading.

    Raises `error` when it cannot be opened or read, is a directory, pipe or device, or is larger.
    """
    try:
        # A pipe that nobody writes to must not hold us up.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))) as file:
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise error(f"cannot read {path}: expected an ordinary file, got a pipe or a device")
            if about.st_size > most:
                raise error(f"cannot read {path}: expected at most {most:,} bytes, got {about.st_size:,}")
            yield file
    except (OSError, ValueError) as why:  # ValueError: a name that no file can have
        raise error(f"cannot read {path}: {getattr(why, 'strerror', None) or why}") from why


def text_of(path: Path, error: type[MetrpoError]) -> str:
    """The UTF-8 text of a file.

    Raises `error` when it cannot be read, is no text, or too large.
    """
    with opened(path, error, LARGEST_TEXT) as file:
        content = file.read()
    try:
        return content.decode()
    except UnicodeDecodeError as why:
        raise error(f"cannot read {path}: expected UTF-8 text, got {why}") from None


def json_of(text: str | bytes, what: str, error: type[MetrpoError]) -> Any:
    """The value of a JSON text; NaN and infinities, which Python writes for metrics, are numbers.

    Raises `error`, beginning with `what`, when it is no JSON, nested too deeply, too long, or names a thing twice.
    """
    if len(text) > LARGEST_TEXT:
        raise error(f"{what}: expected JSON of at most {LARGEST_TEXT:,} bytes, got {len(text):,}")
    try:
        decoded = text.decode() if isinstance(text, bytes) else text
        return json.loads(decoded, object_pairs_hook=_object)
    except (ValueError, RecursionError) as why:
        raise error(f"{what}: expected JSON, got something else ({why})") from None


_short = reprlib.Repr()
_short.maxlevel, _short.maxstring, _short.maxlong, _short.maxother = 3, 200, 60, 200


def brief(value: Any) -> str:
    """A value out of a file for a message: as Python writes it, cut short where it is long or deep."""
    return _short.repr(value)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a name stands twice in one object")
    return found


def arrays_of(
    file: BinaryIO, path: Path, error: type[MetrpoError], *, compressed: bool, only: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """The arrays of an `.npz`: numbers and booleans; with `only`, the others are not read.

    Raises `error`, naming `path`, when it is not exactly an archive of arrays of numbers: for pickles and text, headers
    that do not fit the bytes there, names twice or outside of the archive, encrypted members, other members than arrays
    and, unless allowed, compressed ones, which may expand to `LARGEST_EXPANSION` together.
    """
    try:
        size = file.seek(0, os.SEEK_END)
        with zipfile.ZipFile(_InParts(file)) as archive:  # type: ignore[arg-type]
            members = _members(archive, size, compressed)
            return {
                name: _array(archive, member, name) for name, member in members.items() if only is None or name in only
            }
    except _NotNumbers as why:
        raise error(f"{path}: {why}") from None
    except Exception as why:  # zipfile promises no particular error for bytes that are no archive
        raise error(f"{path}: expected an .npz of numbers, got a file that cannot be read ({why})") from why


class _NotNumbers(Exception):
    """A member is something else than numbers."""


class _InParts:
    """A file of which no more than `_LARGEST_READ` is read at a time: zipfile reads the list of members at once."""

    def __init__(self, file: BinaryIO) -> None:
        self.seek, self.tell, self._read = file.seek, file.tell, file.read

    def read(self, count: int = -1) -> bytes:
        found = self._read(count if 0 <= count <= _LARGEST_READ else _LARGEST_READ + 1)
        if len(found) > _LARGEST_READ:
            raise ValueError("its list of members is too long")
        return found

    def seekable(self) -> bool:
        return True


def _members(archive: zipfile.ZipFile, size: int, compressed: bool) -> dict[str, zipfile.ZipInfo]:
    found: dict[str, zipfile.ZipInfo] = {}
    plain, expanded = 0, 0
    for member in archive.infolist():
        name = member.filename
        parts = re.split(r"[/\\]", name)
        if not name.endswith(".npy") or parts[0] == "" or ".." in parts or ":" in parts[0][:2]:
            raise ValueError(f"{name!a} is no name of an array")
        if name.removesuffix(".npy") in found:
            raise ValueError(f"{name!a} is there twice")
        if member.flag_bits & 1:
            raise ValueError(f"{name!a} is encrypted")
        if member.compress_type == zipfile.ZIP_STORED:
            plain += member.file_size
        elif member.compress_type == zipfile.ZIP_DEFLATED and compressed:
            expanded += member.file_size
        else:
            raise ValueError(f"{name!a} is compressed in a way that is not read")
        found[name.removesuffix(".npy")] = member
    if plain > size:
        raise ValueError(f"its arrays claim {plain:,} bytes, of {size:,} in the file")
    if expanded > LARGEST_EXPANSION:
        raise ValueError(
            f"its arrays expand to {expanded:,} bytes, of at most {LARGEST_EXPANSION:,}; save it without compression"
        )
    return found


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> np.ndarray:
    import numpy as np  # settings are read from text alone, by commands that should answer at once

    with archive.open(member) as source:
        start = source.read(8)
        width = {b"\x93NUMPY\x01\x00": 2, b"\x93NUMPY\x02\x00": 4}.get(start)
        if width is None:
            raise ValueError(f"{name!a} is no array")
        length = int.from_bytes(source.read(width), "little")
        header = _HEADER.fullmatch(source.read(length)) if length <= 10_000 else None
        if header is None:
            raise ValueError(f"{name!a} is no array of numbers")
        shape = tuple(int(axis) for axis in header[3].replace(b" ", b"").split(b",") if axis)
        dtype = _dtype(header[1].decode("ascii", "backslashreplace"), name, shape)
        there = member.file_size - len(start) - width - length
        if len(shape) > _MOST_AXES or math.prod(shape) * dtype.itemsize != there:
            raise ValueError(
                f"{name!a} claims the shape {list(shape)} of {dtype}, which does not fit its {there:,} bytes"
            )
        content, read = np.empty(there, np.uint8), 0
        while part := source.read(_READ):  # to the very end, where zipfile compares the checksum
            content[read : read + len(part)] = np.frombuffer(part, np.uint8)
            read += len(part)
        if read != there:
            raise ValueError(f"{name!a} is cut short")
    if dtype.kind == "b" and content.size and content.max() > 1:
        raise ValueError(f"{name!a} holds booleans that are neither true nor false")
    array = content.view(dtype)
    return array.reshape(shape[::-1]).T if header[2] == b"True" else array.reshape(shape)


def _dtype(description: str, name: str, shape: tuple[int, ...]) -> np.dtype:
    if "O" in description:
        raise ValueError(f"{name!a} is a pickle, which could run code")
    if not re.fullmatch(r"[<>|=]?([biufc][0-9]{1,2})", description):
        raise _NotNumbers(f"{name}: expected numbers of shape {list(shape)}, got {description}")
    import numpy as np

    return np.dtype(description)
