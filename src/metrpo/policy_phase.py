"""The policy phase: improve in blocks of updates, validate each block, stop when the ensemble disagrees.

The paper's Algorithm 2, lines 6 to 10 (section 5, "Policy Optimization" and "Policy Validation").
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from metrpo import devices
from metrpo.config import Config, PolicyConfig
from metrpo.model.ensemble import Ensemble, with_products
from metrpo.model.imagine import ImagineInfo, imagine, returns_per_model
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.batch import ImproveInfo
from metrpo.policy.improvers.table import IMPROVERS, Baseline, Memory, init_memory, values_at_cut
from metrpo.policy.inputs import Inputs, folded, normalised, unfolded
from metrpo.policy.stopping import RULES, Evidence, improved
from metrpo.types import Act, Array, Trajectories
from metrpo.world.task import Task

AXIS = "rollouts"
"""Imagined rollouts are what devices share."""


class PhaseInfo(NamedTuple):
    """What one policy phase did."""

    values: np.ndarray
    """[K], each model's value of the accepted policy."""
    updates: int
    accepted_updates: int
    """Updates up to the accepted policy."""
    rejected_steps: int
    """Updates that moved nothing: rejected by the line search, or with a gradient that was not finite."""
    validations: int
    improved: np.ndarray
    """[K], share of the validations in which each model values the policy above the accepted one, whatever the rule."""
    kl: float
    """Mean over the updates."""
    diverged: float
    """Share of imagined rollouts, mean over the updates."""


def improve(
    config: Config,
    task: Task,
    ensemble: Ensemble,
    policy: Policy,
    baseline: Array,
    pool: np.ndarray,
    rng: np.random.Generator,
    key: Array,
    clock: Callable[[str], AbstractContextManager[None]],
    on_validation: Callable[[int, int, float], None],
    oracle: Callable[[Policy], float],
    inputs: Inputs | None = None,
) -> tuple[Policy, Array, PhaseInfo]:
    """Improves `policy` in the ensemble and returns the last accepted policy, the baseline and what happened.

    Updates come in blocks of `config.validate.every`, each validated on the same start states. Imagined episodes start
    in states drawn from `pool` [E, S] by `rng`; `on_validation(updates, updates accepted, value)` follows every one.
    `oracle` gives a policy's real return, for the rule that asks for it.
    """
    rule = RULES[config.validate.rule]
    ensemble = ensemble._replace(networks=with_products(ensemble.networks, config.imagine.products))
    fixed_starts = pool[rng.integers(len(pool), size=config.validate.starts)]

    config = _cut_short(config, task)

    def raw(policy: Policy) -> Policy:
        return policy if inputs is None else folded(policy, inputs)

    def valued(policy: Policy) -> np.ndarray:
        return values_of(task, ensemble, policy, fixed_starts, config, inputs, memory.baseline)

    def evidence(policy: Policy, imagined: np.ndarray) -> Evidence:
        return Evidence(valued(policy), imagined, cache(lambda: oracle(raw(policy))))

    policy = policy if inputs is None else unfolded(policy, inputs)
    memory = init_memory(config, policy, baseline)
    accepted, reference, kept = policy, evidence(policy, np.array([-np.inf])), memory.baseline
    updates = accepted_at = 0
    infos: list[tuple[ImproveInfo, ImagineInfo]] = []
    agreed: list[np.ndarray] = []
    while updates - accepted_at < config.validate.patience and updates < config.validate.max_updates:
        block = min(config.validate.every, config.validate.max_updates - updates)
        starts = pool[rng.integers(len(pool), size=(block, rollouts(config, task)))]
        policy, memory, info = _updates(
            task, config, ensemble, policy, memory, starts, jax.random.fold_in(key, updates), inputs
        )
        infos.append(jax.device_get(info))
        updates += block
        with clock("validate"):
            found = evidence(policy, _last_return(infos[-1][1]))
            if config.imagine.horizon is not None:
                # The value at the cut has changed with the baseline: both policies are held against the new one.
                reference = reference._replace(values=valued(accepted))
        verdict = rule.decide(rule.evidence(found), rule.evidence(reference), config.validate)
        agreed.append(improved(found.values, reference.values))
        if verdict:
            accepted, reference, kept, accepted_at = policy, found, memory.baseline, updates
        on_validation(updates, accepted_at, float(np.mean(reference.values)))
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


