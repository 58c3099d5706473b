"""What a vote of the models would have been worth: `python benchmarks/drops.py` prints the table of the trials' page.

A drop is an iteration of the actor-critic whose real return is less than three quarters of the one before, counted from
the first return above half of the run's best on. A vote (`validate.rule` ensemble, `validate.threshold` 0.7) rejects a
policy that fewer models see improve (`fraction_improved`: on the policy of the iteration before). Of every run in
`results/own/TASK/actor-critic`, in the iterations that count: how many policies with a drop the vote would have
rejected, and how many of the others.
"""

from __future__ import annotations

import numpy as np
from summarise import ROOT

from metrpo import read_metrics
from metrpo.report.tables import markdown
from metrpo.run.metrics import Row, column

DROP, THRESHOLD = 0.75, 0.7
HEADER = ["task", "seeds", "iterations", "drops", "of these rejected", "others rejected"]


def table() -> str:
    """The table as Markdown, a row for each task and one for all."""
    runs: dict[str, list[np.ndarray]] = {}
    for path in sorted((ROOT / "own").glob("*/actor-critic/seed-*/metrics.csv")):
        runs.setdefault(path.parents[2].name, []).append(_judged(read_metrics(path)))
    rows = [_row(task, seeds) for task, seeds in runs.items()]
    return markdown(HEADER, [*rows, _row("all", [seed for seeds in runs.values() for seed in seeds])])


def _judged(rows: list[Row]) -> np.ndarray:
    """[2, n] of the iterations that count: whether the return drops, and whether the vote rejects the policy."""
    real, share = column(rows, "return_real"), column(rows, "fraction_improved")
    before, now = real[:-1], real[1:]
    begun = np.fmax.accumulate(before) > np.nanmax(real) / 2
    counts = begun & (before > 0) & np.isfinite(now) & np.isfinite(share[1:])
    return np.array([now < DROP * before, share[1:] < THRESHOLD])[:, counts]


def _row(name: str, seeds: list[np.ndarray]) -> list[str]:
    dropped, rejected = np.concatenate(seeds, axis=1)
    shares = [
        f"{np.sum(rejected & of)} ({np.mean(rejected[of]):.0%})" if of.any() else "-" for of in (dropped, ~dropped)
    ]
    return [name, str(len(seeds)), str(len(dropped)), str(np.sum(dropped)), *shares]


if __name__ == "__main__":
    print(table(), end="")
