"""The tasks that are known by name, and how a name becomes a task."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import gymnasium

from metrpo.config import Config
from metrpo.config.env_kwargs import canonical
from metrpo.errors import TaskError
from metrpo.limits import Limits
from metrpo.world.history_env import with_history
from metrpo.world.interface import with_positions
from metrpo.world.resolve import import_module, require_no_kwargs, resolve, task_of, with_kwargs
from metrpo.world.task import Task
from metrpo.world.tasks.gymnasium_formulas import KNOWN

_TASKS: dict[str, Task] = {}


def register(task: Task) -> Task:
    """Registers `task` under its name."""
    _TASKS[task.name] = task
    return task


def tasks() -> dict[str, Task]:
    """All registered tasks by name."""
    return dict(_TASKS)


def get_task(name: str, env_kwargs: Iterable[str] | Mapping[str, Any] = (), imports: Iterable[str] = ()) -> Task:
    """The task of that name: a registered one (in upper or lower case), one with formulas
    (`metrpo.world.tasks.gymnasium_formulas`), or what `metrpo.world.resolve` finds.

    `env_kwargs`, a dict or strings KEY=VALUE, are its environment's keyword arguments; `imports` are modules to import
    first.

    Raises `TaskError` with the nearest names when there is none, and when its environment cannot be used.
    """
    for module in imports:
        import_module(module)
    arguments = canonical(env_kwargs)
    by_lower = {known.lower(): task for known, task in _TASKS.items()}
    if name.lower() in by_lower:
        require_no_kwargs(name, arguments)
        return by_lower[name.lower()]
    task = _with_formulas(name, arguments) if name in KNOWN else resolve(name, env_kwargs=arguments)
    if task is not None:
        return task
    others = [spec.id for spec in gymnasium.registry.values() if not str(spec.entry_point).startswith("gymnasium.")]
    original = {known.lower(): known for known in (*_TASKS, *KNOWN, *others)}
    names = list(original)
    near = [original[n] for n in difflib.get_close_matches(name.lower(), names, n=3, cutoff=0.4)]
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    if name.endswith(".py"):
        hint = f"which task in that file? {name}:NAME; "
    raise TaskError(
        f"unknown task {name!r}: {hint}known tasks: {', '.join(_TASKS)} (see: metrpo tasks), any Gymnasium id "
        "(--import MODULE registers your own), module:name or path/to/file.py:name"
    )


def task_for(config: Config) -> Task:
    """The config's task, without the formulas that are to be learned; looked up once, and then passed on.

    Raises `TaskError` as `get_task`, `ConfigError` for a history that is too long.
    """
    task = get_task(config.task, config.env_kwargs, config.imports)
    task = without_formulas(task) if config.learn_reward else task
    return with_history(limited(task, Limits.of(config)), config.history)


@cache
def limited(task: Task, limits: Limits) -> Task:
    """The task with `limits` on every policy's actions; the same object every time."""
    return task if task.limits == limits else dataclasses.replace(task, limits=limits)


@cache
def without_formulas(task: Task) -> Task:
    """The task with a learned reward and end of episodes; the same object every time."""
    return dataclasses.replace(task, reward=None, terminated="learned")


@cache
def _with_formulas(name: str, env_kwargs: tuple[str, ...]) -> Task:
    known = KNOWN[name]
    task = task_of(
        with_kwargs(known.make, env_kwargs),
        known.reward,
        known.terminated,
        name=name,
        unseen=known.unseen,
        description=known.description,
    )
    interface = task.interface
    if known.added and interface:
        interface = with_positions(interface, name, known.added)
    return dataclasses.replace(task, interface=interface, reward_error=known.reward_error)
