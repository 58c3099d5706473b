"""Metrics: `metrics.csv`, one row per outer iteration, and the same numbers as TensorBoard events."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
    """The rows of a `metrics.csv`, ints as ints, floats exactly as written."""
    with open(path, newline="") as file:
        return [{name: _parse(cell) for name, cell in row.items()} for row in csv.DictReader(file)]


class Events:
    """TensorBoard events of one run: one scalar per column, against real steps.

    Starting it writes the rows so far anew, so that a resumed run shows no iteration twice and misses none.
    """

    def __init__(self, directory: Path, rows: Sequence[Row] = ()) -> None:
        from tensorboardX import SummaryWriter  # slow to import, and needed by training only

        for old in directory.glob("events.out.tfevents.*"):
            old.unlink()
        self._writer = SummaryWriter(str(directory))
        for row in rows:
            self.add(row)

    def add(self, row: Row) -> None:
        """Writes one row, and puts it on disk."""
        for name, value in row.items():
            if value is not None and math.isfinite(value):
                self._writer.add_scalar(name, value, global_step=int(row["real_steps"] or 0))
        self._writer.flush()

    def close(self) -> None:
        """Ends the events file."""
        self._writer.close()


def _plain(value: Any) -> int | float | None:
    if value is None or type(value) in (int, float):
        return value
    number = value.item() if hasattr(value, "item") else value
    return int(number) if isinstance(number, int) else float(number)


def _parse(cell: str) -> int | float | None:
    if not cell:
        return None
    try:
        return int(cell)
    except ValueError:
        return float(cell)
