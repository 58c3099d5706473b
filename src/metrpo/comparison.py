"""Groups of runs side by side, task by task: what their seeds earn, how soon, and how likely one beats another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from metrpo.errors import ConfigError
from metrpo.run.find import Group, SeenRun, group, no_skill
from metrpo.run.yardstick_record import NAMES
from metrpo.statistics import caveat, probability_of_improvement, steps_to_reach, stratified_bootstrap


@dataclass(frozen=True)
class Interval:
    """A mean over seeds, or a probability, with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Compared:
    """One group of seeds; returns are those of the policy without noise (collected ones, where only those exist)."""

    task: str
    label: str
    seeds: int
    real_steps: tuple[int, int]
    """Fewest and most of its runs."""
    last: Interval
    """Of every seed's last return."""
    worst: float
    """Of the seeds' last returns the lowest."""
    best: float
    """The best return of any seed at any time."""
    no_skill: dict[str, float]
    """What doing nothing and random actions earn, by name; empty where no run has measured it."""
    level: float
    """Return for `steps`."""
    steps: float | None
    """Median real steps to that level, over the seeds that reach it; None: none does."""
    reached: int
    """Seeds that reach it."""
    better: Interval | None
    """Probability that a seed of it earns more at last than one of the task's reference; None for that itself."""
    against: str
    """The reference."""
    caveat: str
    """What to think of the intervals; empty where there are seeds enough, each once."""

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def compare(
    runs: Sequence[SeenRun], levels: Mapping[str, float] | float | None = None, against: str | None = None
) -> list[Compared]:
    """Every group of the runs, tasks in the order of their first run; runs without an evaluation are left out.

    `levels` is the return of interest, for all tasks or by task; where there is none, the least of the groups' mean
    last returns. `against` is the label of the group that others are held against, by default me-trpo, or a task's
    first where it has none.

    Raises `ConfigError` when no run has a return, no group is called `against`, or a level is for a task without runs.
    """
    groups = [g for g in map(_measured, group(runs)) if g.runs]
    if not groups:
        raise ConfigError("compare: expected runs with at least one evaluation, got none; let an iteration finish")
    labels = list(dict.fromkeys(g.label for g in groups))
    if against is not None and against not in labels:
        raise ConfigError(f"against: expected one of {', '.join(labels)}, got {against}")
    tasks = list(dict.fromkeys(g.task for g in groups))
    for task in levels if isinstance(levels, Mapping) else ():
        if task not in tasks:
            raise ConfigError(f"level: expected one of the tasks {', '.join(tasks)}, got {task}")
    found = []
    for task in tasks:
        here = [g for g in groups if g.task == task]
        reference = next((g for name in (against, "me-trpo") for g in here if g.label == name), here[0])
        given = levels.get(task) if isinstance(levels, Mapping) else levels
        level = min(float(np.mean(_last(g))) for g in here) if given is None else given
        found += [_compared(g, reference, level) for g in here]
    return found


def _compared(own: Group, reference: Group, level: float) -> Compared:
    last, ends = _last(own), [int(run.rows[-1]["real_steps"] or 0) for run in own.runs]
    steps = np.array([_steps(run, level) for run in own.runs])
    reached = steps[np.isfinite(steps)]
    better = None
    if own is not reference:
        better = _interval(probability_of_improvement, last, _last(reference))
    return Compared(
        task=own.task,
        label=own.label,
        seeds=len(last),
        real_steps=(min(ends), max(ends)),
        last=_interval(np.mean, last),
        worst=float(last.min()),
        best=max(float(np.nanmax(_returns(run))) for run in own.runs),
        no_skill=no_skill(own.runs),
        level=level,
        steps=float(np.median(reached)) if len(reached) else None,
        reached=len(reached),
        better=better,
        against=reference.label,
        caveat=" ".join(filter(None, [caveat(last, *([] if better is None else [_last(reference)])), _repeats(own)])),
    )


def _repeats(group: Group) -> str:
    """A sentence where runs of one seed stand as several seeds; else empty."""
    times = Counter(run.config.seed for run in group.runs)
    seeds = [str(seed) for seed, count in times.items() if count > 1]
    if not seeds:
        return ""
    return f"{group.task}, {group.label}: several runs of seed {', '.join(seeds)}, which are not independent."


