"""Real episodes of the exploring policy: played, kept as they end, and left out where the environment fails."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import closing

from metrpo import budget
from metrpo.config import Config
from metrpo.console.progress import SILENT, Progress
from metrpo.errors import EpisodeError, NotFiniteError
from metrpo.finite import naming
from metrpo.seeds import Stage, rng_of
from metrpo.stages.log import Log, Unkept, left_out
from metrpo.stages.search_table import SEARCHES
from metrpo.stages.state import State
from metrpo.types import Episode
from metrpo.world import collection as real
from metrpo.world.task import Task


def collect(
    config: Config,
    task: Task,
    state: State,
    progress: Progress = SILENT,
    log: Log | None = None,
    at_least: int | None = None,
    kept: int = 0,
) -> list[Episode]:
    """The real episodes of the next iteration: those that wait in `log`, and more until they have enough steps.

    Enough are `at_least`, or as many as the config asks for and its budget allows, less those `kept` for something
    else. They are whole but for very long ones (`budget.longest_episode`) and the one that reaches the end of the
    budget. New ones go to `log` as they end; what a run that was stopped has collected is not collected again.

    An episode in which the environment gives NaN or infinity is left out for good: its seed would give the same again.
    So is one that fails otherwise, but in its second try: the first ends the run. Raises `UnplayableError` when too
    many are left out, `EpisodeError` for another failure.
    """
    enough = budget.steps_wanted(config, state.real_steps) - kept if at_least is None else at_least
    at_most = budget.steps_left(config, state.real_steps) - kept if at_least is None else math.inf
    progress.stage("collect", enough)
    log = log or Unkept()
    episodes = log.pending()
    while sum(len(e.rewards) for e in episodes) < enough:
        number = len(episodes) + left_out(log)
        try:
            with naming("collect", state.iteration + 1):
                explorer = SEARCHES[config.improver].explorer(config, task, state)
                # Each episode has randomness of its own, so that it is the same one after any interruption.
                rngs = (rng_of(config.seed, state.iteration + 1, Stage.COLLECT, n) for n in itertools.count(number))
                steps = sum(len(e.rewards) for e in episodes)
                longest = budget.longest_episode(config, state.real_steps)
                with closing(real.play(task, explorer, rngs, longest, progress.played, at_most - steps)) as played:
                    _take(played, episodes, enough, log, progress)
        except EpisodeError as error:
            _note_failure(log, len(episodes) + left_out(log), error)
    return episodes


def _take(played: Iterator[Episode], episodes: list[Episode], enough: int, log: Log, progress: Progress) -> None:
    """Adds what is `played` to `episodes` until they have `enough` steps."""
    steps = sum(len(e.rewards) for e in episodes)
    while steps < enough:
        episodes.append(next(played))
        log.append(episodes[-1])
        steps += len(episodes[-1].rewards)
        progress.update(steps)


def _note_failure(log: Log, number: int, error: EpisodeError) -> None:
    """Leaves an episode out, or raises its `error`: what was not the seed's fault may go better next time."""
    failures = dict(log.failures())
    hopeless = isinstance(error, NotFiniteError) or number in failures
    failures[number] = hopeless
    log.note_failures(failures)
    if not hopeless:
        raise error
    real.leave_out(sum(failures.values()), error)
