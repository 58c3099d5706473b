"""Where a run's task lies: the name in its settings, file.py:name or module:name, means it from one directory only."""

from __future__ import annotations

from pathlib import Path

from metrpo.errors import ConfigError, MissingTaskError
from metrpo.run.about import about, note
from metrpo.world import resolve
from metrpo.world.registry import get_task
from metrpo.world.task import Task

_FILE, _FOLDER = "task_file", "task_folder"


def remember(run_dir: str | Path, task: str) -> None:
    """Notes in `run.json` where the file of the task `task` lies now, or its module's folder, if it is named by one."""
    places = {_FILE: resolve.file_of(task), _FOLDER: resolve.folder_of(task)}
    note(run_dir, {field: str(place) for field, place in places.items() if place is not None})


def task_of_run(run_dir: str | Path, task: str) -> Task:
    """The task of that name as the run has it: from where its file or module lay, if it is still there, or as the name
    says.

    From then on the name means that task in this process. Raises `TaskError` when there is none.
    """
    noted, file = about(run_dir), resolve.file_of(task)
    lay, folder = noted.get(_FILE), noted.get(_FOLDER)
    if file is not None and isinstance(lay, str) and Path(lay).name == file.name and Path(lay).is_file():
        return resolve.place(task, get_task(f"{lay}:{task.rpartition(':')[2]}"))
    if isinstance(folder, str) and resolve.is_in(Path(folder), task):
        found = resolve.resolve(task, Path(folder))
        assert found is not None, "it has a colon"
        return resolve.place(task, found)
    try:
        return get_task(task)
    except MissingTaskError as error:
        raise MissingTaskError(f"{error}; if it has moved, say where: --task path/to/file.py:name") from error


def moved(task: str, where: str) -> Task:
    """The run's task `task`, which now is what `where` names, in whatever this process does with the run.

    Raises `ConfigError` for a task that lies in no file or module, `TaskError` when there is none at `where`.
    """
    if ":" not in task:
        raise ConfigError(f"task: expected it for a run whose task lies in a file or module, got {where} for {task}")
    return resolve.place(task, get_task(where))
