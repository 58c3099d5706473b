"""The actor-critic's phase: states that the policy reaches in the ensemble, and blocks of updates from these.

In place of `metrpo.policy_phase` where `improver` is "actor-critic".
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from metrpo import devices
from metrpo.devices import FIRST, SECOND, WHOLE, share_of, sharers
from metrpo.model.imagine import ImagineInfo, Simulator, imagine
from metrpo.policy import squashed
from metrpo.policy.improvers.actor_critic import Learner, Steps, UpdateInfo, UpdateSettings, update
from metrpo.policy.inputs import normalised
from metrpo.policy_phase import simulate
from metrpo.types import Array

_BRANCH, _DRAW = 2**31 - 4, 2**31 - 5
"""Derive keys that are none of an update's."""


class Pool(NamedTuple):
    """States to start from."""

    states: Array
    """[n, S]"""
    mask: Array
    """[n], 1 where a state is one."""


def branches(settings: UpdateSettings, updates: int) -> int:
    """Imagined episodes that give `updates` updates as many states as they start in, each once on average."""
    a = settings.actor_critic
    return -(-updates * a.batch_size // a.branch_steps)


def run_block(
    settings: UpdateSettings, simulator: Simulator, learner: Learner, starts: np.ndarray, real: Steps, keys: Array
) -> tuple[Learner, tuple[UpdateInfo, ImagineInfo]]:
    """An update for each of `keys` [U], in one compiled call.

    Each starts in states that the actor reaches from `starts` [N, S], and learns from its own of the `real` steps
    [U, M, ...].
    """
    sizes = len(starts), settings.actor_critic.batch_size, settings.actor_critic.real_batch
    mesh = devices.mesh(int(np.gcd.reduce(sizes)))
    simulator, learner = devices.copied((simulator, learner), mesh)
    return _compiled_block(settings, mesh, simulator, learner, starts, real, keys)


@partial(jax.jit, static_argnames=("settings", "mesh"))
def _compiled_block(
    settings: UpdateSettings,
    mesh: Mesh,
    simulator: Simulator,
    learner: Learner,
    starts: Array,
    real: Steps,
    keys: Array,
) -> tuple[Learner, tuple[UpdateInfo, ImagineInfo]]:
    a = settings.actor_critic

    def block(
        models: Simulator, learner: Learner, starts: Array, real: Steps, keys: Array
    ) -> tuple[Learner, tuple[UpdateInfo, ImagineInfo]]:
        beyond = dataclasses.replace(models, horizon=a.branch_steps)
        within = dataclasses.replace(models, horizon=a.horizon)
        pool = reached(beyond, learner, starts, jax.random.fold_in(keys[0], _BRANCH))

        def one(learner: Learner, given: tuple[Array, Steps]) -> tuple[Learner, tuple[UpdateInfo, ImagineInfo]]:
            key, steps = given
            batch = drawn(pool, a.batch_size // sharers(), share_of(jax.random.fold_in(key, _DRAW)))
            learner, info, imagined = update(settings, partial(simulate, within), learner, batch, steps, key)
            return learner, (info, imagined)

        return jax.lax.scan(one, learner, (keys, real))

    spread = devices.spread(block, mesh, (WHOLE, WHOLE, FIRST, SECOND, WHOLE), WHOLE)
    after: tuple[Learner, tuple[UpdateInfo, ImagineInfo]] = spread(simulator, learner, starts, real, keys)
    return after


def reached(simulator: Simulator, learner: Learner, starts: Array, key: Array) -> Pool:
    """The states of imagined episodes from `starts` [N, S], these included, as far as episodes go on."""

    def act(states: Array, key: Array) -> Array:
        return squashed.sample(learner.actor, normalised(simulator.inputs, states), key)[0]

    rollouts, _ = imagine(simulator, act, starts, key)
    mask = rollouts.mask
    if rollouts.trusted is not None:  # the state in which an episode comes to stand counts once
        mask = mask.at[1:].multiply(rollouts.trusted[:-1])
    return Pool(rollouts.states.reshape(-1, starts.shape[-1]), mask.reshape(-1))


def drawn(pool: Pool, count: int, key: Array) -> Array:
    """States [count, S] of the pool, with replacement; its first one where it has none."""
    sums = jnp.cumsum(pool.mask)
    # The r-th state that counts, r uniform: where the sums first pass r.
    index = jnp.searchsorted(sums, jax.random.uniform(key, (count,)) * sums[-1], side="right")
    return jnp.take(pool.states, index, axis=0, mode="clip")
