"""The budget of a run, iterations or real steps: what is left of it, and what the next iteration may collect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from metrpo.config import Config

LONGEST = 1_000
"""Steps after which an episode is cut, unless an iteration collects more: a policy that never saw the rest of an
episode fails there (docs/actor-critic.md)."""


def steps_left(config: Config, real_steps: int) -> float:
    """Real steps that may still be played after `real_steps`; infinity where the budget is of iterations."""
    return math.inf if config.real_steps is None else max(0, config.real_steps - real_steps)


def steps_wanted(config: Config, real_steps: int) -> int:
    """Real steps that the next iteration collects: as many as the settings say, or what is left of the budget."""
    first = config.actor_critic.random_steps if _at_random(config, real_steps) else 0
    return int(min(max(config.collect.steps, first), steps_left(config, real_steps)))


def longest_episode(config: Config, real_steps: int) -> int:
    """Steps after which an episode of the next iteration is cut: of random actions, `collect.steps`."""
    return config.collect.steps if _at_random(config, real_steps) else max(config.collect.steps, LONGEST)


def _at_random(config: Config, real_steps: int) -> bool:
    """Whether the next iteration is the actor-critic's first, which acts at random."""
    return config.by_critics and not real_steps


def finished(config: Config, iteration: int, real_steps: int) -> bool:
    """Whether the budget is spent after so many iterations and real steps."""
    if config.real_steps:  # 0: learns from offline data, for so many iterations
        return real_steps >= config.real_steps
    return iteration >= config.iterations


def spent(config: Config, rows: Sequence[Mapping[str, float | None]]) -> bool:
    """Whether a run with these rows of metrics has used up its budget."""
    return bool(rows) and finished(config, int(rows[-1]["iteration"] or 0), int(rows[-1]["real_steps"] or 0))


def seconds_of_next(seconds: Sequence[float]) -> float | None:
    """How long the next iteration will take, by the median of the last three; None where that cannot be told.

    `seconds` are those of all iterations so far. They grow with the data, and the first one compiles.
    """
    recent = np.asarray(seconds[1:][-3:])
    return float(np.median(recent)) if len(recent) and np.isfinite(recent).all() else None


def iterations_left(config: Config, iteration: int, real_steps: int) -> int | None:
    """About how many iterations follow; None where the next one has to say how many real steps one takes."""
    if not config.real_steps:
        return config.iterations - iteration
    left = steps_left(config, real_steps)
    if not left:
        return 0
    # The actor-critic's first iteration, of random actions, has other episodes than the rest.
    apart = int(config.by_critics)
    alike = iteration - apart
    if alike < 1:
        return None
    return math.ceil(left * alike / max(real_steps - apart * steps_wanted(config, 0), 1))
