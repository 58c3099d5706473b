"""What a vote of the models would have been worth: `python benchmarks/falls.py` prints the table of the trials' page.

A fall is an iteration of the actor-critic whose real return is less than three quarters of the one before, counted from
the first return above half of the run's best. A vote (`validate.rule` ensemble, `validate.threshold` 0.7) keeps the
policy before where fewer models see the new one improve (`fraction_improved`). Of every run in
`results/own/TASK/actor-critic`, in the iterations that were counted: how many falls the vote would have kept away, and
how many of the policies that did not fall.
"""

from __future__ import annotations

import numpy as np
from summarise import ROOT

from metrpo import read_metrics
from metrpo.report.tables import markdown
from metrpo.run.metrics import column

FALL, THRESHOLD = 0.75, 0.7
HEADER = ["task", "seeds", "iterations", "falls", "falls rejected", "others rejected"]


def table() -> str:
    """The table as Markdown, a row for each task and one for all."""
    runs: dict[str, list[np.ndarray]] = {}
    for path in sorted((ROOT / "own").glob("*/actor-critic/seed-*/metrics.csv")):
        runs.setdefault(path.parents[2].name, []).append(_judged(read_metrics(path)))
    rows = [_row(task, seeds) for task, seeds in runs.items()]
    return markdown(HEADER, [*rows, _row("all", [seed for seeds in runs.values() for seed in seeds])])


def _judged(rows: list[dict[str, int | float | None]]) -> np.ndarray:
    """[2, n] of the iterations that count: whether each is a fall, and whether the vote rejects it."""
    real, share = column(rows, "return_real"), column(rows, "fraction_improved")
    begun = np.maximum.accumulate(real)[:-1] > np.max(real) / 2
    return np.array([real[1:] < FALL * real[:-1], share[1:] < THRESHOLD])[:, begun]


def _row(name: str, seeds: list[np.ndarray]) -> list[str]:
    fell, rejected = np.concatenate(seeds, axis=1)
    shares = [f"{np.sum(rejected & of)} ({np.mean(rejected[of]):.0%})" if of.any() else "-" for of in (fell, ~fell)]
    return [name, str(len(seeds)), str(len(fell)), str(np.sum(fell)), *shares]


if __name__ == "__main__":
    print(table(), end="")
