"""The policy phase: improve in blocks of updates, validate each block, stop when the ensemble disagrees.

The paper's Algorithm 2, lines 6 to 10 (section 5, "Policy Optimization" and "Policy Validation").
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float, Key

from metrpo import devices
from metrpo.config import AdvantageConfig, Config
from metrpo.devices import FIRST, SECOND, WHOLE
from metrpo.model.ensemble import Ensemble, with_products
from metrpo.model.imagine import ImagineInfo, Simulator, imagine, returns_per_model
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.batch import ImproveInfo
from metrpo.policy.improvers.improver_table import IMPROVERS, Memory, init_memory
from metrpo.policy.improvers.settings import PhaseSettings
from metrpo.policy.inputs import Inputs, folded, normalised, unfolded
from metrpo.policy.stopping import RULES, Evidence, improved
from metrpo.policy.value.value_table import VALUE_FUNCTIONS, Baseline
from metrpo.types import Array, SampleActions, Trajectories
from metrpo.world.task import Task


class PhaseInfo(NamedTuple):
    """What one policy phase did."""

    values: Float[np.ndarray, "K"]
    """Each model's value of the accepted policy."""
    updates: int
    accepted_updates: int
    """Updates up to the accepted policy."""
    rejected_steps: int
    """Updates that moved nothing: rejected by the line search, or with a gradient that was not finite."""
    validations: int
    improved: Float[np.ndarray, "K"]
    """Share of the validations in which each model values the policy above the accepted one, whatever the rule."""
    kl: float
    """Mean over the updates."""
    diverged: float
    """Share of imagined rollouts, mean over the updates."""
    more: Mapping[str, float] = MappingProxyType({})
    """What else is to stand in the row of metrics."""


class Starts(NamedTuple):
    """Where imagined episodes start."""

    pool: Float[np.ndarray, "E S"]
    rng: np.random.Generator

    def draw(self, *shape: int) -> Float[np.ndarray, "*shape S"]:
        """So many, with replacement."""
        return self.pool[self.rng.integers(len(self.pool), size=shape)]


class Hooks(NamedTuple):
    """What a phase asks of, and tells, those around it."""

    clock: Callable[[str], AbstractContextManager[None]] = lambda stage: nullcontext()
    """Takes the time of a stage."""
    on_validation: Callable[[int, int, float], None] = lambda updates, accepted, value: None
    """(updates, updates accepted, value of the accepted policy), after every validation."""
    oracle: Callable[[Policy], float] = lambda policy: np.nan
    """A policy's real return, for the rule that asks for it."""


def improve(
    config: Config,
    simulator: Simulator,
    policy: Policy,
    baseline: Baseline,
    starts: Starts,
    key: Key[Array, ""],
    hooks: Hooks,
) -> tuple[Policy, Baseline, PhaseInfo]:
    """Improves `policy` in the simulator and returns the last accepted policy, the baseline and what happened.

    Updates come in blocks of `config.validate.every`, each validated on the same start states.
    """
    rule, settings, inputs = RULES[config.validate.rule], PhaseSettings.of(config, simulator.cut), simulator.inputs
    fixed_starts = starts.draw(config.validate.starts)
    rollouts = rollouts_for(config.imagine.steps, simulator.horizon)

    def raw(policy: Policy) -> Policy:
        return policy if inputs is None else folded(policy, inputs)

    def valued(policy: Policy) -> Float[np.ndarray, "K"]:
        return values_of(simulator, policy, fixed_starts, settings.advantage, memory.baseline)

    def evidence(policy: Policy, imagined: Float[np.ndarray, "1"]) -> Evidence:
        return Evidence(valued(policy), imagined, cache(lambda: hooks.oracle(raw(policy))))

    policy = policy if inputs is None else unfolded(policy, inputs)
    memory = init_memory(settings, policy, baseline)
    accepted, reference, kept = policy, evidence(policy, np.array([-np.inf])), memory.baseline
    updates = accepted_at = 0
    infos: list[tuple[ImproveInfo, ImagineInfo]] = []
    agreed: list[np.ndarray] = []
    while updates - accepted_at < config.validate.patience and updates < config.validate.max_updates:
        block = min(config.validate.every, config.validate.max_updates - updates)
        batches = starts.draw(block, rollouts)
        policy, memory, info = run_updates(
            settings, simulator, policy, memory, batches, jax.random.fold_in(key, updates)
        )
        infos.append(jax.device_get(info))
        updates += block
        with hooks.clock("validate"):
            found = evidence(policy, _last_return(infos[-1][1]))
            if simulator.cut:
                # The value at the cut has changed with the baseline: both policies are held against the new one.
                reference = reference._replace(values=valued(accepted))
        verdict = rule.decide(rule.evidence(found), rule.evidence(reference), config.validate)
        agreed.append(improved(found.values, reference.values))
        if verdict:
            accepted, reference, kept, accepted_at = policy, found, memory.baseline, updates
        hooks.on_validation(updates, accepted_at, float(np.mean(reference.values)))
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(kept))):
        kept = memory.baseline  # what the run was resumed with is no place to go back to
    improve_info, imagine_info = jax.tree.map(lambda *xs: np.concatenate(xs), *infos)
    return (
        raw(accepted),
        kept,
        PhaseInfo(
            values=reference.values,
            updates=updates,
            accepted_updates=accepted_at,
            rejected_steps=int(np.sum(~improve_info.accepted)),
            validations=len(agreed),
            improved=np.mean(agreed, axis=0),
            kl=float(np.mean(improve_info.kl)),
            diverged=float(np.mean(imagine_info.diverged)),
        ),
    )


