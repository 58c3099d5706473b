"""Finds the task that a user names: a Gymnasium id, `module:name`, `path/to/file.py:name`, or a dm_control id."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np

from metrpo.config.env_kwargs import keywords
from metrpo.errors import MissingTaskError, TaskError
from metrpo.types import EndFormula, RewardFormula
from metrpo.world import env_returns, interface
from metrpo.world.env_wrapper import Guarded
from metrpo.world.opengl import gl_for_others
from metrpo.world.size_limits import require_horizon
from metrpo.world.task import Task

_DM_CONTROL_STEPS = 1000
"""Steps of an episode in every task of the control suite (Tassa et al. 2018), which Shimmy does not tell."""
MakeEnv = Callable[..., gymnasium.Env[Any, Any]]


def task_of(
    env: str | MakeEnv,
    reward: RewardFormula | None = None,
    terminated: EndFormula | Literal["learned"] | None = "learned",
    *,
    name: str | None = None,
    horizon: int | None = None,
    unseen: tuple[int, ...] = (),
    description: str = "",
) -> Task:
    """A task from an environment: its Gymnasium id, or a function that creates it (and takes `render_mode=...`).

    `reward(s, a, s')` [..., S], [..., A], [..., S] -> [...] and `terminated(s')` [..., S] -> [...] are formulas for
    NumPy and JAX arrays, with actions in [-1, 1]; a formula that is missing is learned from the data. With
    `terminated=None`, only the time limit ends an episode: `horizon`, or else the environment's.

    Raises `TaskError` when the environment cannot be created, fails in its first step, or has no time limit.
    """
    called = name or (env if isinstance(env, str) else str(getattr(env, "__name__", type(env).__name__)))
    make = partial(_make, env, called, horizon)
    with env_returns.closing(make(), called) as with_limit:
        if with_limit.time_limit is not None:
            require_horizon(called, with_limit.time_limit)
        state, _ = with_limit.reset(seed=0)
        with_limit.step(np.zeros(with_limit.action_size, np.float32))  # within any limits on actions
        actions, limit = with_limit.action_size, with_limit.time_limit
        shows = interface.of_env(with_limit._env, called)
    if limit is None:
        raise TaskError(
            f"{called}: expected an environment with a time limit, got none; register it with max_episode_steps, wrap "
            "it in gymnasium.wrappers.TimeLimit, or call metrpo.task_of(..., horizon=...)"
        )
    return Task(called, called, len(state), actions, limit, reward, terminated, unseen, description, make, shows)


def _make(env: str | MakeEnv, name: str, horizon: int | None, **kwargs: Any) -> Guarded:
    try:
        made = gymnasium.make(env, disable_env_checker=True, **kwargs) if isinstance(env, str) else env(**kwargs)
    except Exception as error:
        raise TaskError(f"{name}: cannot create the environment ({type(error).__name__}: {error})") from error
    if made is None:
        raise TaskError(f"{name}: expected a gymnasium.Env, got None: does the function lack a return?")
    if not isinstance(made, gymnasium.Env):
        raise TaskError(f"{name}: expected a gymnasium.Env, got {type(made).__name__}; return an instance, not a class")
    return Guarded(made, name, horizon)


_PLACES: dict[tuple[str, tuple[str, ...]], Task] = {}
"""The tasks that names stand for in this process (`place`), by name and keyword arguments."""


def place(name: str, task: Task, env_kwargs: tuple[str, ...] = ()) -> Task:
    """Lets `name`, with these keyword arguments, stand for `task` from now on; returns the task under that name."""
    _PLACES[name, env_kwargs] = dataclasses.replace(task, name=name)
    return _PLACES[name, env_kwargs]


def is_placed(name: str, env_kwargs: tuple[str, ...] = ()) -> bool:
    """Whether `place` has been told what that name stands for."""
    return (name, env_kwargs) in _PLACES


def file_of(name: str) -> Path | None:
    """The file, absolute, of the task file.py:name; None for any other name."""
    module, colon, _ = name.rpartition(":")
    return Path(module).resolve() if colon and module.endswith(".py") else None


def module_of(name: str) -> str | None:
    """The module of the task module:name; None for any other name."""
    module, colon, _ = name.rpartition(":")
    return module if colon and not module.endswith(".py") and "/" not in module else None


def folder_of(name: str) -> Path | None:
    """The folder, absolute, in which Python has found the module of the task module:name.

    None for any other name, and for what is installed, which every folder finds.
    """
    module = module_of(name)
    return None if module is None else folder_of_module(module)


def folder_of_module(module: str) -> Path | None:
    """The folder, absolute, in which Python has found an imported module; None for what is installed."""
    file = getattr(sys.modules.get(module), "__file__", None)
    if not isinstance(file, str):
        return None
    found = Path(file).resolve().parents[module.count(".") + (Path(file).stem == "__init__")]
    return None if {"site-packages", "dist-packages"} & set(found.parts) else found


def is_in(folder: Path, name: str) -> bool:
    """Whether the module of the task module:name lies in `folder`."""
    module = module_of(name)
    return module is not None and holds_module(folder, module)


def holds_module(folder: Path, module: str) -> bool:
    """Whether a module of that name lies in `folder`."""
    path = folder.joinpath(*module.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def import_module(module: str, folder: Path | None = None) -> None:
    """Imports a module that registers environments; `folder` (default: the current one) is searched first.

    Raises `TaskError` when that fails, `MissingTaskError` when there is no such module.
    """
    _import(module, f"imports {module}", folder)


def resolve(name: str, folder: Path | None = None, env_kwargs: tuple[str, ...] = ()) -> Task | None:
    """The task that `name` stands for: an id, or `module:name` or `file.py:name` of a task, of what makes an
    environment, or of an id that the module registers.

    `folder` (default: the current one) is searched for modules first. Its environment is made with `env_kwargs`
    (`config.env_kwargs`). None when it is neither; the same object every time. Raises `TaskError` when it is one and
    cannot be used, `MissingTaskError` when there is no such file or module.
    """
    if is_placed(name, env_kwargs):
        return _PLACES[name, env_kwargs]
    if module_of(name) is not None:
        return resolved(name, name, folder or Path.cwd(), env_kwargs)
    file = file_of(name)
    return resolved(name, name if file is None else f"{file}:{name.rpartition(':')[2]}", None, env_kwargs)


@cache
def resolved(name: str, where: str, folder: Path | None, env_kwargs: tuple[str, ...]) -> Task | None:
    """The task of that name, which is found at `where`; None where nobody knows it."""
    if where.startswith("dm_control/"):
        _register_dm_control()
        if where in gymnasium.registry:
            return task_of(with_kwargs(where, env_kwargs), name=name, horizon=_DM_CONTROL_STEPS)
    if where in gymnasium.registry:
        return task_of(with_kwargs(where, env_kwargs), name=name)
    module, colon, attribute = where.rpartition(":")
    if not colon:
        return None
    value = getattr(_import(module, name, folder), attribute, None)
    if value is None and attribute in gymnasium.registry:
        return task_of(with_kwargs(attribute, env_kwargs), name=name)
    if value is None:
        raise TaskError(
            f"{name}: {module} neither defines nor registers {attribute!r}; define it there, or name another"
        )
    if isinstance(value, Task):
        require_no_kwargs(name, env_kwargs)
        return dataclasses.replace(value, name=name)
    if callable(value):
        return task_of(with_kwargs(value, env_kwargs), name=name)
    raise TaskError(f"{name}: expected a metrpo.Task or a function that creates an environment, got {value!r}")


def with_kwargs(env: str | MakeEnv, env_kwargs: tuple[str, ...]) -> str | MakeEnv:
    """An id, or a function that makes an environment, with keyword arguments; those of a call win."""
    kwargs = keywords(env_kwargs)
    if not kwargs:
        return env
    return (
        partial(gymnasium.make, env, **{"disable_env_checker": True, **kwargs})
        if isinstance(env, str)
        else partial(env, **kwargs)
    )


def require_no_kwargs(name: str, env_kwargs: tuple[str, ...]) -> None:
    """Raises `TaskError` where keyword arguments are given to what is made already."""
    if env_kwargs:
        raise TaskError(
            f"{name}: expected no env_kwargs, got {', '.join(env_kwargs)}: its environment exists already; "
            "leave them out, or name a function that takes them and creates an environment"
        )


def _import(module: str, name: str, folder: Path | None) -> Any:
    path = Path(module) if module.endswith(".py") else None
    if path is not None and not path.is_file():
        raise MissingTaskError(f"{name}: expected a Python file at {path}, found none")
    try:
        with _on_path(path.parent if path is not None else folder or Path.cwd()):
            return importlib.import_module(module) if path is None else _load(path)
    except TaskError:
        raise
    except ModuleNotFoundError as error:
        if path is not None or not f"{module}.".startswith(f"{error.name}."):  # what it imports is missing
            raise TaskError(f"{name}: cannot import {module} ({type(error).__name__}: {error})") from error
        raise MissingTaskError(
            f"{name}: expected a module {module} in {folder or Path.cwd()} or on Python's path, found none; go to the "
            "folder that holds it, or add that folder to PYTHONPATH"
        ) from error
    except Exception as error:
        raise TaskError(f"{name}: cannot import {module} ({type(error).__name__}: {error})") from error


def _load(path: Path) -> Any:
    # Files of one name may lie in several folders.
    own = f"metrpo_task_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(own, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[own] = loaded
    spec.loader.exec_module(loaded)
    return loaded


@contextmanager
def _on_path(folder: Path) -> Iterator[None]:
    """Finds modules in `folder` first, as Python does for a script; after the block last, for imports in functions."""
    if str(folder) in sys.path:
        yield
        return
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        sys.path.append(str(folder))


def _register_dm_control() -> None:
    try:
        with gl_for_others():
            shimmy = importlib.import_module("shimmy")
    except ModuleNotFoundError as error:
        raise TaskError("dm_control tasks need Shimmy: pip install 'metrpo[dm-control]'") from error
    except Exception as error:  # dm_control loads OpenGL as it is imported
        raise TaskError(f"dm_control cannot be imported: {type(error).__name__}: {error}") from error
    gymnasium.register_envs(shimmy)
