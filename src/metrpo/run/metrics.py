"""Metrics: `metrics.csv`, one row per outer iteration, and the same numbers as TensorBoard events."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import socket
import struct
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from metrpo.counting import counted
from metrpo.errors import RunDirectoryError
from metrpo.safe_load import text_of

Row = dict[str, int | float | None]
"""One iteration by column, in column order; None is an empty cell."""


def plain(row: Mapping[str, Any]) -> Row:
    """The row in Python's own ints and floats, whatever NumPy or JAX scalars it came in."""
    return {name: _plain(value) for name, value in row.items()}


def without_clocks(row: Row) -> Row:
    """The row with its clock readings left empty: what a deterministic run repeats byte for byte."""
    return {name: None if is_clock(name) else value for name, value in row.items()}


def is_clock(column: str) -> bool:
    """Whether a column holds a clock reading, which no two runs share."""
    return column.startswith("seconds_") or column == "wall_seconds"


_LATER = re.compile(
    r"members_reset|failed_episodes|failed_evaluation|unfit_dimensions|(error|disagreement|improved)_\w+|outside|saturated"
    r"|return_proof|given_up"
)
"""Columns that runs begun with an earlier version do not have."""
_DETAIL = re.compile(r"error_\w+_\d+|improved_\d+")
"""Columns of one state dimension or one model."""


def overview(row: Row) -> Row:
    """The row's columns for metrics.csv: one for each thing measured."""
    return {name: value for name, value in row.items() if not _DETAIL.fullmatch(name)}


def details(row: Row) -> Row:
    """The row's columns for diagnostics.csv: one for each state dimension or model; empty when it has none."""
    found = {name: value for name, value in row.items() if _DETAIL.fullmatch(name)}
    return {name: row[name] for name in ("iteration", "real_steps")} | found if found else {}


def completed(row: Row, like: Row) -> Row:
    """A row from before some of the columns came up, with those that `like` has left empty."""
    late = [name for name in like if name not in row and _LATER.fullmatch(name)]
    if not late or [name for name in like if name not in late] != list(row):
        return row
    return {name: row.get(name) for name in like}


def to_csv(rows: Sequence[Row]) -> str:
    """CSV text with a header; floats in full precision, NaN as `nan`, None as an empty cell.

    Raises `ValueError` when the rows do not share their columns.
    """
    if not rows:
        return ""
    columns = list(rows[0])
    for row in rows:
        if list(row) != columns:
            raise ValueError(f"metrics: expected the columns {columns}, got {list(row)}")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(["" if value is None else repr(value) for value in row.values()] for row in rows)
    return text.getvalue()


def read_metrics(path: str | Path) -> list[Row]:
    """The rows of a `metrics.csv`, or of that in a run directory, ints as ints, floats exactly as written.

    Raises `RunDirectoryError` when it cannot be read, or is no table of numbers.
    """
    path = Path(path)
    text = text_of(path / "metrics.csv" if path.is_dir() else path, RunDirectoryError)
    try:
        columns, *lines = list(csv.reader(io.StringIO(text, newline=""), strict=True)) or [[]]
        if len(set(columns)) != len(columns):
            raise ValueError("a column is there twice")
        return [dict(zip(columns, map(_parse, line), strict=True)) for line in lines]
    except (ValueError, csv.Error) as error:
        raise RunDirectoryError(f"{path}: expected a table of numbers, got something else ({error})") from None


def numbers(values: Iterable[float | None]) -> np.ndarray:
    """As an array, with NaN where there is none."""
    return np.array([math.nan if value is None else value for value in values], dtype=float)


def column(rows: Iterable[Row], name: str) -> np.ndarray:
    """One number a row [len(rows)]; NaN where there is none."""
    return numbers(row.get(name) for row in rows)


def checked(rows: Any, iteration: int) -> list[Row]:
    """`rows`, which a file says are those of a run after `iteration` iterations.

    Raises `ValueError` when they are not rows of numbers with the same columns, one for each iteration.
    """
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("expected a list of rows")
    if not all(value is None or type(value) in (int, float) for row in rows for value in row.values()):
        raise ValueError("expected numbers in every row")
    to_csv(rows)
    if rows and not {"iteration", "real_steps", "wall_seconds"} <= rows[0].keys():
        raise ValueError("expected the columns iteration, real_steps and wall_seconds")
    if [row["iteration"] for row in rows] != list(range(1, iteration + 1)):
        raise ValueError(f"expected a row for each of {counted(iteration, 'iteration')}, got {len(rows)}")
    return rows


class Events:
    """TensorBoard events of one run: one scalar per column, against real steps.

    Starting it writes the rows so far anew, so that a resumed run shows no iteration twice and misses none.
    """

    def __init__(self, directory: Path, rows: Sequence[Row] = ()) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        for old in directory.glob("events.out.tfevents.*"):
            old.unlink()
        self.path = directory / f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}"
        self._write([{"file_version": "brain.Event:2"}, *(event for row in rows for event in _events(row))])

    def add(self, row: Row) -> None:
        """Writes one row, and puts it on disk. Raises `OSError`."""
        self._write(_events(row))

    def _write(self, events: Sequence[Mapping[str, Any]]) -> None:
        # tensorboardX's own writer has a thread and a queue: a full disk ends the one, then the other waits forever.
        from tensorboardX.proto.event_pb2 import Event  # slow to import, and needed by training only

        with open(self.path, "ab") as file:
            file.write(b"".join(_record(Event(wall_time=time.time(), **event).SerializeToString()) for event in events))
            file.flush()
            os.fsync(file.fileno())


def _events(row: Row) -> list[dict[str, Any]]:
    step = int(row["real_steps"] or 0)
    finite = {n: v for n, v in overview(row).items() if v is not None and math.isfinite(v)}
    return [{"step": step, "summary": {"value": [{"tag": n, "simple_value": v}]}} for n, v in finite.items()]


def _record(data: bytes) -> bytes:
    """As TensorBoard reads it: the length, its checksum, the data, their checksum."""
    from tensorboardX.record_writer import masked_crc32c

    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc32c(length)) + data + struct.pack("<I", masked_crc32c(data))


def _plain(value: Any) -> int | float | None:
    if value is None or type(value) in (int, float):
        return value
    number = value.item() if hasattr(value, "item") else value
    return int(number) if isinstance(number, int) else float(number)


def _parse(cell: str) -> int | float | None:
    if not cell:
        return None
    # A whole number too long for Python is none, and not infinite.
    return int(cell) if re.fullmatch(r"-?[0-9]+", cell) else float(cell)
