"""The record of an iteration: its row of metrics. Nothing is learned from it, and it may fail without harm."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from metrpo import scales
from metrpo.config import Config
from metrpo.errors import MetrpoError
from metrpo.finite import naming
from metrpo.model.calibration import Calibration, end_calibration
from metrpo.model.diagnostics import Diagnosis, diagnose, unknown
from metrpo.model.ensemble import Ensemble
from metrpo.model.fit import FitInfo
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy_phase import PhaseInfo, imagined_horizon
from metrpo.run.metrics import Row
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.proven import Verdict
from metrpo.stages.state import State, on_host
from metrpo.types import Episode
from metrpo.world import batch_episodes
from metrpo.world.collection import Act
from metrpo.world.dataset import Dataset
from metrpo.world.origin import of_real
from metrpo.world.size_limits import RECORDED
from metrpo.world.task import Task

_log = logging.getLogger("metrpo")
EVALUATION_STEPS = 200_000
"""Real steps of one evaluation after which no new episode begins: evaluation must not take longer than learning."""
T = TypeVar("T")


class Real(NamedTuple):
    """What an iteration gets from the real environment, besides the episodes that it learns from."""

    failed: int = 0
    """Episodes left out because the environment failed in them."""
    prove: Callable[[State], list[Episode]] = lambda candidate: []
    """Real episodes that try the candidate's policy (`stages.proven`)."""


NOTHING = Real()


class Done(NamedTuple):
    """What the stages of one iteration did."""

    episodes: list[Episode]
    failed: int
    """Other episodes, left out because the environment failed in them."""
    ensemble: Ensemble
    fitted: FitInfo
    improved: PhaseInfo
    verdict: Verdict


def recorded(what: str, iteration: int, record: Callable[[], T], failed: T) -> T:
    """The result of `record()`; where it fails, `failed` and a warning, so that no record costs what was learned.

    `console.interrupt.Stopped` passes through.
    """
    try:
        return record()
    except Exception as error:
        why = str(error) if isinstance(error, MetrpoError) else f"{type(error).__name__}: {error}"
        _log.warning("iteration %d has no %s (%s); what it learned is kept", iteration, what, why)
        return failed


def recorded_returns(
    config: Config,
    task: Task,
    policy: Policy,
    iteration: int,
    stage: Stage = Stage.EVALUATE,
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """As `evaluate`; one NaN where that fails."""

    def returns() -> np.ndarray:
        with naming("evaluate" if stage is Stage.EVALUATE else "validate", iteration):
            return evaluate(config, task, policy, iteration, stage, origin)

    return recorded("return_real", iteration, returns, np.array([math.nan]))


def failed_evaluation(task: Task, returns: np.ndarray) -> int:
    """1 where there is no real return though the task has an environment, else 0."""
    return int(task.playable and not np.isfinite(returns).all())


def _diagnosis(config: Config, task: Task, state: State, ensemble: Ensemble) -> Diagnosis:
    dataset, horizon = state.dataset, imagined_horizon(config, task)
    key = key_of(config.seed, state.iteration, Stage.DIAGNOSE)
    record = partial(diagnose, ensemble, state.policy, dataset.validation, dataset.train, horizon, key)
    return recorded("diagnostics", state.iteration, record, unknown(task.observation_size, horizon))


def _end_calibration(task: Task, dataset: Dataset, ensemble: Ensemble, iteration: int) -> Row:
    if "end" not in task.learned:
        return {}
    nothing = Calibration(*[math.nan] * len(Calibration._fields))
    trust = recorded("calibration", iteration, partial(end_calibration, ensemble, dataset.validation), nothing)
    return {f"end_{name}": value for name, value in trust._asdict().items()}


def evaluate(
    config: Config,
    task: Task,
    policy: Policy,
    iteration: int,
    stage: Stage = Stage.EVALUATE,
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """Real returns [config.evaluation_episodes] of the deterministic policy: a record, never used to learn.

    The policy sees states less `origin` [S].

    Fewer episodes where they reach `EVALUATION_STEPS`; each is cut after `RECORDED` steps. One NaN for a task that only
    another program plays.
    """
    if not task.playable:
        return np.array([math.nan])
    seed = int(rng_of(config.seed, iteration, stage).integers(2**31))
    act: Act = partial(gaussian.mean, on_host(policy))
    act = act if origin is None else of_real(act, origin)
    return batch_episodes.evaluate(task, act, config.evaluation_episodes, seed, EVALUATION_STEPS, RECORDED)


def record(config: Config, task: Task, state: State, done: Done) -> Row:
    """The row of the iteration that ended in `state`, but for its seconds.

    A measurement that fails is NaN, with a warning.
    """
    iteration, dataset = state.iteration, state.dataset
    diagnosis = _diagnosis(config, task, state, done.ensemble)
    returns = recorded_returns(config, task, state.policy, iteration, origin=dataset.origin)
    trust = _end_calibration(task, dataset, done.ensemble, iteration)
    unfit = partial(scales.count, config, task, dataset, done.episodes)
    row = _outcome(state, returns, done, cut=imagined_horizon(config, task) < task.horizon or task.horizon > RECORDED)
    if config.validate.real_episodes:
        row |= {"return_proof": done.verdict.mean, "given_up": int(done.verdict.given_up)}
    row |= {"failed_episodes": done.failed, "failed_evaluation": failed_evaluation(task, returns)}
    row |= {"unfit_dimensions": recorded("unfit_dimensions", iteration, unfit, math.nan)}
    shares = {f"improved_{k}": float(share) for k, share in enumerate(done.improved.improved)}
    return row | diagnosis.row() | shares | trust | dict(done.improved.more)


def _outcome(state: State, returns: np.ndarray, done: Done, cut: bool) -> Row:
    fitted, improved = done.fitted, done.improved
    collected = float(np.mean([e.rewards.sum() for e in done.episodes])) if done.episodes else math.nan
    imagined = float(np.mean(improved.values))
    losses = np.asarray(fitted.validation_loss)
    return {
        "iteration": state.iteration,
        "real_steps": state.real_steps,
        "return_real": float(np.mean(returns)),
        "return_real_std": float(np.std(returns)),
        "return_collected": collected,
        "return_imagined": imagined,
        # Returns of episodes of different lengths cannot be compared.
        "gap": math.nan if cut else imagined - float(np.mean(returns)),
        **{f"validation_loss_{k}": float(loss) for k, loss in enumerate(losses)},
        "train_loss": float(np.mean(fitted.train_loss)),
        "fit_passes": fitted.passes,
        "members_reset": fitted.resets,
        "updates": improved.updates,
        "accepted_updates": improved.accepted_updates,
        "rejected_steps": improved.rejected_steps,
        "validations": improved.validations,
        "fraction_improved": float(np.mean(improved.improved)),
        "kl": improved.kl,
        "mean_std": float(np.mean(np.exp(np.asarray(state.policy.log_std)))),
        "diverged": improved.diverged,
    }
