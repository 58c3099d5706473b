"""The table of the README: returns beside what no skill earns and, where it was tried, what open-loop search finds.

`python benchmarks/fill_tables.py` puts it into the README, from results/fast, results/laptop or results/own,
results/yardsticks.json (`yardsticks.py`) and results/ceilings (`ceiling.py`).
"""

from __future__ import annotations

import json

import numpy as np
from summarise import ROOT, no_skill, real_steps

from metrpo import read_metrics
from metrpo.presets import usual_system
from metrpo.report.tables import markdown
from metrpo.run.files import folder_name

FOLDERS = ("fast", "laptop", "own")
"""Of results/: a task's row is of the first one that has runs of it, those of the preset as it is, or as it was; tasks
outside the paper have the last one."""
TASKS = (
    *("Swimmer", "Snake", "HalfCheetah", "Hopper", "HopperUpright", "Ant", "Humanoid", "HumanoidStandup"),
    *("mbbl/Swimmer", "mbbl/HalfCheetah", "mbbl/Hopper", "mbbl/Ant"),
    *("HalfCheetah-v5", "Hopper-v5", "Ant-v5"),
)
HEADER = (
    "task",
    "system",
    "real steps",
    "seeds",
    "return",
    "worst seed",
    "doing nothing",
    "random actions",
    "search",
    "runs",
)


def table() -> str:
    """As Markdown, a row for each task that has runs."""
    return markdown(HEADER, [row for task in TASKS if (row := _row(task))])


def _row(task: str) -> tuple[str, ...] | None:
    # The preset as it is has the task's usual system; as it was, all were learned by me-trpo.
    systems = dict.fromkeys(FOLDERS, usual_system(task, "fast", {})) | {"laptop": "me-trpo"}
    folders = {name: ROOT / name / folder_name(task) for name in FOLDERS}
    found = {name: sorted((folders[name] / systems[name]).glob("seed-*/metrics.csv")) for name in FOLDERS}
    folder = next((name for name in FOLDERS if found[name]), None)
    if folder is None:
        return None
    last = [read_metrics(path)[-1] for path in found[folder]]
    returns = [float(row["return_real"] or np.nan) for row in last]
    file = ROOT / "ceilings" / f"{task}.json"
    ceiling = f"{json.loads(file.read_text())['best']['mean']:.1f}" if file.exists() else "not searched"
    return (
        task,
        systems[folder],
        real_steps(last),
        str(len(last)),
        f"{np.mean(returns):.1f}",
        f"{np.min(returns):.1f}",
        *no_skill(task),
        ceiling,
        f"[{folder}](results/{folder}/{folder_name(task)})",
    )