def _interval(statistic: Any, *scores: np.ndarray) -> Interval:
    if all(len(sample) == 1 for sample in scores):  # however often one seed is redrawn
        return Interval(*[float(statistic(*scores))] * 3)
    low, high = stratified_bootstrap(lambda *redrawn: statistic(*(sample[0] for sample in redrawn)), *scores)
    return Interval(float(statistic(*scores)), float(low), float(high))


def has_returns(run: SeenRun) -> bool:
    """Whether any of its episodes has been measured."""
    return bool(np.isfinite(_returns(run)).any())


def _measured(group: Group) -> Group:
    """The group's runs that have any return."""
    return Group(group.task, group.label, [run for run in group.runs if has_returns(run)])


def _returns(run: SeenRun) -> np.ndarray:
    real = run.column("return_real")
    return real if np.isfinite(real).any() else run.column("return_collected")


def _last(group: Group) -> np.ndarray:
    """[seeds]: every run's last return that was measured."""
    found = [_returns(run) for run in group.runs]
    return np.array([returns[np.isfinite(returns)][-1] for returns in found])


def _steps(run: SeenRun, level: float) -> float:
    steps, returns = run.column("real_steps"), _returns(run)
    grows = steps > np.append(-np.inf, np.maximum.accumulate(steps))[:-1]  # --real-steps 0 collects none
    return steps_to_reach(steps[grows], returns[grows], level)


# ---------------------------------------------------------------- tables


HEADER = (
    *("task", "system", "seeds", "real steps", "last return", "95 %", "worst seed", "best"),
    *(*NAMES.values(), "level", "steps to it", "better"),
)


def cells(one: Compared) -> tuple[str, ...]:
    """A row of the table, for people."""
    few, most = one.real_steps
    reached = "" if one.reached == one.seeds else f" ({one.reached} of {one.seeds})"
    better = "reference" if one.better is None else _range(one.better, 2)
    return (
        one.task,
        one.label,
        str(one.seeds),
        f"{few:,}" if few == most else f"{few:,} to {most:,}",
        _return(one.last.value),
        f"{_return(one.last.low)} to {_return(one.last.high)}" if one.seeds > 1 else "-",
        _return(one.worst),
        _return(one.best),
        *(_return(one.no_skill[name]) if name in one.no_skill else "-" for name in NAMES.values()),
        _return(one.level),
        "-" if one.steps is None else f"{one.steps:,.0f}{reached}",
        better,
    )


def whole(one: Compared) -> dict[str, str]:
    """The same for programs, by column: every number whole and alone, and empty where there is none."""
    better = (None,) * 3 if one.better is None else (one.better.value, one.better.low, one.better.high)
    values: dict[str, Any] = {
        "task": one.task,
        "system": one.label,
        "seeds": one.seeds,
        **dict(zip(("fewest real steps", "most real steps"), one.real_steps, strict=True)),
        "last return": one.last.value,
        "last return, low": one.last.low,
        "last return, high": one.last.high,
        "worst seed": one.worst,
        "best": one.best,
        **{name: one.no_skill.get(name) for name in NAMES.values()},
        "level": one.level,
        "steps to it": one.steps,
        "seeds that reach it": one.reached,
        **dict(zip(("better", "better, low", "better, high"), better, strict=True)),
        "against": one.against,
    }
    return {name: "" if value is None else str(value) for name, value in values.items()}


def _return(value: float) -> str:
    return f"{value:.1f}" if abs(value) < 1e9 else f"{value:.2g}"


def _range(interval: Interval, digits: int) -> str:
    value, low, high = (f"{x:.{digits}f}" for x in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"


def notes(found: Sequence[Compared]) -> list[str]:
    """What a reader of the table must know."""
    said = [
        "last return: mean over seeds of the last evaluation, with its 95 % bootstrap interval; worst seed: the "
        "lowest of them; best: of any seed at any time; steps to it: median real steps to the level, of the seeds that "
        "reach it; better: probability that a seed earns more than one of the reference."
    ]
    return said + list(dict.fromkeys(one.caveat for one in found if one.caveat))
