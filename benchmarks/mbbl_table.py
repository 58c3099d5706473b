"""MBBL's tasks, published and ours: `python benchmarks/mbbl_table.py` prints the table of docs/environments.md.

Published: Wang et al. 2019, Benchmarking Model-Based Reinforcement Learning (arXiv 1907.02057), returns after 200,000
real steps, mean and standard deviation over its seeds, in `results/published/mbbl_200k.csv`. Ours: the last real return
(deterministic policy) of every run in `results/own/mbbl-*/actor-critic` and `.../long-horizon`; and what doing nothing
earns (`results/yardsticks.json`), which on Ant is more than most methods have.
"""

from __future__ import annotations

import csv

import numpy as np
from summarise import ROOT, no_skill

from metrpo import read_metrics
from metrpo.report.tables import markdown

OURS = ("actor-critic", "long-horizon")
"""Folders, a row each."""


def ours(task: str, folder: str) -> str:
    """Mean and standard deviation over the seeds, and after how many real steps."""
    runs = [read_metrics(path) for path in sorted((ROOT / "own").glob(f"mbbl-{task}/{folder}/seed-*/metrics.csv"))]
    if not runs:
        return "not run"
    last = np.array([run[-1]["return_real"] for run in runs], float)
    steps = sorted({f"{int(run[-1]['real_steps'] or 0) / 1000:.0f}k" for run in runs})
    spread = f"±{last.std():.1f}" if len(runs) > 1 else ""
    return f"**{last.mean():.1f}{spread}** ({len(runs)} x {' and '.join(steps)})"


def table() -> str:
    """The table as Markdown: our rows, what doing nothing earns, then the published ones."""
    with (ROOT / "published" / "mbbl_200k.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    tasks = [name for name in rows[0] if name != "algo"]
    mine = [[f"metrpo, {folder}", *(ours(task, folder) for task in tasks)] for folder in OURS]
    nothing = ["doing nothing", *(no_skill(f"mbbl/{task}")[0] for task in tasks)]
    return markdown(["", *tasks], [*mine, nothing, *([*row.values()] for row in rows)])


if __name__ == "__main__":
    print(table(), end="")
