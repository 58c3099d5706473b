"""A finished policy in the real environment: its return, and its video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from metrpo.counting import counted
from metrpo.errors import ConfigError, TaskError
from metrpo.hub import is_on_hub
from metrpo.limits import Limits
from metrpo.policy_zoo import is_in_zoo, is_name, located
from metrpo.run.loaded_policy import LoadedPolicy, PolicyInfo
from metrpo.run.policy_file import load_policy
from metrpo.run.task_file import task_of_run
from metrpo.run.video import record
from metrpo.safe_load import brief
from metrpo.world import batch_episodes, collection
from metrpo.world.history_env import with_history
from metrpo.world.registry import get_task, limited
from metrpo.world.task import Task


@dataclass(frozen=True)
class EvaluationResult:
    """Real returns of a deterministic policy."""

    task: str
    seed: int
    returns: np.ndarray
    """[episodes]"""

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation over the episodes."""
        return float(np.std(self.returns))

    def summary(self) -> dict[str, Any]:
        """The result as plain numbers, for JSON."""
        return {
            "task": self.task,
            "episodes": len(self.returns),
            "seed": self.seed,
            "mean": self.mean,
            "std": self.std,
            "min": float(np.min(self.returns)),
            "max": float(np.max(self.returns)),
            "returns": self.returns.tolist(),
        }


def evaluate(
    policy: str | Path | LoadedPolicy | Callable[[np.ndarray], np.ndarray],
    task: str | None = None,
    episodes: int = 20,
    seed: int = 0,
) -> EvaluationResult:
    """Plays whole real episodes with a policy: a run directory, what `load_policy` returns, or any function [S] -> [A].

    `task` is needed for a plain function, and where the file of a run's task has moved; it may also name another task
    of the same sizes. The same seed gives the same start states.

    Raises `RunDirectoryError` when the directory holds no sound policy, `TaskError` for an unknown task, `ConfigError`
    for fewer than one episode or a function without a task; `TaskError` also for a policy of another task's sizes.
    """
    if episodes < 1:
        raise ConfigError(f"episodes: expected at least 1, got {episodes}")
    _require_seed(seed)
    act = _loaded(policy) if isinstance(policy, str | Path) else policy
    if task is not None or not isinstance(act, LoadedPolicy):
        if task is None:
            raise ConfigError("task: expected a task to evaluate this function on, got none")
        known = _task_at(task, act.info if isinstance(act, LoadedPolicy) else None)
    else:
        made = act.info
        of_run = _task_of(policy, made) if isinstance(policy, str | Path) else None
        known = of_run or get_task(made.task, made.env_kwargs, made.imports)
    if isinstance(act, LoadedPolicy):
        _require_fit(act, known)
        known = with_history(limited(known, Limits.of(act.info)), act.info.history)
        return EvaluationResult(known.name, seed, batch_episodes.evaluate(known, act.of_state, episodes, seed))
    return EvaluationResult(known.name, seed, collection.evaluate(known, act, episodes, seed))


def render(run_dir: str | Path, out: str | Path | None = None, seed: int = 0, task: str | None = None) -> Path:
    """Records one real episode of a run's policy, by default to `video.mp4` in the run directory (of
    `zoo:NAME` or `hub:OWNER/NAME`, to `NAME.mp4` here); returns the file.

    `task` says where the run's task is, if its file has moved.

    Raises `RunDirectoryError` when the directory holds no sound policy, `VideoError` when this machine cannot render,
    encode or write it, `ConfigError` for a seed below 0.
    """
    _require_seed(seed)
    policy = _loaded(run_dir)
    known = _task_of(run_dir, policy.info) if task is None else _task_at(task, policy.info)
    _require_fit(policy, known)
    policy.reset()
    name = located(run_dir).name if is_in_zoo(run_dir) else Path(run_dir).name
    beside = Path(f"{name}.mp4") if is_name(run_dir) else Path(run_dir) / "video.mp4"
    return record(known.make_env, policy, Path(out or beside), seed)


def _loaded(place: str | Path) -> LoadedPolicy:
    """The policy of a place; one from the hub without its author's imports, which nobody here asked for."""
    policy = load_policy(place)
    return replace(policy, info=replace(policy.info, imports=())) if is_on_hub(place) else policy


def _task_of(place: str | Path, made: PolicyInfo) -> Task:
    """The task of a place's policy. Raises `TaskError` where a policy from the hub would run code by name."""
    if is_on_hub(place) and ":" in made.task:
        raise TaskError(
            f"{place}: its author's task is {brief(made.task)}, and a downloaded name runs no code here; name the task "
            "yourself: --task path/to/file.py:name or module:name"
        )
    return task_of_run(located(place), made)


def _task_at(task: str, made: PolicyInfo | None) -> Task:
    """The task of that name, with the policy's arguments where it may be the policy's own task, moved.

    Its imports are for the task's old name: a new one brings its own module.
    """
    if made is None or (":" not in task and task != made.task):
        return get_task(task)
    return get_task(task, made.env_kwargs, made.imports if task == made.task else ())


def _require_seed(seed: int) -> None:
    if seed < 0:
        raise ConfigError(f"seed: expected at least 0, got {seed}")


def _require_fit(policy: LoadedPolicy, task: Task) -> None:
    has = (policy.info.observation_size, policy.info.action_size)
    if has != (task.state_size, task.action_size):
        raise TaskError(
            f"{task.name}: expected a policy of {counted(task.state_size, 'observed number')} and "
            f"{counted(task.action_size, 'action')}, got one of {has[0]} and {has[1]}, trained on "
            f"{brief(policy.info.task)}; name that task, or train a policy for this one"
        )
