"""Where the file of a run's task lies: the name in its settings, file.py:name, means it from one directory only."""

from __future__ import annotations

import json
from pathlib import Path

from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.run.files import atomic_write
from metrpo.untrusted import json_of, text_of
from metrpo.world import resolve
from metrpo.world.registry import get_task
from metrpo.world.task import Task

_FIELD = "task_file"


def remember(run_dir: str | Path, task: str) -> None:
    """Notes in `run.json` where the file of the task `task` lies now, if it is named by one."""
    file = resolve.file_of(task)
    about = _about(run_dir)
    if file is not None and about.get(_FIELD) != str(file):
        atomic_write(Path(run_dir) / "run.json", json.dumps(about | {_FIELD: str(file)}, indent=2) + "\n")


def task_of_run(run_dir: str | Path, task: str) -> Task:
    """The task of that name as the run has it: from its file where that lay, if it is still there, or as the name says.

    From then on the name means that task in this process. Raises `TaskError` when there is none.
    """
    lay, file = _about(run_dir).get(_FIELD), resolve.file_of(task)
    if file is not None and isinstance(lay, str) and Path(lay).name == file.name and Path(lay).is_file():
        resolve.place(task, f"{lay}:{task.rpartition(':')[2]}")
    return get_task(task)


def moved(task: str, where: str) -> Task:
    """The run's task `task`, which now is what `where` names, in whatever this process does with the run.

    Raises `ConfigError` for a task that lies in no file or module, `TaskError` when there is none at `where`.
    """
    if ":" not in task:
        raise ConfigError(f"task: expected it for a run whose task lies in a file or module, got {where} for {task}")
    resolve.place(task, where)
    return get_task(task)


def _about(run_dir: str | Path) -> dict[str, object]:
    file = Path(run_dir) / "run.json"
    if not file.is_file():  # a policy by itself
        return {}
    about = json_of(text_of(file, RunDirectoryError), f"{file} is damaged", RunDirectoryError)
    return about if isinstance(about, dict) else {}
