"""Chooses the policies of `metrpo zoo` among committed runs: `python benchmarks/tools/fill_zoo.py [FOLDER...]`.

For each task that can be played by its name, the policy with the best real return in its run's last evaluation, of all
model-based runs under the folders (default: results/); not one that earns no more than doing nothing or random actions.
Writes policies in today's format, and a card each, to `src/metrpo/zoo_policies/`: all anew by default, else those of
the folders' tasks. Run it again when runs are added.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from metrpo import load_policy
from metrpo import policy_zoo as zoo
from metrpo.errors import MetrpoError, TaskError
from metrpo.policy.gaussian import Policy
from metrpo.run.card import card_of
from metrpo.run.files import folder_name, read_arrays
from metrpo.run.find import SeenRun, find
from metrpo.run.policy_file import FILE, Learned, save_policy
from metrpo.world.registry import task_for

RESULTS = Path(__file__).resolve().parents[2] / "results"


def candidates(folders: list[Path]) -> dict[str, list[SeenRun]]:
    """By task, the runs that left a policy with a real return."""
    found: dict[str, list[SeenRun]] = defaultdict(list)
    for run in find(folders).runs:
        config = run.config
        plain = config.method == "model-based" and config.data is None and not config.env_kwargs
        if plain and ":" not in config.task and (run.path / FILE).is_file() and _return(run) is not None:
            found[config.task].append(run)
    return dict(sorted(found.items()))


def no_skill(run: SeenRun, measured: dict[str, Any]) -> float | None:
    """The most that doing nothing or random actions earn on its task; None: not measured."""
    known = [one["mean"] for one in measured.get(run.config.task, {}).values()] + list(run.yardsticks.values())
    return max(known, default=None)


def add(runs: list[SeenRun], floor: float | None, folder: Path) -> None:
    """Writes the best policy of a task's runs, and its card."""
    best = max(runs, key=lambda run: _return(run) or -np.inf)
    info, (arrays, _) = load_policy(best.path).info, read_arrays(best.path / FILE)
    layers = tuple((arrays[f"w{i}"], arrays[f"b{i}"]) for i in range(len(info.hidden) + 1))
    policy, task = Policy(layers, arrays["log_std"]), task_for(best.config)
    folder.mkdir(parents=True)
    learned = Learned(info.iteration, info.real_steps, info.return_real)
    origin = arrays.get("origin")
    save_policy(folder, policy, info.task, learned, task.interface, origin, best.config)  # type: ignore[arg-type]
    chosen = {"chosen_of": len(runs), "mean_of_runs": float(np.mean([_return(run) for run in runs]))}
    card = {**card_of(best), "no_skill": floor, **chosen, "run": _name_of(best.path)}
    (folder / zoo.CARD).write_text(json.dumps(card, indent=1) + "\n", "utf-8")


def fill(folders: list[Path], out: Path, measured: dict[str, Any]) -> list[str]:
    """Writes the policies of the folders' tasks anew to `out`; returns a line for each task."""
    lines = []
    for task, runs in candidates(folders).items():
        shutil.rmtree(out / folder_name(task), ignore_errors=True)
        best, floor = max(_return(run) or -np.inf for run in runs), no_skill(runs[0], measured)
        if floor is not None and best <= floor:
            lines.append(f"left out {task}: {best:.1f}, and no skill earns {floor:.1f}")
            continue
        try:
            add(runs, floor, out / folder_name(task))
        except TaskError as error:
            lines.append(f"left out {task}: {error}")
            continue
        lines.append(f"zoo:{folder_name(task)}: {best:.1f}, the best of {len(runs)} runs")
    return lines


def _name_of(path: Path) -> str:
    """Where a run lies in the repository; elsewhere its folder's name."""
    whole, root = path.resolve(), RESULTS.parent
    return str(whole.relative_to(root)) if whole.is_relative_to(root) else path.name


def _return(run: SeenRun) -> float | None:
    try:
        found = load_policy(run.path).info.return_real
    except MetrpoError:
        return None
    return found if isinstance(found, float) and np.isfinite(found) else None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*")
    given = parser.parse_args()
    if not given.folders:
        shutil.rmtree(zoo.FOLDER, ignore_errors=True)
    yardsticks = json.loads((RESULTS / "yardsticks.json").read_text())
    print("\n".join(fill(given.folders or [RESULTS], zoo.FOLDER, yardsticks)))
