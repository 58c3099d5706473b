"""From what a user types to a task: a Gymnasium id, `module:name`, `path/to/file.py:name`, or a dm_control id."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import gymnasium

from metrpo.errors import TaskError
from metrpo.types import Array
from metrpo.world.guard import Guarded
from metrpo.world.task import Task

_DM_CONTROL_STEPS = 1000
"""Steps of an episode in every task of the control suite (Tassa et al. 2018), which Shimmy does not tell."""
MakeEnv = Callable[..., gymnasium.Env[Any, Any]]
Reward = Callable[[Array, Array, Array], Array]
Terminated = Callable[[Array], Array]


def task_of(
    env: str | MakeEnv,
    reward: Reward | None = None,
    terminated: Terminated | Literal["learned"] | None = "learned",
    *,
    name: str | None = None,
    horizon: int | None = None,
    unseen: tuple[int, ...] = (),
    description: str = "",
) -> Task:
    """A task out of an environment: its Gymnasium id, or a function that makes it (`render_mode=...` may be passed).

    `reward(s, a, s')` [..., S], [..., A], [..., S] -> [...] and `terminated(s')` [..., S] -> [...] are formulas for
    NumPy and JAX arrays, with actions in [-1, 1]; what is not given is learned from the data. With `terminated=None`
    nothing but the clock ends an episode. The horizon is the environment's time limit unless `horizon` is given.

    Raises `TaskError` when the environment cannot be made, breaks its promise in its first step, or has no time limit.
    """
    called = name or (env if isinstance(env, str) else str(getattr(env, "__name__", type(env).__name__)))
    make = partial(_make, env, called, horizon)
    with_limit = make()
    try:
        state, _ = with_limit.reset(seed=0)
        with_limit.step(with_limit.action_space.sample())
        actions, limit = with_limit.action_size, with_limit.time_limit
    finally:
        with_limit.close()
    if limit is None:
        raise TaskError(
            f"{called}: expected an environment with a time limit, got none: register it with max_episode_steps, wrap "
            "it in gymnasium.wrappers.TimeLimit, or give metrpo.task_of(..., horizon=...)"
        )
    return Task(called, called, len(state), actions, limit, reward, terminated, unseen, description, make)


def _make(env: str | MakeEnv, name: str, horizon: int | None, **kwargs: Any) -> Guarded:
    try:
        made = gymnasium.make(env, disable_env_checker=True, **kwargs) if isinstance(env, str) else env(**kwargs)
    except Exception as error:
        raise TaskError(f"{name}: cannot be made ({type(error).__name__}: {error})") from error
    if not isinstance(made, gymnasium.Env):
        raise TaskError(f"{name}: expected a gymnasium.Env, got {type(made).__name__}; return an instance, not a class")
    return Guarded(made, name, horizon)


@cache
def resolve(name: str) -> Task | None:
    """The task that `name` stands for: an id, or `module:name` or `file.py:name` of a task or of an environment.

    None when it is neither; the same object every time. Raises `TaskError` when it is one and cannot be used.
    """
    if name.startswith("dm_control/"):
        _register_dm_control()
        if name in gymnasium.registry:
            return task_of(name, horizon=_DM_CONTROL_STEPS)
    if name in gymnasium.registry:
        return task_of(name)
    module, colon, attribute = name.rpartition(":")
    if not colon:
        return None
    value = getattr(_import(module, name), attribute, None)
    if value is None:
        raise TaskError(f"{name}: {module} has no {attribute!r}; define it there, or name another")
    if isinstance(value, Task):
        return dataclasses.replace(value, name=name)
    if callable(value):
        return task_of(value, name=name)
    raise TaskError(f"{name}: expected a metrpo.Task or a function that makes an environment, got {value!r}")


def _import(module: str, name: str) -> Any:
    try:
        if not module.endswith(".py"):
            return importlib.import_module(module)
        path = Path(module).resolve()
        spec = importlib.util.spec_from_file_location(f"metrpo_task_{path.stem}", path)
        if spec is None or spec.loader is None or not path.exists():
            raise TaskError(f"{name}: expected a Python file at {path}, found none")
        loaded = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = loaded
        spec.loader.exec_module(loaded)
        return loaded
    except TaskError:
        raise
    except Exception as error:
        raise TaskError(f"{name}: cannot import {module} ({type(error).__name__}: {error})") from error


def _register_dm_control() -> None:
    try:
        shimmy = importlib.import_module("shimmy")
    except ImportError as error:
        raise TaskError("dm_control tasks need Shimmy: pip install 'metrpo[dm-control]'") from error
    gymnasium.register_envs(shimmy)
