"""Results as a table, from the committed metrics: `python benchmarks/summarise.py [results/laptop/*/me-trpo ...]`.

One row for each task and system under the given folders: over seeds, the last and the best real return (deterministic
policy, mean of 20 episodes), the last one of the worst seed, what doing nothing and random actions earn
(`yardsticks.py`), the real steps they took, and the minutes of wall-clock time.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from metrpo import read_metrics
from metrpo.report.tables import markdown
from metrpo.run.metrics import Row

ROOT = Path(__file__).resolve().parents[1] / "results"
HEADER = (
    *("experiment", "task", "system", "seeds", "real steps", "last return", "worst seed", "doing nothing"),
    *("random actions", "best return", "last gap", "minutes"),
)


def systems(folders: list[Path]) -> list[Path]:
    """Every <experiment>/<task>/<system> folder that holds seeds."""
    found = {run.parent.parent for folder in folders for run in folder.rglob("seed-*/metrics.csv")}
    return sorted(found)


def row(system: Path) -> tuple[str, ...]:
    """The table row of one system."""
    runs = [read_metrics(path) for path in sorted(system.glob("seed-*/metrics.csv"))]

    def over_seeds(values: list[float], digits: int = 1) -> str:
        if np.isnan(values).all():
            return "-"  # a method without models has no gap, another program's run no return: see examples/robot
        spread = f" ({', '.join(f'{v:.{digits}f}' for v in values)})" if len(values) > 1 else ""
        return f"{np.mean(values):.{digits}f}{spread}"

    last = [_value(run[-1], "return_real") for run in runs]
    return (
        system.parent.parent.name,
        system.parent.name,
        system.name,
        str(len(runs)),
        real_steps([run[-1] for run in runs]),
        over_seeds(last),
        over_seeds([float(np.min(last))]),
        *no_skill(json.loads(next(system.glob("seed-*/config.json")).read_text())["task"]),
        over_seeds([float(np.fmax.reduce([_value(r, "return_real") for r in run])) for run in runs]),
        over_seeds([_value(run[-1], "gap") for run in runs]),
        over_seeds([_value(run[-1], "wall_seconds") / 60 for run in runs]),
    )


def real_steps(last: list[Row]) -> str:
    """The real steps of runs with these last rows: one number, or the fewest and the most."""
    few, most = (int(pick(row["real_steps"] or 0 for row in last)) for pick in (min, max))
    return f"{few:,}" if few == most else f"{few:,} to {most:,}"


def no_skill(task: str) -> tuple[str, str]:
    """What doing nothing and random actions earn, as cells; "-": not measured."""
    known = json.loads((ROOT / "yardsticks.json").read_text()).get(task, {})
    zero, drawn = (f"{known[way]['mean']:.1f}" if way in known else "-" for way in ("zero", "random"))
    return zero, drawn


def _value(row: Mapping[str, float | None], column: str) -> float:
    """A number of a row; NaN where it has none: a deterministic run keeps no clock."""
    value = row.get(column)
    return float("nan") if value is None else value


def table(folders: list[Path]) -> str:
    """The whole table as Markdown."""
    return markdown(HEADER, [row(system) for system in systems(folders)])


if __name__ == "__main__":
    print(table([Path(argument) for argument in sys.argv[1:]] or [ROOT]), end="")