def simulator_of(config: Config, task: Task, ensemble: Ensemble, inputs: Inputs | None = None) -> Simulator:
    """The simulator that `config` makes of a fitted ensemble and the task's formulas."""
    horizon = imagined_horizon(config, task)
    return Simulator(
        ensemble._replace(networks=with_products(ensemble.networks, config.imagine.products)),
        task.reward,
        task.terminated,
        horizon,
        sampling=config.imagine.sampling,
        disagreement=config.imagine.disagreement,
        cut=horizon < task.horizon,
        inputs=inputs,
        limits=task.limits,
    )


def imagined_horizon(config: Config, task: Task) -> int:
    """Steps of an imagined episode."""
    return min(config.imagine.horizon or task.horizon, task.horizon)


def rollouts_for(steps: int, horizon: int) -> int:
    """Imagined episodes of `horizon` steps per update: enough for `steps` steps."""
    return -(-steps // horizon)


def _last_return(imagined: ImagineInfo) -> Float[np.ndarray, "1"]:
    """Of the last update's rollouts; where all of them diverged NaN, which is never an improvement."""
    return np.where(imagined.diverged[-1:] < 1, imagined.mean_return[-1:], np.nan)


def run_updates(
    settings: PhaseSettings,
    simulator: Simulator,
    policy: Policy,
    memory: Memory,
    starts: Float[Array, "updates N S"],
    key: Key[Array, ""],
) -> tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]]:
    """Policy updates in one compiled call, one for each batch of start states."""
    mesh, keys = devices.mesh(starts.shape[1]), jax.random.split(key, len(starts))
    simulator, policy, memory = devices.copied((simulator, policy, memory), mesh)
    return _compiled_updates(settings, mesh, simulator, policy, memory, starts, keys)


@partial(jax.jit, static_argnames=("settings", "mesh"))
def _compiled_updates(
    settings: PhaseSettings,
    mesh: Mesh,
    simulator: Simulator,
    policy: Policy,
    memory: Memory,
    starts: Float[Array, "updates N S"],
    keys: Key[Array, "updates"],
) -> tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]]:
    improver = IMPROVERS[settings.improver]

    def updates(
        simulator: Simulator,
        policy: Policy,
        memory: Memory,
        starts: Float[Array, "updates N S"],
        keys: Key[Array, "updates"],
    ) -> tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]]:
        def update(
            carry: tuple[Policy, Memory], given: tuple[Float[Array, "N S"], Key[Array, ""]]
        ) -> tuple[tuple[Policy, Memory], tuple[ImproveInfo, ImagineInfo]]:
            policy, memory, infos = improver(settings, partial(simulate, simulator), *carry, *given)
            return (policy, memory), infos

        (policy, memory), infos = jax.lax.scan(update, (policy, memory), (starts, keys))
        return policy, memory, infos

    shared = devices.spread(updates, mesh, (WHOLE, WHOLE, WHOLE, SECOND, WHOLE), WHOLE)
    after: tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]] = shared(simulator, policy, memory, starts, keys)
    return after


def simulate(
    simulator: Simulator, act: SampleActions, starts: Float[Array, "N S"], key: Key[Array, ""]
) -> tuple[Trajectories, ImagineInfo]:
    """Imagined episodes as the policy sees them."""
    inputs = simulator.inputs
    rollouts, info = imagine(simulator, lambda states, key: act(normalised(inputs, states), key), starts, key)
    states, last = (normalised(inputs, x) for x in (rollouts.states, rollouts.last))
    return rollouts._replace(states=states, last=last), info


def values_of(
    simulator: Simulator,
    policy: Policy,
    starts: Float[Array, "N S"],
    advantage: AdvantageConfig | None = None,
    baseline: Baseline = None,
    key: Key[Array, ""] | None = None,
) -> Float[np.ndarray, "K"]:
    """Mean return of the deterministic policy from `starts` in each model alone.

    Undiscounted over the whole horizon; where the simulator cuts episodes off, discounted as `advantage` says, with the
    value that `baseline` gives to their last state. Probabilistic members predict with noise where there is a `key`.
    """
    mesh = devices.mesh(len(starts))
    simulator, policy, baseline = devices.copied((simulator, policy, baseline), mesh)
    return np.asarray(_compiled_values(advantage, mesh, simulator, policy, starts, baseline, key))


@partial(jax.jit, static_argnames=("advantage", "mesh"))
def _compiled_values(
    advantage: AdvantageConfig | None,
    mesh: Mesh,
    simulator: Simulator,
    policy: Policy,
    starts: Float[Array, "N S"],
    baseline: Baseline,
    key: Key[Array, ""] | None,
) -> Float[Array, "K"]:
    def values(
        simulator: Simulator,
        policy: Policy,
        starts: Float[Array, "N S"],
        baseline: Baseline,
        key: Key[Array, ""] | None,
    ) -> Float[Array, "K"]:
        seen = partial(normalised, simulator.inputs)

        def act(states: Float[Array, "K N S"]) -> Float[Array, "K N A"]:
            return gaussian.mean(policy, seen(states))

        def after(states: Float[Array, "K N S"]) -> Float[Array, "K N"]:
            assert advantage is not None
            flat = seen(states).reshape(-1, states.shape[-1])
            return VALUE_FUNCTIONS[advantage.baseline].at_cut(baseline, flat).reshape(states.shape[:-1])

        # Whole episodes are judged by what they earn, undiscounted; cut ones by what the updates improve.
        discount, what_follows = (advantage.discount, after) if simulator.cut and advantage is not None else (1.0, None)
        returns = returns_per_model(simulator, act, starts, discount, what_follows, key)
        return jax.lax.pmean(returns, devices.AXIS)

    spread = devices.spread(values, mesh, (WHOLE, WHOLE, FIRST, WHOLE, WHOLE), WHOLE)
    of_models: Float[Array, "K"] = spread(simulator, policy, starts, baseline, key)
    return of_models
