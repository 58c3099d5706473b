"""One outer iteration in separate steps, where another program plays the episodes, on a robot, say.

    begin(config, DIR)        writes the untrained policy
    repeat:
        DIR/policy.npz        plays; its episodes come back by `append_episode`, from a log, or by `collect`
        improve(DIR)          learns from the new episodes, and writes the next policy

Each step leaves the run directory as `train` does: `train` may continue such a run, and these steps one of `train`.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from metrpo import algorithm, budget
from metrpo.algorithm import State
from metrpo.config import Config
from metrpo.console.progress import SILENT, Progress
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.run import task_file
from metrpo.run.directory import RunDirectory, stored_config
from metrpo.run.memory import require_memory
from metrpo.run.metrics import Row
from metrpo.stages.records import Real
from metrpo.training import check
from metrpo.types import Episode
from metrpo.world import offline_data
from metrpo.world.registry import task_for
from metrpo.world.task import Task


def begin(config: Config, run_dir: str | Path) -> None:
    """Creates a run in `run_dir` that has learned nothing yet; its policy can play at once.

    Raises `RunDirectoryError` when `run_dir` cannot be used or holds a run, `TaskError` and `ConfigError` as `train`.
    """
    known = task_for(config)
    state = _ours(config, known)
    with RunDirectory(run_dir, config, known.interface) as run:
        if run.load(state) is not None:
            raise RunDirectoryError(
                f"{run_dir} holds a run already: continue it with metrpo improve, or choose another"
            )
        check(config, known)
        task_file.remember(run_dir, config)
        run.begin(state)


def collect(
    run_dir: str | Path,
    at_least: int | None = None,
    data: str | Path | None = None,
    progress: Progress = SILENT,
    task: str | None = None,
) -> list[Episode]:
    """Adds real episodes to a run, and returns all that wait to be learned from.

    Plays the environment with exploration until the waiting episodes have `at_least` steps (default: the config's
    `collect.steps`, within its budget of real steps), or adds offline data (`world.offline_data`) that does not wait
    yet. `task` names the run's task, if its file has moved.

    Raises `RunDirectoryError` when `run_dir` holds no run, `TaskError` when the task has no environment to play,
    `ConfigError` when the budget is spent and `at_least` does not ask for more.
    """
    config = stored_config(run_dir)
    known = _settled(run_dir, config, task)
    with RunDirectory(run_dir, config, known.interface) as run:
        state = _state(run, config, known)
        if data is not None:
            waiting = Counter(map(_content, run.episodes.pending()))
            for episode in offline_data.load(data, known):
                if waiting[_content(episode)]:  # added already, before a stop half-way
                    waiting[_content(episode)] -= 1
                else:
                    run.episodes.append(episode)
            return run.episodes.pending()
        known.require_playable()
        if at_least is None and budget.steps_left(config, state.real_steps) == 0:
            raise ConfigError(
                f"real_steps: the budget of {run_dir}, {config.real_steps:,}, is spent; to play more anyway: "
                f"metrpo collect {run_dir} --steps {config.collect.steps}"
            )
        progress.begin(state.iteration + 1, None)
        try:
            return algorithm.collect(config, known, state, progress, run.episodes, at_least)
        finally:
            progress.close()


def improve(run_dir: str | Path, progress: Progress = SILENT, task: str | None = None) -> Row:
    """Learns from a run's new episodes in one outer iteration, and returns its row of metrics.

    `task` names the run's task, if its file has moved. Raises `RunDirectoryError` when `run_dir` holds no run or no new
    episodes.
    """
    config = stored_config(run_dir)
    known = _settled(run_dir, config, task)
    with RunDirectory(run_dir, config, known.interface) as run:
        state = _state(run, config, known)
        episodes = run.episodes.pending()
        if not episodes:
            raise RunDirectoryError(
                f"{run_dir}: expected episodes to learn from, got none; add some with metrpo collect {run_dir}, "
                "or metrpo.append_episode in your robot's program"
            )
        progress.begin(state.iteration + 1, None)
        try:
            real = Real(algorithm.left_out(run.episodes))  # no proofs of the policy: another program plays
            written = run.save(*algorithm.learn(config, known, state, episodes, progress, None, real))
            progress.end(written, None)
        finally:
            progress.close()
    return written


def _settled(run_dir: str | Path, config: Config, where: str | None) -> Task:
    """The run's task, known under its name from now on: from its file's old place or the new one."""
    if where is None:
        task_file.task_of_run(run_dir, config)
    else:
        task_file.moved(config, where)
    return task_for(config)


def _content(episode: Episode) -> tuple[bytes | bool, ...]:
    # Files of earlier versions hold float32.
    return (
        np.asarray(episode.states, np.float64).tobytes(),
        episode.actions.tobytes(),
        episode.rewards.tobytes(),
        episode.terminated,
    )


def _ours(config: Config, task: Task) -> State:
    if config.method != "model-based":
        raise ConfigError(f"system: expected one that learns models, got {config.system}; use metrpo train for it")
    require_memory(config, task)
    return algorithm.init(config, task)


def _state(run: RunDirectory, config: Config, task: Task) -> State:
    state = _ours(config, task)
    return run.load(state) or state
