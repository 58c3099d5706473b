"""The policy that real episodes have proven best; a run goes back to it where its models were wrong.

The ensemble's vote knows only the models: where all of them err alike, it accepts a policy that earns less. A few real
episodes without noise show it. They count as real steps of the iteration, and the models learn from them too.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from metrpo import budget
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.errors import EpisodeError
from metrpo.finite import naming
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.seeds import Stage, rng_of
from metrpo.stages.log import Log
from metrpo.stages.state import Proven, State, on_host
from metrpo.types import Episode
from metrpo.world import collection as real
from metrpo.world import dataset as datasets
from metrpo.world.origin import of_real
from metrpo.world.task import Task

_log = logging.getLogger("metrpo")
ERRORS = 2.0
"""One policy earns less than another if their mean returns differ by this many standard errors."""


class Verdict(NamedTuple):
    """The result of a policy's real episodes."""

    best: Proven
    given_up: bool
    mean: float
    """Their mean return; NaN where there were fewer than two."""


def steps_kept_for_proof(config: Config, task: Task, real_steps: int) -> int:
    """Real steps of the next iteration that are kept for trying its policy: a quarter at most, else none."""
    steps = config.validate.real_episodes * min(task.horizon, config.collect.steps)
    return steps if 4 * steps <= budget.steps_wanted(config, real_steps) else 0


def prove(config: Config, task: Task, before: State, progress: Progress, log: Log, candidate: State) -> list[Episode]:
    """Real episodes of the candidate's policy without noise, those included that `log` holds; new ones go there.

    Fewer than the config asks for where the environment fails, or where the iteration has no room for them.
    """
    room = steps_kept_for_proof(config, task, before.real_steps)
    # Another program may have handed over more episodes than the iteration asked for.
    if not room or budget.steps_left(config, candidate.real_steps) < room:
        return []
    progress.stage("prove", room)
    iteration, episodes = candidate.iteration, log.proofs()
    act = of_real(partial(gaussian.mean, on_host(candidate.policy)), candidate.origin)
    numbers = range(len(episodes), config.validate.real_episodes)
    rngs = (rng_of(config.seed, iteration, Stage.PROVE, n) for n in numbers)
    try:
        with (
            naming("prove", iteration),
            closing(real.play(task, lambda rng: act, rngs, config.collect.steps, progress.played)) as played,
        ):
            for episode in played:
                episodes.append(episode)
                log.append(episode, proof=True)
    except EpisodeError as error:
        _log.warning("%s; the policy is judged by the %d episodes before it", error, len(episodes))
    return episodes


def settle(config: Config, task: Task, before: State, candidate: State, proofs: list[Episode]) -> tuple[State, Verdict]:
    """The state with which an iteration ends: the candidate, or the best policy so far if the proofs speak against it.

    The models learn from the proofs in either case. The value function goes back with the policy, and the policy that
    is given up says how wide the next parameter noise is.
    """
    verdict = judge(before.proven, candidate.policy, proofs)
    if not proofs:
        return candidate, verdict
    rng = rng_of(config.seed, candidate.iteration, Stage.PROVE, config.validate.real_episodes)
    state = candidate._replace(
        real_steps=candidate.real_steps + sum(len(e.rewards) for e in proofs),
        dataset=datasets.add(candidate.dataset, proofs, config.collect, rng, task.learned, task.carried),
        proven=verdict.best,
    )
    if verdict.given_up:
        best = before.proven.policy
        state = state._replace(policy=best, previous_policy=candidate.policy, baseline=before.baseline)
    return state, verdict


def judge(best: Proven, policy: Policy, episodes: Sequence[Episode]) -> Verdict:
    """Whether `policy`, by its real `episodes`, is given up for the `best` so far, and which of the two is best now."""
    returns = np.array([episode.rewards.sum(dtype=np.float64) for episode in episodes])
    if len(returns) < 2:
        return Verdict(best, False, float("nan"))
    error = float(np.std(returns, ddof=1)) / len(returns) ** 0.5
    now = Proven(policy, float(np.mean(returns)), error, len(returns))
    if best.episodes and _same(best.policy, policy):
        return Verdict(_together(best, now), False, now.mean)
    given_up = best.episodes > 0 and now.mean < best.mean - ERRORS * float(np.hypot(best.error, now.error))
    return Verdict(now if not best.episodes or now.mean > best.mean else best, given_up, now.mean)


def _together(a: Proven, b: Proven) -> Proven:
    """Two trials of one policy as one."""
    share = a.episodes / (a.episodes + b.episodes)
    error = float(np.hypot(share * a.error, (1 - share) * b.error))
    return Proven(a.policy, share * a.mean + (1 - share) * b.mean, error, a.episodes + b.episodes)


def _same(a: Policy, b: Policy) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a.layers), jax.tree.leaves(b.layers), strict=True))
