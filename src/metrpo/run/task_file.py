"""Where a run's task lies: the name in its settings, file.py:name or module:name, means it from one directory only."""

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
    """What says which task a run has: its settings, or what its policy's file says of it."""

    @property
    def task(self) -> str:
        """Its name."""

    @property
    def env_kwargs(self) -> tuple[str, ...]:
        """What its environment is made with."""

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
    """The task as the run has it: from where its file or module lay, if it is still there, or as the name says.

    From then on the name means that task in this process. Raises `TaskError` when there is none.
    """
    task, given = choice.task, choice.env_kwargs
    noted, file = about(run_dir), resolve.file_of(task)
    lay, folder = noted.get(_FILE), noted.get(_FOLDER)
    try:
        _import_again(noted.get(_IMPORTS), choice.imports)
        if file is not None and isinstance(lay, str) and Path(lay).name == file.name and Path(lay).is_file():
            return resolve.place(task, get_task(f"{lay}:{task.rpartition(':')[2]}", given), given)
        if isinstance(folder, str) and resolve.is_in(Path(folder), task):
            found = resolve.resolve(task, Path(folder), given)
            assert found is not None, "it has a colon"
            return resolve.place(task, found, given)
        return get_task(task, given)
    except MissingTaskError as error:
        raise MissingTaskError(f"{error}; if it has moved, say where: --task path/to/file.py:name") from error


def _import_again(folders: Any, modules: tuple[str, ...]) -> None:
    """Imports a run's modules, each from the folder in which it lay, if it is still there."""
    for module in modules:
        lay = folders.get(module) if isinstance(folders, dict) else None
        folder = Path(lay) if isinstance(lay, str) and resolve.holds_module(Path(lay), module) else None
        resolve.import_module(module, folder)


def moved(choice: Choice, where: str) -> Task:
    """The run's task, which now is what `where` names, in whatever this process does with the run.

    Raises `ConfigError` for a task that lies in no file or module, `TaskError` when there is none at `where`.
    """
    if ":" not in choice.task:
        raise ConfigError(
            f"task: expected it for a run whose task lies in a file or module, got {where} for {choice.task}"
        )
    return resolve.place(choice.task, get_task(where, choice.env_kwargs, choice.imports), choice.env_kwargs)
