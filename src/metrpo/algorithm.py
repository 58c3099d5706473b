"""The loop: model-ensemble trust-region policy optimization (the paper's Algorithm 2).

    repeat:
        collect   real episodes with the policy, add them to the dataset        world/collect.py, world/dataset.py
        fit       every model of the ensemble to the dataset                    model/fit.py
        repeat:
            imagine   rollouts through the ensemble with the policy             model/imagine.py
            improve   the policy on them, by TRPO                               policy/improve.py, policy/trpo.py
            validate  the policy in each model                                  policy/validate.py
        until the models no longer agree that it improves
    until the budget is spent

`step` is one turn of the outer loop and reads like it; `metrpo.training` repeats it until the budget is spent.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from metrpo import phase
from metrpo.config import Config
from metrpo.errors import ConfigError
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble, Networks
from metrpo.model.fit import FitInfo, fit
from metrpo.phase import PhaseInfo
from metrpo.policy import advantage, gaussian
from metrpo.policy.gaussian import Policy
from metrpo.run.clock import Clock
from metrpo.run.progress import SILENT, Progress
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.types import Array
from metrpo.world import collect as real
from metrpo.world import dataset as datasets
from metrpo.world import logged
from metrpo.world.dataset import Dataset
from metrpo.world.registry import get_task, without_formulas
from metrpo.world.task import Task

Row = dict[str, float | int]
"""One iteration's metrics, in the order of metrics.csv's columns."""


class State(NamedTuple):
    """Everything that an iteration hands to the next: a pytree whose structure the config fixes."""

    iteration: int
    """Outer iterations finished."""
    real_steps: int
    """Real steps collected so far (evaluation does not count: nothing is learned from it)."""
    policy: Policy
    previous_policy: Policy
    """The policy before the last policy phase that changed it; scales the parameter noise."""
    networks: Networks
    """Of the ensemble; its normaliser derives from the dataset."""
    baseline: Array
    dataset: Dataset


def init(config: Config) -> State:
    """The state before the first iteration.

    Raises `TaskError` for an unknown task, `ConfigError` for settings that contradict each other.
    """
    task = task_for(config)
    if config.imagine.horizon is not None and config.advantage.discount == 1:
        # Undiscounted, a value that leans on itself grows without bound.
        raise ConfigError("advantage.discount: expected less than 1 with imagine.horizon (0.99, say), got 1.0")
    policy_key, ensemble_key = jax.random.split(key_of(config.seed, 0, Stage.INIT))
    policy = gaussian.init(
        policy_key, task.state_size, task.action_size, config.policy.hidden, config.policy.initial_std
    )
    return State(
        iteration=0,
        real_steps=0,
        policy=policy,
        previous_policy=policy,
        networks=_fresh_networks(config, task, ensemble_key),
        baseline=advantage.init_baseline(task.state_size),
        dataset=_logged(config, task),
    )


def step(config: Config, state: State, progress: Progress = SILENT) -> tuple[State, Row]:
    """One outer iteration: collect, fit, improve until the ensemble disagrees; and evaluate, for the record only."""
    task = task_for(config)
    iteration = state.iteration + 1
    clock = Clock()
    with clock("collect"):
        wanted = 0 if config.real_steps == 0 else config.collect.steps
        progress.stage("collect", wanted)
        rng = rng_of(config.seed, iteration, Stage.COLLECT)
        mean = partial(_perturbed, _host(state.policy), _host(state.previous_policy), config.collect.parameter_noise)
        explorer = lambda rng: real.explore(mean(rng), config.collect, rng)  # noqa: E731
        episodes = real.collect(task, explorer, wanted, rng, progress.update)
        dataset = datasets.add(state.dataset, episodes, config.collect, rng, task.learned)
    with clock("fit"):
        progress.stage("fit", None)
        ensemble, fitted = _fit(config, task, state.networks, dataset, iteration, progress)
    with clock("improve"):
        progress.stage("improve", config.validate.max_updates)
        policy, baseline, improved = _improve(config, task, state, dataset, ensemble, iteration, progress, clock)
    with clock("evaluate"):
        progress.stage("evaluate", config.evaluation_episodes)
        returns = evaluate(config, task, policy, iteration)
    state = State(
        iteration=iteration,
        real_steps=state.real_steps + sum(len(e.rewards) for e in episodes),
        policy=policy,
        previous_policy=state.policy if improved.accepted_updates else state.previous_policy,
        networks=ensemble.networks,
        baseline=baseline,
        dataset=dataset,
    )
    collected = float(np.mean([e.rewards.sum() for e in episodes])) if episodes else math.nan
    return state, _row(config, state, returns, collected, fitted, improved, clock)


def _fit(
    config: Config, task: Task, networks: Networks, dataset: Dataset, iteration: int, progress: Progress
) -> tuple[Ensemble, FitInfo]:
    init_key, fit_key = jax.random.split(key_of(config.seed, iteration, Stage.FIT))
    every = config.fit.reinitialise_every
    if every and (iteration - 1) % every == 0:
        networks = _fresh_networks(config, task, init_key)
    return fit(
        networks,
        ensembles.normaliser_of(dataset.train, config.ensemble.std_floor, config.ensemble.delta_std_floor, task.unseen),
        jax.device_put(datasets.with_capacity(dataset.train, config.collect.max_train)),
        jax.device_put(datasets.with_capacity(dataset.validation, config.collect.max_validation)),
        config.fit,
        fit_key,
        lambda passes, losses: progress.update(passes, f"validation loss {float(np.mean(losses)):.4g}"),
    )


def _improve(
    config: Config,
    task: Task,
    state: State,
    dataset: Dataset,
    ensemble: Ensemble,
    iteration: int,
    progress: Progress,
    clock: Clock,
) -> tuple[Policy, Array, PhaseInfo]:
    rng, starts = rng_of(config.seed, iteration, Stage.IMPROVE), dataset.starts
    if config.imagine.start == "anywhere":
        starts = dataset.train.states
    if config.imagine.start == "reset":
        starts = real.reset_states(task, max(config.validate.starts, phase.rollouts(config, task)), rng)
    return phase.improve(
        config,
        task,
        ensemble,
        gaussian.reset_std(state.policy, config.policy.initial_std),
        state.baseline,
        starts,
        rng,
        key_of(config.seed, iteration, Stage.IMPROVE),
        clock,
        lambda updates, accepted, value: progress.update(updates, f"accepted {accepted}, imagined return {value:.2f}"),
        lambda policy: float(np.mean(evaluate(config, task, policy, iteration))),
    )


def _logged(config: Config, task: Task) -> Dataset:
    """The dataset before the first iteration: what was logged elsewhere, or nothing."""
    nothing = datasets.empty(task.state_size, task.action_size, len(task.learned))
    if config.data is None:
        if config.real_steps == 0:
            raise ConfigError("real_steps: expected at least 1 without logged transitions to learn from (data), got 0")
        return nothing
    rng = rng_of(config.seed, 0, Stage.COLLECT)
    return datasets.add(nothing, logged.load(config.data, task), config.collect, rng, task.learned)


def task_for(config: Config) -> Task:
    """The config's task, its formulas left out where they are to be learned."""
    task = get_task(config.task)
    return without_formulas(task) if config.learn_reward else task


