"""The policy improved in the fitted ensemble, from the start states that the settings name."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from metrpo import policy_phase
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.finite import naming
from metrpo.model.ensemble import Ensemble
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.value.value_table import Baseline
from metrpo.policy_phase import Hooks, PhaseInfo, Starts, simulator_of
from metrpo.run.clock import Clock
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.records import recorded_returns
from metrpo.stages.state import State, inputs_for
from metrpo.world import collection as real
from metrpo.world.dataset import Dataset
from metrpo.world.origin import relative, shifted
from metrpo.world.task import Task


def improve_policy(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock
) -> tuple[Policy, Baseline, PhaseInfo]:
    """The policy phase (`metrpo.policy_phase`): the accepted policy, its baseline and what happened.

    `state` holds the dataset that the ensemble was fitted to.
    """
    iteration, dataset = state.iteration + 1, state.dataset
    rng = rng_of(config.seed, iteration, Stage.IMPROVE)
    simulator = simulator_of(config, shifted(task, dataset.origin), ensemble, inputs_for(config, task, dataset))
    starts = _starts(config, task, dataset, iteration, simulator.horizon, rng)

    def oracle(policy: Policy) -> float:
        # A policy in which the environment fails is no improvement, and the next iteration has other starts. They are
        # others than the record's, which would else be a selected maximum.
        return float(np.mean(recorded_returns(config, task, policy, iteration, Stage.ORACLE, dataset.origin)))

    def tell(updates: int, accepted: int, value: float) -> None:
        progress.update(updates, f"accepted {accepted}, imagined return {value:.2f}")

    return policy_phase.improve(
        config,
        simulator,
        _with_std(config, state),
        state.baseline,
        Starts(starts, rng),
        key_of(config.seed, iteration, Stage.IMPROVE),
        Hooks(clock, tell, oracle),
    )


def _starts(
    config: Config, task: Task, dataset: Dataset, iteration: int, horizon: int, rng: np.random.Generator
) -> Float[np.ndarray, "E S"]:
    """Where imagined episodes may start."""
    if config.imagine.start == "anywhere":
        return dataset.train.states
    if config.imagine.start == "dataset":
        return dataset.starts
    with naming("improve", iteration):
        rollouts = policy_phase.rollouts_for(config.imagine.steps, horizon)
        starts = real.reset_states(task, max(config.validate.starts, rollouts), rng)
    return relative(starts, dataset.origin).astype(np.float32)


def _with_std(config: Config, state: State) -> Policy:
    """The policy with the standard deviation that a phase starts from."""
    if config.policy.min_std and state.iteration > 0:
        least = np.float32(math.log(config.policy.min_std))
        return state.policy._replace(log_std=np.maximum(np.asarray(state.policy.log_std), least))
    return gaussian.reset_std(state.policy, config.policy.initial_std)
