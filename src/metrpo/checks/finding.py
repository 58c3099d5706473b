"""What there is to say about a run: the record, and how its signs are read off the rows of metrics.csv."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from metrpo.config import Config
from metrpo.counting import counted
from metrpo.run.metrics import Row, column


@dataclass(frozen=True)
class Concern:
    """One thing about a run that a person should know."""

    code: str
    """Its name for scripts, such as "model-exploited"."""
    level: Literal["warning", "note"]
    """A warning says that something is wrong; a note, what to know when judging the run."""
    since: int
    """The iteration from which on it holds, without a break up to the last one."""
    measured: str
    meaning: str
    help: str

    @property
    def text(self) -> str:
        """The whole as one line."""
        return f"{self.measured} since iteration {self.since}: {self.meaning}; {self.help}"


def since_when(rows: Sequence[Row], holds: np.ndarray) -> int | None:
    """The iteration from which on something holds up to the last row; None when it does not hold there."""
    broken = np.flatnonzero(~holds)
    first = int(broken[-1]) + 1 if len(broken) else 0
    return int(iteration_at(rows, first)) if first < len(rows) else None


def iteration_at(rows: Sequence[Row], index: int) -> float:
    """The iteration of a row; before all where there is no such row."""
    if index < -len(rows):
        return -math.inf
    return rows[index]["iteration"] or 0


def losses_of(rows: Sequence[Row]) -> np.ndarray:
    """Validation losses [iterations, members]."""
    names = [name for name in rows[0] if name.startswith("validation_loss_")]
    return np.array([column(rows, name) for name in names]).T.reshape(len(rows), len(names))


def horizons(rows: Sequence[Row]) -> list[str]:
    """The numbers of steps whose model errors were measured at all, least first: "1", "5", ..., "T"."""
    names = [found[1] for name in (rows[0] if rows else ()) if (found := re.fullmatch(r"error_(\d+|T)", name))]
    return [name for name in names if np.isfinite(column(rows, f"error_{name}")).any()]


def after(steps: str) -> str:
    """Such a number in words."""
    return {"1": "1 step", "T": "an imagined episode"}.get(
        steps, counted(int(steps), "step") if steps.isdigit() else steps
    )


def standard_error(rows: Sequence[Row], config: Config) -> np.ndarray:
    """Of each row's mean return [iterations]."""
    return np.nan_to_num(column(rows, "return_real_std")) / math.sqrt(config.evaluation_episodes)


def short(value: float) -> str:
    """Three digits, without an exponent where none is needed."""
    return f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
