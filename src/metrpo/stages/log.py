"""What the stages that play real episodes ask of those who keep them (a run directory, or nobody)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from metrpo.types import Episode


class Log(Protocol):
    """Where real episodes go as they end, and where those wait that nobody has learned from yet."""

    def pending(self) -> list[Episode]:
        """The episodes that wait, but for proofs."""

    def proofs(self) -> list[Episode]:
        """Those that were played to try this iteration's policy (`stages.proven`)."""

    def append(self, episode: Episode, proof: bool = False) -> object:
        """Keeps one more."""

    def failures(self) -> Mapping[int, bool]:
        """The episodes of this iteration in which the environment failed, and whether each is left out for good."""

    def note_failures(self, failures: Mapping[int, bool]) -> None:
        """Keeps them."""


class Unkept:
    """A log of nothing but the failures of one iteration."""

    def __init__(self) -> None:
        self._failures: Mapping[int, bool] = {}

    def pending(self) -> list[Episode]:
        """None."""
        return []

    def proofs(self) -> list[Episode]:
        """None."""
        return []

    def append(self, episode: Episode, proof: bool = False) -> None:
        """Forgotten."""

    def failures(self) -> Mapping[int, bool]:
        """The last ones noted."""
        return self._failures

    def note_failures(self, failures: Mapping[int, bool]) -> None:
        """Remembered."""
        self._failures = dict(failures)


def left_out(log: Log) -> int:
    """Episodes of this iteration that are played no more, for the environment failed in them."""
    return sum(log.failures().values())
