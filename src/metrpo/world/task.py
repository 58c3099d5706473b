"""A task: an environment, its reward and termination as formulas, and its horizon; and the registry of tasks."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium

from metrpo.errors import TaskError
from metrpo.types import Array


@dataclass(frozen=True)
class Task:
    """What the learner may know of the real system: everything but its dynamics."""

    name: str
    """As typed on the command line, "Swimmer"."""
    env_id: str
    """Gymnasium id, "metrpo/Swimmer-v0"."""
    state_size: int
    """S"""
    action_size: int
    """A; actions lie in [-1, 1]."""
    horizon: int
    """T, steps per episode."""
    reward: Callable[[Array, Array, Array], Array]
    """r(s, a, s'): [..., S], [..., A], [..., S] -> [...]; `a` within [-1, 1]; NumPy or JAX arrays alike."""
    terminated: Callable[[Array], Array] | None = None
    """Ends the episode in s': [..., S] -> [...] of bool; None: never."""
    unseen: tuple[int, ...] = ()
    """State dimensions kept from the dynamics networks' input (global position), but predicted all the same."""
    description: str = ""
    """One line for `metrpo tasks`."""

    def make_env(self, **kwargs: Any) -> gymnasium.Env:
        """A fresh environment with the time limit of the task (`kwargs` such as `render_mode="rgb_array"`)."""
        return gymnasium.make(self.env_id, **kwargs)


_TASKS: dict[str, Task] = {}


def register(task: Task) -> Task:
    """Makes `task` known by its name."""
    _TASKS[task.name] = task
    return task


def tasks() -> dict[str, Task]:
    """All registered tasks by name."""
    return dict(_TASKS)


def get_task(name: str) -> Task:
    """The task of that name (case does not matter).

    Raises `TaskError` with the nearest names when there is none.
    """
    by_lower = {known.lower(): task for known, task in _TASKS.items()}
    if name.lower() in by_lower:
        return by_lower[name.lower()]
    near = [by_lower[n].name for n in difflib.get_close_matches(name.lower(), by_lower, n=3, cutoff=0.4)]
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    raise TaskError(f"unknown task {name!r}: {hint}known tasks: {', '.join(_TASKS)} (see: metrpo tasks)")
