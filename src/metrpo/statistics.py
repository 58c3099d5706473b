"""Statistics over few seeds, after Agarwal et al. 2021 ("Deep RL at the edge of the statistical precipice").

`Scores` are [seeds, tasks], of one task also [seeds], and along curves [seeds, tasks, points]; or, where tasks differ
in their number of seeds, a list with one array [seeds] or [seeds, points] a task. Statistics of curves are per point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from metrpo.types import Array

Scores = Array | Sequence[Array]
Statistic = Callable[..., Array]
"""(scores, ...) -> a number, or one per point: [points]."""

FEWEST_SEEDS = 3
"""With fewer in any task, the tails of the bootstrap say nothing."""


def iqm(scores: Scores) -> Array:
    """Interquartile mean over all seeds and tasks: the mean without the lowest and the highest quarter of the scores.

    [seeds, tasks] -> a number, in the scores' unit; [seeds, tasks, points] -> [points]. Quarters are rounded down to
    whole scores. NaN where a score is NaN: a failed run must not pass for an outlier (Agarwal et al., section 4.3).
    """
    pooled = np.sort(np.concatenate(_by_task(scores)), axis=0)
    cut = len(pooled) // 4
    # Sorting puts NaN last.
    return np.where(np.isnan(pooled[-1]), np.nan, pooled[cut : len(pooled) - cut].mean(axis=0))[()]


def probability_of_improvement(x: Scores, y: Scores) -> Array:
    """Mean over the tasks of P(X > Y) + P(X = Y) / 2, over all pairs of a seed of `x` and one of `y` (Mann-Whitney U).

    [seeds, tasks] twice -> a number in [0, 1]; [seeds, tasks, points] -> [points]. NaN where a score is NaN. Raises
    `ValueError` when the tasks differ in number (Agarwal et al., section 4.3).
    """
    return np.mean([_wins(a, b) for a, b in zip(_by_task(x), _by_task(y), strict=True)], axis=0)


def stratified_bootstrap(
    statistic: Statistic, *scores: Scores, repetitions: int = 2000, seed: int = 0, level: float = 0.95
) -> tuple[Array, Array]:
    """Percentile confidence interval of `statistic(*scores)`: (low, high), each as the statistic, a number or [points].

    Seeds are redrawn with replacement within each task, independently of the other tasks and of the other `scores`; a
    seed's curve is drawn whole. With fewer than three seeds in a task the interval is the range of the redrawn
    statistics, which promises no coverage, and with one seed everywhere the point itself (Agarwal et al., section 4.1).
    """
    rng = np.random.default_rng(seed)
    samples = [_by_task(s) for s in scores]
    redrawn = [
        statistic(*([task[rng.integers(len(task), size=len(task))] for task in sample] for sample in samples))
        for _ in range(repetitions)
    ]
    tail = 0.0 if fewest_seeds(*scores) < FEWEST_SEEDS else (1.0 - level) / 2
    low, high = np.quantile(redrawn, [tail, 1.0 - tail], axis=0)
    return low, high


def fewest_seeds(*scores: Scores) -> int:
    """Seeds of the task that has the fewest."""
    return min(len(task) for sample in scores for task in _by_task(sample))


def caveat(*scores: Scores) -> str:
    """One sentence to stand beside an interval of `stratified_bootstrap`; empty where there are seeds enough."""
    if fewest_seeds(*scores) >= FEWEST_SEEDS:
        return ""
    if all(len(task) == 1 for sample in scores for task in _by_task(sample)):
        return "One seed: the interval is the point itself."
    return f"Fewer than {FEWEST_SEEDS} seeds: the interval is the range of what resampling gives."


def steps_to_reach(steps: Array, returns: Array, level: float) -> float:
    """Real steps at which a learning curve first reaches `level`, on straight lines between its points; NaN if never.

    `steps` and `returns` are [points]; points whose return is not finite are left out. A curve that begins at or above
    `level` reaches it at its first point. Raises `ValueError` unless steps increase from point to point.
    """
    steps, returns = _curve(steps, returns)
    measured = np.isfinite(returns)
    steps, returns = steps[measured], returns[measured]
    reached = np.flatnonzero(returns >= level)
    if not len(reached):
        return float("nan")
    last = reached[0]
    if last == 0:
        return float(steps[0])
    share = (level - returns[last - 1]) / (returns[last] - returns[last - 1])
    return float(steps[last - 1] + share * (steps[last] - steps[last - 1]))


def at_steps(curves: Sequence[tuple[Array, Array]], grid: Array, log: bool = False, log_y: bool = False) -> np.ndarray:
    """Learning curves at common real steps: [(steps [points], returns [points]), ...], `grid` [G] -> [curves, G].

    On lines between the points that are straight where steps (`log`) or returns (`log_y`) stand on a logarithmic axis;
    NaN before a curve's first point and after its last. Raises `ValueError` unless steps increase from point to point.
    """
    across, up = (np.log if is_log else np.asarray for is_log in (log, log_y))
    lines = [_curve(*curve) for curve in curves]
    values = np.array([np.interp(across(grid), across(x), up(y), left=np.nan, right=np.nan) for x, y in lines])
    return np.exp(values) if log_y else values


def common_grid(curves: Sequence[tuple[Array, Array]], points: int, log: bool = False) -> np.ndarray:
    """Real steps at which all these curves are measured: so many at equal distances (of their logarithm with `log`).

    The curves' own points are among them: there a line bends, and the band of two must contain both.
    """
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    even = (np.geomspace if log else np.linspace)(first, last, points)
    own = np.concatenate([np.asarray(steps, np.float64) for steps, _ in curves])
    return np.unique(np.clip([*even, *own], first, last))


def mean_band(
    curves: Sequence[tuple[Array, Array]], grid: Array, log: bool = False, log_y: bool = False
) -> tuple[np.ndarray, Array, Array]:
    """Mean of learning curves (see `at_steps`) [G], and its 95 % bootstrap interval [G], [G] (of two, their range)."""
    values = at_steps(curves, grid, log, log_y)
    low, high = stratified_bootstrap(lambda scores: np.mean(scores[0], axis=0), [values], repetitions=500)
    return values.mean(axis=0), low, high


def _by_task(scores: Scores) -> list[np.ndarray]:
    if isinstance(scores, list | tuple):
        tasks = [np.asarray(task, np.float64) for task in scores]
    else:
        array = np.asarray(scores, np.float64)
        tasks = [array] if array.ndim == 1 else list(np.moveaxis(array, 1, 0))
    if not tasks or not all(task.ndim and len(task) for task in tasks):
        raise ValueError("scores: expected at least one seed of at least one task, got none")
    return tasks


def _wins(x: np.ndarray, y: np.ndarray) -> Array:
    """Share of the pairs that `x` [seeds, ...] wins against `y` [seeds, ...], ties counting half."""
    # The sign is NaN where a score is, which a comparison would turn into a lost pair.
    return np.mean((1.0 + np.sign(x[:, None] - y[None])) / 2, axis=(0, 1))


def _curve(steps: Array, returns: Array) -> tuple[np.ndarray, np.ndarray]:
    steps, returns = np.asarray(steps, np.float64), np.asarray(returns, np.float64)
    if steps.ndim != 1 or steps.shape != returns.shape or not np.all(np.diff(steps) > 0):
        raise ValueError(f"curve: expected as many returns as steps, and increasing steps, got {steps} and {returns}")
    return steps, returns
