"""The policy phase: improve in blocks of updates, validate each block, stop when the ensemble disagrees.

The paper's Algorithm 2, lines 6 to 10 (section 5, "Policy Optimization" and "Policy Validation").
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from metrpo import devices
from metrpo.config import Config
from metrpo.model.ensemble import Ensemble, with_products
from metrpo.model.imagine import ImagineInfo, imagine, returns_per_model
from metrpo.policy import advantage, gaussian, trpo
from metrpo.policy.gaussian import Policy
from metrpo.policy.validate import RULES
from metrpo.types import Array
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
    """Updates that the line search rejected."""
    validations: int
    fraction_improved: float
    """Mean over the validations."""
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
) -> tuple[Policy, Array, PhaseInfo]:
    """Improves `policy` by TRPO in the ensemble and returns the last accepted policy, the baseline and what happened.

    Updates come in blocks of `config.validate.every`, each validated on the same start states. Imagined episodes start
    in states drawn from `pool` [E, S] by `rng`; `on_validation(updates, updates accepted, value)` follows every one.
    """
    rule = RULES[config.validate.rule]
    ensemble = ensemble._replace(networks=with_products(ensemble.networks, config.imagine.products))
    fixed_starts = pool[rng.integers(len(pool), size=config.validate.starts)]
    accepted, reference = policy, values_of(task, ensemble, policy, fixed_starts)
    updates = accepted_at = 0
    infos: list[tuple[trpo.ImproveInfo, ImagineInfo]] = []
    fractions: list[float] = []
    while updates - accepted_at < config.validate.patience and updates < config.validate.max_updates:
        block = min(config.validate.every, config.validate.max_updates - updates)
        starts = pool[rng.integers(len(pool), size=(block, rollouts(config, task)))]
        policy, baseline, info = _updates(
            task, config, ensemble, policy, baseline, starts, jax.random.fold_in(key, updates)
        )
        infos.append(jax.device_get(info))
        updates += block
        with clock("validate"):
            values = values_of(task, ensemble, policy, fixed_starts)
        verdict = rule(values, reference, config.validate)
        fractions.append(verdict.fraction_improved)
        if verdict.accepted:
            accepted, reference, accepted_at = policy, values, updates
        on_validation(updates, accepted_at, float(np.mean(reference)))
    improve_info, imagine_info = jax.tree.map(lambda *xs: np.concatenate(xs), *infos)
    return (
        accepted,
        baseline,
        PhaseInfo(
            values=reference,
            updates=updates,
            accepted_updates=accepted_at,
            rejected_steps=int(np.sum(~improve_info.accepted)),
            validations=len(fractions),
            fraction_improved=float(np.mean(fractions)),
            kl=float(np.mean(improve_info.kl)),
            diverged=float(np.mean(imagine_info.diverged)),
        ),
    )


def rollouts(config: Config, task: Task) -> int:
    """Imagined episodes per update: enough for `imagine.steps` steps."""
    return -(-config.imagine.steps // task.horizon)


@partial(jax.jit, static_argnames=("task", "config", "mesh"))
def _compiled_updates(
    task: Task,
    config: Config,
    mesh: Mesh,
    ensemble: Ensemble,
    policy: Policy,
    baseline: Array,
    starts: Array,
    keys: Array,
) -> tuple[Policy, Array, tuple[trpo.ImproveInfo, ImagineInfo]]:
    """Policy updates in one compiled call, one for each batch of start states [updates, N, S], shared by `mesh`."""

    def updates(
        ensemble: Ensemble, policy: Policy, baseline: Array, starts: Array, keys: Array
    ) -> tuple[Policy, Array, tuple[trpo.ImproveInfo, ImagineInfo]]:
        def update(
            carry: tuple[Policy, Array], given: tuple[Array, Array]
        ) -> tuple[tuple[Policy, Array], tuple[trpo.ImproveInfo, ImagineInfo]]:
            (policy, baseline), (starts, key) = carry, given
            rollouts, imagined = imagine(
                ensemble,
                partial(gaussian.sample, policy),
                task.reward,
                task.terminated,
                starts,
                task.horizon,
                key,
                config.imagine.sampling,
                AXIS,
            )
            a = config.advantage
            advantages, baseline = advantage.advantages_and_baseline(
                rollouts, baseline, a.discount, a.gae_lambda, a.ridge, AXIS
            )
            batch = trpo.Batch(rollouts.states, rollouts.actions, advantages, rollouts.mask)
            # Episode by episode: every n-th step is then one of every episode, whatever their number.
            batch = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), batch)
            policy, improved = trpo.improve(policy, batch, config.trpo, AXIS)
            return (policy, baseline), (improved, imagined)

        (policy, baseline), infos = jax.lax.scan(update, (policy, baseline), (starts, keys))
        return policy, baseline, infos

    same = PartitionSpec()
    return jax.shard_map(
        updates,
        mesh=mesh,
        in_specs=(same, same, same, PartitionSpec(None, AXIS), same),
        out_specs=same,
        check_vma=False,
    )(ensemble, policy, baseline, starts, keys)


def _updates(
    task: Task, config: Config, ensemble: Ensemble, policy: Policy, baseline: Array, starts: np.ndarray, key: Array
) -> tuple[Policy, Array, tuple[trpo.ImproveInfo, ImagineInfo]]:
    # What cannot change the compiled code (seed, budget, ...) must not cause a compilation: it is set to a constant.
    relevant = Config(task=task.name, imagine=config.imagine, advantage=config.advantage, trpo=config.trpo)
    mesh, keys = devices.mesh(starts.shape[1], AXIS), jax.random.split(key, len(starts))
    ensemble, policy, baseline = devices.copied((ensemble, policy, baseline), mesh)
    return _compiled_updates(task, relevant, mesh, ensemble, policy, baseline, starts, keys)


@partial(jax.jit, static_argnames=("task", "mesh"))
def _compiled_validate(task: Task, mesh: Mesh, ensemble: Ensemble, policy: Policy, starts: Array) -> Array:
    def values(ensemble: Ensemble, policy: Policy, starts: Array) -> Array:
        mine = returns_per_model(
            ensemble, partial(gaussian.mean, policy), task.reward, task.terminated, starts, task.horizon
        )
        return jax.lax.pmean(mine, AXIS)

    same = PartitionSpec()
    return jax.shard_map(
        values, mesh=mesh, in_specs=(same, same, PartitionSpec(AXIS)), out_specs=same, check_vma=False
    )(ensemble, policy, starts)


def values_of(task: Task, ensemble: Ensemble, policy: Policy, starts: np.ndarray) -> np.ndarray:
    """[K]: mean return of the deterministic policy from `starts` [N, S] in each model alone."""
    mesh = devices.mesh(len(starts), AXIS)
    ensemble, policy = devices.copied((ensemble, policy), mesh)
    return np.asarray(_compiled_validate(task, mesh, ensemble, policy, starts))
