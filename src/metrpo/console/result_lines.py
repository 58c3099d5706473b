"""A run's results and times in words: one line each."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from metrpo.counting import counted

Measured = Mapping[str, Any]
"""An iteration's metrics by column."""


def summary(row: Measured) -> str:
    """The main metrics of an iteration in one line."""
    parts = [
        f"{row.get('real_steps', 0):>7,} real steps",
        f"return {rounded(row.get('return_real')):>7} ± {rounded(row.get('return_real_std'))}",
    ]
    if _is_missing(row.get("return_real")):
        parts[1] = f"collected {rounded(row.get('return_collected')):>7}"
        if row.get("failed_evaluation"):  # else only another program plays
            parts[1] = f"evaluation failed, {parts[1]}"
    if "return_imagined" in row:
        parts.append(f"imagined {rounded(row['return_imagined']):>7}")
    seconds = sum(v for name, v in row.items() if name.startswith("seconds_") and v is not None)
    return "  ".join([*parts, duration(seconds)] if seconds else parts)


def outcome(row: Measured, run_dir: Path) -> str:
    """The result of a run in one line, from its last iteration."""
    after = f"after {row['real_steps']:,} real steps"
    if not _is_missing(row.get("return_real")):
        return f"return {rounded(row['return_real'])} ± {rounded(row.get('return_real_std'))} {after}"
    if _has_no_environment(row):
        return f"collected {rounded(row.get('return_collected'))} {after}"
    return (
        f"no return {after}: the last evaluation failed, as the warning above says; "
        f"to see where: metrpo evaluate {shlex.quote(str(run_dir))}"
    )


def _has_no_environment(row: Measured) -> bool:
    """Whether only another program plays."""
    return not row.get("failed_evaluation") and "return_imagined" in row


def earned(row: Measured) -> str:
    """The real return of an iteration, or the collected one where only another program plays."""
    if _is_missing(row.get("return_real")):
        return f"collected {rounded(row.get('return_collected'))}"
    return f"return {rounded(row.get('return_real'))}"


def _is_missing(value: float | None) -> bool:
    return value is None or math.isnan(value)


def duration(seconds: float) -> str:
    """Seconds for people: "42 s", "3 min 05 s", "2 h 10 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def resuming(where: str, iteration: int, of: int | None, real_steps: int, waiting: int) -> str:
    """Where a run resumes, or that it is finished: `Progress.resume` says what the numbers are."""
    steps = counted(real_steps, "real step")
    if of is not None and iteration > of:
        return f"{where} is finished: {counted(of, 'iteration')}, {steps}; raise the budget to continue it"
    budget = "" if of is None else f" of {of}"
    collected = f" and {waiting:,} new ones" if waiting else ""
    return f"resuming {where} at iteration {iteration}{budget}, {steps}{collected}"


def heading(iteration: int, of: int | None) -> str:
    """An iteration's number, and of how many where that is known."""
    return f"iteration {iteration}" + (f"/{of}" if of is not None else "")


def time_left(seconds: float | None) -> str:
    """The time left, after a line; nothing where it is unknown or over."""
    return "" if not seconds else f"   about {duration(seconds)} left"


def rounded(value: float | None) -> str:
    """A return or the like; a dash where there is none."""
    return "-" if value is None else f"{value:.1f}"
