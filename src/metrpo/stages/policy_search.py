"""The paper's search: a policy that explores by noise, and is improved in the fitted ensemble in phases."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

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
from metrpo.policy.inputs import Inputs, folded, unfolded
from metrpo.policy.value.value_table import Baseline, init_baseline
from metrpo.policy_phase import Hooks, PhaseInfo, Starts, simulator_of
from metrpo.run.clock import Clock
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.records import recorded_returns
from metrpo.stages.state import State, inputs_for, on_host
from metrpo.types import Array
from metrpo.world import collection as real
from metrpo.world.dataset import Dataset
from metrpo.world.origin import of_real, relative, shifted
from metrpo.world.task import Task


def fresh(config: Config, task: Task, key: Array) -> tuple[Policy, Baseline]:
    """A policy and a baseline that have learned nothing."""
    p = config.policy
    policy = gaussian.init(key, task.state_size, task.action_size, p.hidden, p.initial_std)
    return policy, init_baseline(config.advantage, task.state_size, key_of(config.seed, 0, Stage.IMPROVE))


def explorer(config: Config, task: Task, state: State) -> Callable[[np.random.Generator], real.Act]:
    """What acts in an episode: the policy with noise on its parameters and its actions, drawn anew for each."""
    inputs = inputs_for(config, task, state.dataset)
    policies = on_host(state.policy), on_host(state.previous_policy)

    def act(rng: np.random.Generator) -> real.Act:
        mean = perturbed(*policies, config.collect.parameter_noise, rng, inputs)
        return real.explore(of_real(mean, state.origin), config.collect, rng)

    return act


def perturbed(
    policy: Policy, previous: Policy, scale: float, rng: np.random.Generator, inputs: Inputs | None = None
) -> real.Act:
    """The mean action of the policy with its parameters perturbed (paper, appendix A.1.1).

    Those that act on normalised states: an offset of the states would blow up the noise of raw ones.
    """
    if inputs is not None:
        policy, previous = unfolded(policy, inputs), unfolded(previous, inputs)

    def noisy(now: np.ndarray, before: np.ndarray) -> np.ndarray:
        return now + scale * np.abs(now - before) * rng.standard_normal(now.shape)

    perturbed = policy._replace(layers=jax.tree.map(noisy, policy.layers, previous.layers))
    return partial(gaussian.mean, perturbed if inputs is None else folded(perturbed, inputs))


def improve_policy(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock, steps: int = 0
) -> tuple[Policy, Baseline, PhaseInfo]:
    """The policy phase (`metrpo.policy_phase`): the accepted policy, its baseline and what happened.

    `state` holds the dataset that the ensemble was fitted to. How many real `steps` are new does not matter here.
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
