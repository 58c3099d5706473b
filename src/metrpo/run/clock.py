"""Seconds per stage, for metrics.csv."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Seconds per stage; a stage inside another (validate in improve) is not counted twice."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(("collect", "fit", "improve", "validate", "evaluate"), 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Counts what happens inside the block towards `stage`."""
        start, counted = time.perf_counter(), sum(self.seconds.values())
        yield
        inner = sum(self.seconds.values()) - counted
        self.seconds[stage] += time.perf_counter() - start - inner

    def row(self) -> dict[str, float]:
        """The metrics' columns."""
        return {f"seconds_{stage}": seconds for stage, seconds in self.seconds.items()}
