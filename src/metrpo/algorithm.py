"""The loop: model-ensemble trust-region policy optimization (the paper's Algorithm 2).

    repeat:
        collect   real episodes with the policy, add them to the dataset        stages/real_steps.py
        fit       every model of the ensemble to the dataset                    stages/ensemble_fit.py
        repeat:
            imagine   rollouts through the ensemble with the policy             model/imagine.py
            improve   the policy on them, by TRPO                               policy/improvers/
            validate  the policy in each model                                  policy/stopping.py
        until the models no longer agree that it improves
        prove     it in a few real episodes, go back if it earns less           stages/proven.py
    until the budget is spent

`step` is one turn of the outer loop and reads like it; `metrpo.training` repeats it until the budget is spent.
"""

from __future__ import annotations

from functools import partial

import jax

from metrpo import scales
from metrpo.config import Config
from metrpo.console.progress import SILENT, Progress
from metrpo.errors import ConfigError
from metrpo.finite import require_finite
from metrpo.policy.inputs import folded
from metrpo.run.clock import Clock
from metrpo.run.metrics import Row
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.ensemble_fit import fit_ensemble, fresh_networks
from metrpo.stages.log import Log, Unkept, left_out
from metrpo.stages.proven import prove, settle, steps_kept_for_proof
from metrpo.stages.real_steps import collect
from metrpo.stages.records import NOTHING, Done, Real, record
from metrpo.stages.search_table import SEARCHES, improve_policy
from metrpo.stages.state import Proven, State, inputs_for
from metrpo.types import Episode
from metrpo.world import dataset as datasets
from metrpo.world import offline_data
from metrpo.world.dataset import Dataset
from metrpo.world.task import Task

__all__ = ["Log", "Row", "State", "collect", "init", "learn", "left_out", "step"]


def init(config: Config, task: Task) -> State:
    """The state before the first iteration.

    Raises `ConfigError` for settings that contradict each other, `TaskError` for offline data that do not fit.
    """
    if config.imagine.horizon is not None and config.advantage.discount == 1:
        # Undiscounted, a value that leans on itself grows without bound.
        raise ConfigError("advantage.discount: expected less than 1 with imagine.horizon (0.99, say), got 1.0")
    if not task.playable and (config.validate.rule == "real" or config.imagine.start == "reset"):
        raise ConfigError(
            f"{task.name}: expected an environment for validate.rule real and imagine.start reset, got none"
        )
    policy_key, ensemble_key = jax.random.split(key_of(config.seed, 0, Stage.INIT))
    policy, baseline = SEARCHES[config.improver].fresh(config, task, policy_key)
    return State(
        iteration=0,
        real_steps=0,
        policy=policy,
        previous_policy=policy,
        networks=fresh_networks(config, task, ensemble_key),
        baseline=baseline,
        dataset=_logged(config, task),
        proven=Proven(policy, 0.0, 0.0, 0),
    )


def step(
    config: Config, task: Task, state: State, progress: Progress = SILENT, log: Log | None = None
) -> tuple[State, Row]:
    """One outer iteration: collect, fit, improve until the ensemble disagrees; and evaluate, for the record only."""
    clock, log = Clock(), log or Unkept()
    with clock("collect"):
        kept = steps_kept_for_proof(config, task, state.real_steps)
        episodes = collect(config, task, state, progress, log, kept=kept)
    real = Real(left_out(log), partial(prove, config, task, state, progress, log))
    return learn(config, task, state, episodes, progress, clock, real)


def learn(
    config: Config,
    task: Task,
    state: State,
    episodes: list[Episode],
    progress: Progress = SILENT,
    clock: Clock | None = None,
    real: Real = NOTHING,
) -> tuple[State, Row]:
    """The rest of an outer iteration: learns from `episodes` and all before them.

    What only records (diagnostics, evaluation) cannot fail: it is NaN then, with a warning.

    Raises `DivergedError` where what is learned is not finite and cannot be recovered.
    """
    iteration = state.iteration + 1
    clock = clock or Clock()
    state, steps = _with_data(config, task, state, episodes), sum(len(e.rewards) for e in episodes)
    with clock("fit"):
        progress.stage("fit", None)
        ensemble, fitted = fit_ensemble(config, task, state.networks, state.dataset, iteration, progress, steps)
        require_finite("fit", iteration, "start anew with a lower fit.learning_rate", **ensemble._asdict())
    with clock("improve"):
        policy, baseline, improved = improve_policy(config, task, state, ensemble, progress, clock, steps)
        advice = "training cannot continue from this state: use smaller steps or start anew"
        require_finite("improve", iteration, advice, policy=policy, baseline=baseline)
    candidate = State(
        iteration=iteration,
        real_steps=state.real_steps + steps,
        policy=policy,
        previous_policy=state.policy if improved.accepted_updates else state.previous_policy,
        networks=ensemble.networks,
        baseline=baseline,
        dataset=state.dataset,
        proven=state.proven,
    )
    with clock("collect"):
        following, verdict = settle(config, task, state, candidate, real.prove(candidate))
    with clock("evaluate"):
        progress.stage("evaluate", config.evaluation_episodes)
        row = record(config, task, following, Done(episodes, real.failed, ensemble, fitted, improved, verdict))
    return following, row | clock.row()


def _with_data(config: Config, task: Task, state: State, episodes: list[Episode]) -> State:
    """The state with the episodes in its dataset; a fresh policy takes its scales from the first ones."""
    iteration = state.iteration + 1
    rng = rng_of(config.seed, iteration, Stage.SPLIT)
    dataset = datasets.add(state.dataset, episodes, config.collect, rng, task.learned, task.carried)
    require_finite("collect", iteration, "leave out the episode that holds it", dataset=dataset)
    state = state._replace(dataset=dataset)
    if state.iteration == 0:
        scales.warn(config, task, dataset, episodes)
        if inputs := inputs_for(config, task, dataset):
            # A fresh policy's weights expect normalised states; only the first data gives the scales.
            state = state._replace(policy=folded(state.policy, inputs))
    return state


def _logged(config: Config, task: Task) -> Dataset:
    """The dataset before the first iteration: offline data, or nothing."""
    nothing = datasets.empty(task.state_size, task.action_size, task.predicted)
    if config.data is None:
        if config.real_steps == 0:
            raise ConfigError("real_steps: expected at least 1 without offline data (data), got 0")
        return nothing
    rng = rng_of(config.seed, 0, Stage.SPLIT)
    return datasets.add(nothing, offline_data.load(config.data, task), config.collect, rng, task.learned, task.carried)
