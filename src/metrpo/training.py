"""Training by any method: outer iterations until the budget is spent, saved and resumed.

`algorithm` is this project's method, `baselines` are the methods to compare it with. A method is a pair of functions,
init(config, task) -> state and step(config, task, state, progress) -> (state, row of metrics). The task is looked up
here, once, and passed on.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from metrpo import budget
from metrpo.algorithm import Log, Row
from metrpo.callbacks import Callback, Callbacks
from metrpo.config import Config, require_consistent
from metrpo.console.progress import SILENT, Progress, library_progress
from metrpo.errors import MetrpoError
from metrpo.finite import require_finite
from metrpo.run import task_file
from metrpo.run.directory import RunDirectory
from metrpo.run.memory import require_memory
from metrpo.run.newest_checkpoint import Saved
from metrpo.run.yardstick_record import are_kept, keep
from metrpo.seeds import Stage, rng_of
from metrpo.stages.log import Unkept
from metrpo.world.env_returns import warning_once
from metrpo.world.formula_check import check_formulas
from metrpo.world.registry import task_for
from metrpo.world.size_limits import RECORDED
from metrpo.world.task import Task
from metrpo.world.tasks.gymnasium_formulas import KNOWN
from metrpo.world.yardsticks import measure

_log = logging.getLogger("metrpo")

METHODS = {
    "model-based": "metrpo.algorithm",
    "trpo": "metrpo.baselines.real_trpo",
    "svg": "metrpo.baselines.value_gradients",
    "ppo": "metrpo.baselines.stable_baselines",
    "ddpg": "metrpo.baselines.stable_baselines",
}
"""Modules with `init` and `step`; imported when used, because some need extra libraries."""


def init(config: Config) -> Saved:
    """The state before the first iteration of the config's method.

    Raises `TaskError` for an unknown task or unfitting data, `ConfigError` for settings that contradict each other or
    ask for more memory than there is.
    """
    return _init(config, task_for(config))


def _init(config: Config, task: Task) -> Saved:
    require_consistent(config)
    require_memory(config, task)
    state: Saved = import_module(METHODS[config.method]).init(config, task)
    return state


def step(config: Config, state: Saved, progress: Progress = SILENT, log: Log | None = None) -> tuple[Saved, Row]:
    """One outer iteration of the config's method: the next state and its row of metrics.

    The model-based method writes real episodes to `log` as they end. (For the baselines, real steps are cheap.)
    """
    return _step(config, task_for(config), state, progress, log)


def _step(config: Config, task: Task, state: Saved, progress: Progress, log: Log | None) -> tuple[Saved, Row]:
    logged = (log,) if config.method == "model-based" else ()
    following: tuple[Saved, Row] = import_module(METHODS[config.method]).step(config, task, state, progress, *logged)
    if not logged:  # ours looks at every stage by itself
        require_finite("learn", following[0].iteration, "lower its learning rates", state=following[0])
    return following


def train(
    config: Config,
    run_dir: str | Path | None = None,
    progress: Progress | None = None,
    callbacks: Sequence[Callback] = (),
) -> Saved:
    """Trains until the budget is spent and returns the last state.

    With `run_dir`, every iteration is saved there. A run that is there already resumes, exactly as if it had never
    stopped.

    By default, `progress` is shown in a terminal and in a notebook only; `metrpo.SILENT` shows none. `callbacks`
    receive rows, episodes and checkpoints (`metrpo.Callback`).

    The formulas of a user's own task are checked first (`metrpo.world.formula_check`).

    Raises `TaskError` for an unknown or broken task and `RunDirectoryError` when `run_dir` cannot be used.
    """
    with warning_once():
        return _train(config, run_dir, library_progress() if progress is None else progress, Callbacks(callbacks))


def _train(config: Config, run_dir: str | Path | None, progress: Progress, callbacks: Callbacks) -> Saved:
    task = task_for(config)
    template = _init(config, task)
    if run_dir is None:
        check(config, task)
        callbacks.on_begin(config, None, [])
        return _loop(config, task, template, progress, lambda state, row: row, callbacks)
    with RunDirectory(run_dir, config, task.interface) as run:
        task_file.remember(run_dir, config)
        state, measured = run.load(template), are_kept(run.path, config.task)
        _say_where(config, run, state or template, measured, progress)
        if state is None:
            check(config, task)
            if not measured:
                _measure_yardsticks(config, task, run, progress)
        callbacks.on_begin(config, run.path, run.rows)

        def save(state: Saved, row: Row) -> Mapping[str, Any]:
            written = run.save(state, row)
            callbacks.on_checkpoint(run.newest)
            return written

        return _loop(config, task, state or template, progress, save, callbacks, run.episodes)


def _say_where(config: Config, run: RunDirectory, state: Saved, measured: bool, progress: Progress) -> None:
    """Says that a run resumes, even one without a finished iteration."""
    waiting = run.episodes.waiting_steps()
    if state.iteration or state.real_steps or waiting or measured:
        left = _iterations_left(config, state)
        of = None if left is None else state.iteration + max(left, 0)
        progress.resume(str(run.path), state.iteration + 1, of, state.real_steps, waiting)


def check(config: Config, task: Task) -> None:
    """Checks the formulas of a user's task against its environment (`metrpo.world.formula_check`).

    Warns of episodes that evaluation will cut. Raises `TaskError` where formulas and environment differ.
    """
    if task.playable and task.horizon > RECORDED:
        _log.warning(
            "%s: episodes have up to %s steps; evaluation cuts them after %s, so the gap between imagined and real "
            "returns is not measured",
            task.name, f"{task.horizon:,}", f"{RECORDED:,}",
        )  # fmt: skip
    # The tests check ours against their environments (without arguments).
    ours = task.make is None or (task.name in KNOWN and not config.env_kwargs)
    if not (ours or config.trust_reward or config.learn_reward):
        check_formulas(task, rng_of(config.seed, 0, Stage.COLLECT))


def _measure_yardsticks(config: Config, task: Task, run: RunDirectory, progress: Progress) -> None:
    """Measures, prints and keeps in run.json what no skill earns. Its real steps are not counted or learned from."""
    if not task.playable or config.real_steps == 0:
        return
    try:
        yardsticks = measure(task)
    except MetrpoError as error:  # a record may not cost the run
        _log.warning("cannot measure the returns of doing nothing and of random actions: %s", error)
        return
    keep(run.path, config.task, yardsticks.record())
    progress.say(yardsticks.text())


def _loop(
    config: Config,
    task: Task,
    state: Saved,
    progress: Progress,
    save: Callable[[Saved, Row], Mapping[str, Any]],
    callbacks: Callbacks,
    log: Log | None = None,
) -> Saved:
    seconds: list[float] = []
    try:
        while not finished(config, state):
            started = time.monotonic()
            left = _iterations_left(config, state)
            progress.begin(state.iteration + 1, None if left is None else state.iteration + left)
            state, row = _step(config, task, state, progress, callbacks.log(log or Unkept()))
            written = save(state, row)
            callbacks.on_iteration(written)
            seconds.append(time.monotonic() - started)
            progress.end(written, seconds_left(seconds, _iterations_left(config, state)))
    finally:
        progress.close()
        callbacks.on_end()
    return state


def seconds_left(seconds: Sequence[float], iterations: int | None) -> float | None:
    """About how long `iterations` take, after some that took so many seconds; None where that cannot be told."""
    if iterations == 0:
        return 0.0
    each = budget.seconds_of_next(seconds)
    return None if iterations is None or each is None else iterations * each


def _iterations_left(config: Config, state: Saved) -> int | None:
    return budget.iterations_left(config, state.iteration, state.real_steps)


def finished(config: Config, state: Saved) -> bool:
    """Whether the budget, iterations or real steps, is spent."""
    return budget.finished(config, state.iteration, state.real_steps)