def rollouts(config: Config, task: Task) -> int:
    """Imagined episodes per update: enough for `imagine.steps` steps."""
    return -(-config.imagine.steps // imagined_horizon(config, task))


def imagined_horizon(config: Config, task: Task) -> int:
    """Steps of an imagined episode."""
    return min(config.imagine.horizon or task.horizon, task.horizon)


def is_cut(config: Config, task: Task) -> bool:
    """Whether imagined episodes end before the task's do, and are valued there."""
    return imagined_horizon(config, task) < task.horizon


def _cut_short(config: Config, task: Task) -> Config:
    """The config with an imagined horizon only where it cuts episodes: nothing follows a true end."""
    horizon = imagined_horizon(config, task) if is_cut(config, task) else None
    return replace(config, imagine=replace(config.imagine, horizon=horizon))


def _last_return(imagined: ImagineInfo) -> np.ndarray:
    """[1]: of the last update's rollouts; where all of them diverged NaN, which is never an improvement."""
    return np.where(imagined.diverged[-1:] < 1, imagined.mean_return[-1:], np.nan)


@partial(jax.jit, static_argnames=("task", "config", "mesh"))
def _compiled_updates(
    task: Task,
    config: Config,
    mesh: Mesh,
    ensemble: Ensemble,
    policy: Policy,
    memory: Memory,
    starts: Array,
    keys: Array,
    inputs: Inputs | None,
) -> tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]]:
    """Policy updates in one compiled call, one for each batch of start states [updates, N, S], shared by `mesh`."""
    improver = IMPROVERS[config.improver]

    def updates(
        ensemble: Ensemble, policy: Policy, memory: Memory, starts: Array, keys: Array, inputs: Inputs | None
    ) -> tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]]:
        def simulate(act: Act, starts: Array, key: Array) -> tuple[Trajectories, ImagineInfo]:
            ends, sampling = task.terminated, config.imagine.sampling
            curiosity, horizon = config.imagine.disagreement, imagined_horizon(config, task)
            rollouts, info = imagine(
                ensemble, _seeing(act, inputs), task.reward, ends, starts, horizon, key, sampling, AXIS, curiosity
            )
            if inputs is not None:
                states, last = (normalised(inputs, x) for x in (rollouts.states, rollouts.last))
                rollouts = rollouts._replace(states=states, last=last)
            return rollouts, info

        def update(
            carry: tuple[Policy, Memory], given: tuple[Array, Array]
        ) -> tuple[tuple[Policy, Memory], tuple[ImproveInfo, ImagineInfo]]:
            policy, memory, infos = improver(config, simulate, *carry, *given, AXIS)
            return (policy, memory), infos

        (policy, memory), infos = jax.lax.scan(update, (policy, memory), (starts, keys))
        return policy, memory, infos

    same = PartitionSpec()
    return jax.shard_map(
        updates,
        mesh=mesh,
        in_specs=(same, same, same, PartitionSpec(None, AXIS), same, same),
        out_specs=same,
        check_vma=False,
    )(ensemble, policy, memory, starts, keys, inputs)


def _seeing(act: Act, inputs: Inputs | None) -> Act:
    return act if inputs is None else lambda states, key: act(normalised(inputs, states), key)


def _updates(
    task: Task,
    config: Config,
    ensemble: Ensemble,
    policy: Policy,
    memory: Memory,
    starts: np.ndarray,
    key: Array,
    inputs: Inputs | None = None,
) -> tuple[Policy, Memory, tuple[ImproveInfo, ImagineInfo]]:
    # What cannot change the compiled code (seed, budget, ...) must not cause a compilation: it is set to a constant.
    relevant = Config(
        task=task.name,
        improver=config.improver,
        imagine=config.imagine,
        policy=PolicyConfig(mean_penalty=config.policy.mean_penalty),
        advantage=config.advantage,
        trpo=config.trpo,
        gradient=config.gradient,
        ppo=config.ppo,
    )
    mesh, keys = devices.mesh(starts.shape[1], AXIS), jax.random.split(key, len(starts))
    ensemble, policy, memory, inputs = devices.copied((ensemble, policy, memory, inputs), mesh)
    return _compiled_updates(task, relevant, mesh, ensemble, policy, memory, starts, keys, inputs)


@partial(jax.jit, static_argnames=("task", "mesh", "config"))
def _compiled_validate(
    task: Task,
    mesh: Mesh,
    config: Config,
    ensemble: Ensemble,
    policy: Policy,
    starts: Array,
    inputs: Inputs | None,
    baseline: Baseline,
) -> Array:
    horizon, curiosity = imagined_horizon(config, task), config.imagine.disagreement

    def values(ensemble: Ensemble, policy: Policy, starts: Array, inputs: Inputs | None, baseline: Baseline) -> Array:
        def seen(states: Array) -> Array:
            return states if inputs is None else normalised(inputs, states)

        def act(states: Array) -> Array:
            return gaussian.mean(policy, seen(states))

        def after(states: Array) -> Array:
            flat = seen(states).reshape(-1, states.shape[-1])
            return values_at_cut(config, baseline, flat).reshape(states.shape[:-1])

        # Whole episodes are judged by what they earn, undiscounted; cut ones by what the updates improve.
        cut = (config.advantage.discount, after) if is_cut(config, task) else ()
        mine = returns_per_model(ensemble, act, task.reward, task.terminated, starts, horizon, curiosity, *cut)
        return jax.lax.pmean(mine, AXIS)

    same = PartitionSpec()
    return jax.shard_map(
        values, mesh=mesh, in_specs=(same, same, PartitionSpec(AXIS), same, same), out_specs=same, check_vma=False
    )(ensemble, policy, starts, inputs, baseline)


def values_of(
    task: Task,
    ensemble: Ensemble,
    policy: Policy,
    starts: np.ndarray,
    config: Config | None = None,
    inputs: Inputs | None = None,
    baseline: Baseline = None,
) -> np.ndarray:
    """[K]: mean return of the deterministic policy from `starts` [N, S] in each model alone, as `config` imagines.

    Undiscounted over the task's horizon; where the config cuts episodes off before, discounted, with the value that
    `baseline` gives to their last state. Rewards hold the models' disagreement where the config asks for it.
    """
    config = config or Config(task=task.name)
    relevant = Config(task=task.name, imagine=config.imagine, advantage=config.advantage)
    mesh = devices.mesh(len(starts), AXIS)
    given = devices.copied((ensemble, policy, inputs, baseline), mesh)
    ensemble, policy, inputs, baseline = given
    return np.asarray(_compiled_validate(task, mesh, relevant, ensemble, policy, starts, inputs, baseline))
