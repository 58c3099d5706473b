"""The policy improved in the fitted ensemble, from the start states that the settings name."""

from __future__ import annotations

import math
from copy import deepcopy

import jax
import numpy as np
from jaxtyping import Float

from metrpo import policy_phase
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.finite import naming
from metrpo.model.ensemble import Ensemble
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.inputs import folded
from metrpo.policy.stopping import most_improve
from metrpo.policy.value.table import Baseline, init_baseline
from metrpo.policy_phase import Hooks, PhaseInfo, Starts, simulator_of
from metrpo.run.clock import Clock
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.records import recorded_returns
from metrpo.stages.state import State, inputs_for
from metrpo.world import collect as real
from metrpo.world.dataset import Dataset
from metrpo.world.origin import relative, shifted
from metrpo.world.task import Task

CLEARLY = 1.2


def improve_policy(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock
) -> tuple[Policy, Baseline, PhaseInfo]:
    """The policy phase (`metrpo.policy_phase`): the accepted policy, its baseline and what happened.

    `state` holds the dataset that the ensemble was fitted to. Where it is an iteration for that, a fresh policy has a
    phase as well, and the models vote between the two.
    """
    iteration, dataset = state.iteration + 1, state.dataset
    rng = rng_of(config.seed, iteration, Stage.IMPROVE)
    inputs = inputs_for(config, task, dataset)
    simulator = simulator_of(config, shifted(task, dataset.origin), ensemble, inputs)
    starts = _starts(config, task, dataset, iteration, simulator.horizon, rng)

    def oracle(policy: Policy) -> float:
        # A policy in which the environment fails is no improvement, and the next iteration has other starts. They are
        # others than the record's, which would else be a selected maximum.
        return float(np.mean(recorded_returns(config, task, policy, iteration, Stage.ORACLE, dataset.origin)))

    def tell(updates: int, accepted: int, value: float) -> None:
        progress.update(updates, f"accepted {accepted}, imagined return {value:.2f}")

    def phase(policy: Policy, baseline: Baseline, stage: Stage) -> tuple[Policy, Baseline, PhaseInfo]:
        # Every phase draws the same start states, so that the models can compare what they end with.
        began, key = Starts(starts, deepcopy(rng)), key_of(config.seed, iteration, stage)
        return policy_phase.improve(config, simulator, policy, baseline, began, key, Hooks(clock, tell, oracle))

    found = phase(_with_std(config, state), state.baseline, Stage.IMPROVE)
    if not config.policy.restart_every or iteration % config.policy.restart_every:
        return found
    progress.stage("improve a fresh policy", config.validate.max_updates)
    policy, baseline = fresh_policy(config, task, iteration, Stage.RESTART)
    other = phase(policy if inputs is None else folded(policy, inputs), baseline, Stage.RESTART)
    return (*other[:2], other[2]._replace(restarted=True)) if _is_preferred(config, other[2], found[2]) else found


def _is_preferred(config: Config, fresh: PhaseInfo, other: PhaseInfo) -> bool:
    """Whether the models vote for the policy of the `fresh` phase: it learned `CLEARLY` times what the other knows.

    Both gains are measured from the policy that knows nothing: neither the size nor the origin of rewards matters.
    A little more is no reason: a policy that is new to the data is promised too much.
    """
    nothing = fresh.first_values
    return most_improve(fresh.values - nothing, CLEARLY * (other.values - nothing), config.validate)


def fresh_policy(config: Config, task: Task, iteration: int, stage: Stage) -> tuple[Policy, Baseline]:
    """A policy that has learned nothing, and its value function."""
    key = key_of(config.seed, iteration, stage)
    p = config.policy
    policy = gaussian.init(key, task.state_size, task.action_size, p.hidden, p.initial_std)
    return policy, init_baseline(config.advantage, task.state_size, jax.random.fold_in(key, 0))


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
