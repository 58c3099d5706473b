"""A finding about a run, and how findings are read off the rows of metrics.csv."""

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
    """A warning says that something is wrong; a note helps to judge the run."""
    since: int
    """The first iteration of the unbroken stretch, up to the last one, in which it holds."""
    measured: str
    meaning: str
    help: str

    @property
    def text(self) -> str:
        """The finding in one line."""
        return f"{self.measured} since iteration {self.since}: {self.meaning}; {self.help}"


def since_when(rows: Sequence[Row], holds: np.ndarray) -> int | None:
    """The first iteration of the stretch, up to the last row, in which something holds; None if it does not there."""
    broken = np.flatnonzero(~holds)
    first = int(broken[-1]) + 1 if len(broken) else 0
    return int(iteration_at(rows, first)) if first < len(rows) else None


def iteration_at(rows: Sequence[Row], index: int) -> float:
    """The iteration of a row; -inf where there is no such row."""
    if index < -len(rows):
        return -math.inf
    return rows[index]["iteration"] or 0


def losses_of(rows: Sequence[Row]) -> np.ndarray:
    """Validation losses [iterations, members]."""
    names = [name for name in rows[0] if name.startswith("validation_loss_")]
    return np.array([column(rows, name) for name in names]).T.reshape(len(rows), len(names))


def horizons(rows: Sequence[Row]) -> list[str]:
    """The horizons whose model errors were measured, shortest first: "1", "5", ..., "T"."""
    names = [match[1] for name in (rows[0] if rows else ()) if (match := re.fullmatch(r"error_(\d+|T)", name))]
    return [name for name in names if np.isfinite(column(rows, f"error_{name}")).any()]


def after(steps: str) -> str:
    """A horizon in words."""
    return {"1": "1 step", "T": "an imagined episode"}.get(
        steps, counted(int(steps), "step") if steps.isdigit() else steps
    )


def standard_error(rows: Sequence[Row], config: Config) -> np.ndarray:
    """Standard error of each row's mean return [iterations]."""
    return np.nan_to_num(column(rows, "return_real_std")) / math.sqrt(config.evaluation_episodes)


def short(value: float) -> str:
    """A number with three digits, and an exponent only where one is needed."""
    return f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