def evaluate(config: Config, task: Task, policy: Policy, iteration: int) -> np.ndarray:
    """Real returns [config.evaluation_episodes] of the deterministic policy: a record, never used to learn."""
    seed = int(rng_of(config.seed, iteration, Stage.EVALUATE).integers(2**31))
    return real.evaluate(task, partial(gaussian.mean, _host(policy)), config.evaluation_episodes, seed)


def _perturbed(policy: Policy, previous: Policy, scale: float, rng: np.random.Generator) -> real.Act:
    """The mean action of the policy with its parameters perturbed (paper, appendix A.1.1)."""

    def noisy(now: np.ndarray, before: np.ndarray) -> np.ndarray:
        return now + scale * np.abs(now - before) * rng.standard_normal(now.shape)

    perturbed = policy._replace(layers=jax.tree.map(noisy, policy.layers, previous.layers))
    return partial(gaussian.mean, perturbed)


def _row(
    config: Config,
    state: State,
    returns: np.ndarray,
    collected: float,
    fitted: FitInfo,
    improved: PhaseInfo,
    clock: Clock,
) -> Row:
    imagined = float(np.mean(improved.values))
    losses = np.asarray(fitted.validation_loss)
    return {
        "iteration": state.iteration,
        "real_steps": state.real_steps,
        "return_real": float(np.mean(returns)),
        "return_real_std": float(np.std(returns)),
        "return_collected": collected,
        "return_imagined": imagined,
        # What shorter episodes earn cannot be compared.
        "gap": math.nan if config.imagine.horizon else imagined - float(np.mean(returns)),
        **{f"validation_loss_{k}": float(loss) for k, loss in enumerate(losses)},
        "train_loss": float(np.mean(fitted.train_loss)),
        "fit_passes": fitted.passes,
        "updates": improved.updates,
        "accepted_updates": improved.accepted_updates,
        "rejected_steps": improved.rejected_steps,
        "validations": improved.validations,
        "fraction_improved": improved.fraction_improved,
        "kl": improved.kl,
        "mean_std": float(np.mean(np.exp(np.asarray(state.policy.log_std)))),
        "diverged": improved.diverged,
        **clock.row(),
    }


def _fresh_networks(config: Config, task: Task, key: Array) -> Networks:
    e = config.ensemble
    return ensembles.init(key, e.members, task.state_size, task.action_size, e.hidden, len(task.learned))


def _host(policy: Policy) -> Policy:
    return jax.tree.map(np.asarray, policy)
