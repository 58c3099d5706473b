"""Where a run's task lies: a name such as file.py:name or module:name is valid from one directory only."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from metrpo.errors import ConfigError, MissingTaskError
from metrpo.run.about import about, note
from metrpo.world import resolve
from metrpo.world.registry import get_task
from metrpo.world.task import Task

_FILE, _FOLDER, _IMPORTS = "task_file", "task_folder", "import_folders"


class Choice(Protocol):
    """Says which task a run has: its settings, or its policy's file."""

    @property
    def task(self) -> str:
        """Its name."""

    @property
    def env_kwargs(self) -> tuple[str, ...]:
        """Keyword arguments of its environment."""

    @property
    def imports(self) -> tuple[str, ...]:
        """Modules that are imported first."""


def remember(run_dir: str | Path, choice: Choice) -> None:
    """Notes in `run.json` where the task's file or its module's folder lies now, and the folders of its imports."""
    places = {_FILE: resolve.file_of(choice.task), _FOLDER: resolve.folder_of(choice.task)}
    noted: dict[str, Any] = {field: str(place) for field, place in places.items() if place is not None}
    folders = {module: folder for module in choice.imports if (folder := resolve.folder_of_module(module))}
    note(run_dir, noted | ({_IMPORTS: {module: str(folder) for module, folder in folders.items()}} if folders else {}))


def task_of_run(run_dir: str | Path, choice: Choice) -> Task:
    """The run's task: from where its file or module was, if it is still there, else by its name.

    From then on the name means that task in this process. Raises `TaskError` when there is none.
    """
    task, kwargs = choice.task, choice.env_kwargs
    noted, file = about(run_dir), resolve.file_of(task)
    path, folder = noted.get(_FILE), noted.get(_FOLDER)
    try:
        _import_again(noted.get(_IMPORTS), choice.imports)
        if file is not None and isinstance(path, str) and Path(path).name == file.name and Path(path).is_file():
            return resolve.place(task, get_task(f"{path}:{task.rpartition(':')[2]}", kwargs), kwargs)
        if isinstance(folder, str) and resolve.is_in(Path(folder), task):
            resolved = resolve.resolve(task, Path(folder), kwargs)
            assert resolved is not None, "it has a colon"
            return resolve.place(task, resolved, kwargs)
        return get_task(task, kwargs)
    except MissingTaskError as error:
        raise MissingTaskError(f"{error}; if it has moved, give its new place: --task path/to/file.py:name") from error


def _import_again(folders: Any, modules: tuple[str, ...]) -> None:
    """Imports a run's modules, each from the folder in which it lay, if it is still there."""
    for module in modules:
        lay = folders.get(module) if isinstance(folders, dict) else None
        folder = Path(lay) if isinstance(lay, str) and resolve.holds_module(Path(lay), module) else None
        resolve.import_module(module, folder)


def moved(choice: Choice, where: str) -> Task:
    """Lets the task at `where` stand for the run's task in this process, and returns it.

    Raises `ConfigError` for a task that lies in no file or module, `TaskError` when there is none at `where`.
    """
    if ":" not in choice.task:
        raise ConfigError(
            f"task: expected a run whose task lies in a file or module, got {choice.task}; leave out {where}"
        )
    return resolve.place(choice.task, get_task(where, choice.env_kwargs, choice.imports), choice.env_kwargs)
