"""A disk that fails on purpose: processes killed and machines switched off at any operation, full and broken disks."""

from __future__ import annotations

import builtins
import contextlib
import errno
import io
import os
import shutil
from pathlib import Path

import pytest


class Killed(BaseException):
    """The process does not go on from here; no `except` or `finally` of its may touch the disk any more."""


NEEDS_ROOM = {"open", "write", "flush", "fsync", "mkdir", "link", "replace", "rename"}


class Disk:
    """Within a `with` block, counts what is done to files under `root` and fails at the `at`-th operation (from 1).

    `fault`: "kill", the process dies; "power", so does the machine, and what was not fsynced is lost: the second half
    of a file's data, and whatever was made, renamed or deleted in a directory since the directory was fsynced; an
    errno, which this and all later operations raise: all but reading, or for ENOSPC those that need room.
    A write that fails leaves its first half. Afterwards `count` and `done`, the operations; `hit`, whether it failed.
    """

    def __init__(self, root: Path, at: int | None = None, fault: str | int = "kill") -> None:
        self.root, self.at, self.fault = str(root), at, fault
        self.done: list[str] = []
        self.hit = False
        self._files: list[_File] = []
        self._unsynced: set[int] = set()
        self._undo: list[tuple[str, object]] = []
        self._real = {name: getattr(os, name) for name in _OPERATIONS}
        self._open = builtins.open

    @property
    def count(self) -> int:
        return len(self.done)

    def __enter__(self) -> Disk:
        self._patch = pytest.MonkeyPatch()
        for name in _OPERATIONS:
            self._patch.setattr(os, name, getattr(self, f"_{name}"))
        self._patch.setattr(builtins, "open", self._opened)
        self._patch.setattr(io, "open", self._opened)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        self._patch.undo()
        for file in self._files:
            file.raw.close()
        if self.hit and self.fault == "power":
            self._lose_what_is_not_synced()
        return kind is Killed

    def _lose_what_is_not_synced(self) -> None:
        for path in Path(self.root).rglob("*"):
            if path.is_file() and path.stat().st_ino in self._unsynced:
                os.truncate(path, path.stat().st_size // 2)
        for _, undo in reversed(self._undo):
            undo()

    def _mine(self, path: object) -> str | None:
        """The absolute path, if it is the root or under it; of a file descriptor too."""
        with contextlib.suppress(TypeError, OSError):
            found = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.path.abspath(os.fspath(path))
            if f"{found}/".startswith(f"{self.root}/"):
                return found
        return None

    def _do(self, name: str, path: object) -> str | None:
        """Counts; raises if this operation fails."""
        mine = self._mine(path)
        if mine is None:
            return None
        if self.hit and self.fault in ("kill", "power"):
            raise Killed(f"{name} after death")
        self.done.append(f"{name} {os.path.relpath(mine, self.root)}")
        if self.count == self.at:
            self.hit = True
            if self.fault in ("kill", "power"):
                raise Killed(f"in {self.done[-1]}")
        if self.hit and (self.fault != errno.ENOSPC or name in NEEDS_ROOM):
            raise OSError(self.fault, os.strerror(self.fault), mine)
        return mine

    def _later(self, path: str, undo: object) -> None:
        self._undo.append((os.path.dirname(path), undo))

    def _opened(self, file, mode="r", *arguments, **named):
        if not set(mode) & set("wax+") or self._mine(file) is None:
            return self._open(file, mode, *arguments, **named)
        path = self._do("open", file)
        if not os.path.exists(path):
            self._later(path, lambda: Path(path).unlink(missing_ok=True))
        raw = self._open(file, mode, *arguments, **named)
        self._files.append(_File(self, raw))
        return self._files[-1]

    def _fsync(self, fd):
        path = self._do("fsync", fd)
        if path is not None:
            self._unsynced.discard(os.fstat(fd).st_ino)
            self._undo = [(directory, undo) for directory, undo in self._undo if directory != path]
        # Nothing really goes down here, and the real thing is slow.

    def _mkdir(self, path, *arguments, **named):
        mine = None if os.path.isdir(path) else self._do("mkdir", path)
        self._real["mkdir"](path, *arguments, **named)
        if mine:
            self._later(mine, lambda: shutil.rmtree(mine))

    def _replace(self, source, target):
        self._move("replace", source, target)

    def _rename(self, source, target):
        self._move("rename", source, target)

    def _move(self, name, source, target):
        if mine := self._do(name, target):
            old = Path(mine).read_bytes() if os.path.exists(mine) else None

            def undo():
                self._real["rename"](mine, source)
                if old is not None:
                    Path(mine).write_bytes(old)

            self._later(mine, undo)
        self._real["replace"](source, target)

    def _link(self, source, target):
        mine = self._do("link", target)
        self._real["link"](source, target)
        if mine:
            self._later(mine, lambda: Path(mine).unlink())

    def _unlink(self, path, **named):
        if os.path.exists(path) and (mine := self._do("unlink", path)):
            content = Path(mine).read_bytes()
            self._later(mine, lambda: Path(mine).write_bytes(content))
        self._real["unlink"](path, **named)

    def _ftruncate(self, fd, length):
        self._do("write", fd)
        self._real["ftruncate"](fd, length)

    def _write(self, fd, data):
        self._do("write", fd)
        return self._real["write"](fd, data)


_OPERATIONS = ("fsync", "mkdir", "replace", "rename", "link", "unlink", "ftruncate", "write")


class _File:
    """A file open for writing: the first half of what is written goes out at once, the rest when it is flushed."""

    def __init__(self, disk: Disk, raw) -> None:
        self.raw, self._disk, self._kept = raw, disk, b""

    def write(self, data):
        half = len(data) // 2
        try:
            self._disk._do("write", self.raw.name)
        except BaseException:
            self._out(data[:half])
            raise
        self._out(data[:half])
        self._kept = data[half:]

    def flush(self):
        self._disk._do("flush", self.raw.name)
        self._out(self._kept)
        self._kept = b""

    def _out(self, data):
        if data and not self.raw.closed:
            self._disk._unsynced.add(os.fstat(self.raw.fileno()).st_ino)
            self.raw.write(data)
            self.raw.flush()

    def close(self):
        if self._kept and not self._disk.hit:
            self._out(self._kept)
        self.raw.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __getattr__(self, name):
        return getattr(self.raw, name)
