"""Model-Ensemble Trust-Region Policy Optimization (Kurutach et al., 2018): control learned from few real steps.

    real environment --collect--> dataset --fit--> ensemble --imagine--> trajectories
            ^                                         |                      |
            +------------- accepted policy <--validate+------ improve <------+

Train with `train(preset("Swimmer"), "runs/swimmer")`, use the result with `load_policy("runs/swimmer")`, judge it with
`evaluate("runs/swimmer")`; `init` and `step` are the loop's two halves, for callers who drive it themselves.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from metrpo.config import Config
from metrpo.environment_ids import register_ids_with_gymnasium
from metrpo.errors import ConfigError, MetrpoError, RunDirectoryError, TaskError

if TYPE_CHECKING:
    from metrpo.algorithm import State
    from metrpo.callbacks import Callback
    from metrpo.console.progress import SILENT
    from metrpo.evaluation import EvaluationResult, evaluate, render
    from metrpo.presets import override, preset
    from metrpo.run.episodes import append_episode
    from metrpo.run.loaded_policy import LoadedPolicy
    from metrpo.run.metrics import read_metrics
    from metrpo.run.policy_file import load_policy
    from metrpo.training import init, step, train
    from metrpo.world.interface import Interface
    from metrpo.world.registry import get_task, tasks
    from metrpo.world.resolve import task_of
    from metrpo.world.task import Task

__all__ = [
    "SILENT",
    "Callback",
    "Config",
    "ConfigError",
    "EvaluationResult",
    "Interface",
    "LoadedPolicy",
    "MetrpoError",
    "RunDirectoryError",
    "State",
    "Task",
    "TaskError",
    "append_episode",
    "evaluate",
    "get_task",
    "init",
    "load_policy",
    "override",
    "preset",
    "read_metrics",
    "render",
    "step",
    "task_of",
    "tasks",
    "train",
]

# Imported at first use: a policy can be loaded without JAX, and `import metrpo` costs next to nothing.
_HOME = {
    "metrpo.algorithm": ("State",),
    "metrpo.callbacks": ("Callback",),
    "metrpo.console.progress": ("SILENT",),
    "metrpo.evaluation": ("EvaluationResult", "evaluate", "render"),
    "metrpo.presets": ("override", "preset"),
    "metrpo.run.episodes": ("append_episode",),
    "metrpo.run.loaded_policy": ("LoadedPolicy",),
    "metrpo.run.metrics": ("read_metrics",),
    "metrpo.run.policy_file": ("load_policy",),
    "metrpo.training": ("init", "step", "train"),
    "metrpo.world.interface": ("Interface",),
    "metrpo.world.resolve": ("task_of",),
    "metrpo.world.registry": ("get_task", "tasks"),
    "metrpo.world.task": ("Task",),
}

register_ids_with_gymnasium()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("metrpo.run.files").metrpo_version()
    for module, names in _HOME.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
