"""Published returns of long episodes, and ours: `python benchmarks/long_table.py` prints the table of the actor-critic.

Ours: the last real return up to 50,000 and up to 100,000 real steps, of every run in `results/own/TASK/actor-critic`
and, where there is one, `.../learned-reward`; SAC as Stable-Baselines3 has it, on the same machine, in
`results/sac/TASK` (`soft_actor_critic.py`). Published: `results/published/gymnasium.csv`, on version 4 of the tasks,
from the result files of 4kubo/erl_lib, dojeon-ai/SimbaV2 and facebookresearch/MRQ on GitHub.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from summarise import ROOT, no_skill

from metrpo import read_metrics
from metrpo.report.tables import markdown

TASKS = ("HalfCheetah-v5", "Hopper-v5", "Ant-v5")
STEPS = (50_000, 100_000)
OURS = {
    "metrpo, actor-critic": "own/{}/actor-critic",
    "metrpo, actor-critic, reward learned": "own/{}/learned-reward",
    "SAC, Stable-Baselines3": "sac/{}",
}
"""Rows, and the folder of results/ that holds a task's seeds."""


def table() -> str:
    """The table as Markdown: our rows, what no skill earns, then the published ones."""
    columns = [(task, steps) for task in TASKS for steps in STEPS]
    head = ["", *(f"{task.removesuffix('-v5')}, {steps:,}" for task, steps in columns)]
    mine = [[name, *(_ours(folder, *column) for column in columns)] for name, folder in OURS.items()]
    mine = [row for row in mine if any(cell != "-" for cell in row[1:])]
    still = [[way, *(no_skill(task)[i] for task, _ in columns)] for i, way in enumerate(("doing nothing", "random"))]
    with (ROOT / "published" / "gymnasium.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    methods = dict.fromkeys(row["method"] for row in rows)
    published = [[f"{name} (v4)", *(_published(rows, name, *column) for column in columns)] for name in methods]
    return markdown(head, [*mine, *still, *published])


def _ours(folder: str, task: str, steps: int) -> str:
    """Mean, standard deviation and worst of the seeds that came so far."""
    last = [_return_at(path, steps) for path in sorted((ROOT / folder.format(task)).glob("seed-*/metrics.csv"))]
    found = [value for value in last if value is not None]
    if not found:
        return "-"
    spread = f"±{np.std(found):,.0f} (worst {min(found):,.0f}, {len(found)} seeds)" if len(found) > 1 else " (1 seed)"
    return f"**{np.mean(found):,.0f}**{spread}"


def _return_at(metrics: Path, steps: int) -> float | None:
    """The last return up to so many real steps; None where the run ended more than 2,000 before: two episodes."""
    last = [row for row in read_metrics(metrics) if (row["real_steps"] or 0) <= steps][-1]
    return last["return_real"] if (last["real_steps"] or 0) > steps - 2_000 else None


def _published(rows: list[dict[str, str]], method: str, task: str, steps: int) -> str:
    version_4 = task.replace("-v5", "-v4")
    found = [row for row in rows if (row["method"], row["task"]) == (method, version_4)]
    return f"{float(found[0][str(steps)]):,.0f}" if found and found[0][str(steps)] else "-"


if __name__ == "__main__":
    print(table(), end="")
