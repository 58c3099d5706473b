"""The ways to improve a policy in the ensemble, in one table: `IMPROVERS`.

An improver is (config, simulate, policy, memory, starts [N, S], key, axis) -> (policy, memory, infos): one policy
update on rollouts that `simulate` imagines from `starts`. With `axis`, `starts` are this device's share (see
`metrpo.devices`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from metrpo.config import Config
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers import bptt, ppo, trpo, vpg
from metrpo.policy.improvers.adam import init_moments
from metrpo.policy.improvers.batch import Batch, ImproveInfo
from metrpo.policy.value import linear, network
from metrpo.types import Act, Array, Simulate, Trajectories

Baseline = Any
"""Weights of the linear baseline [2S + 4], or a `value.Value`: `config.advantage.baseline` decides."""


class Memory(NamedTuple):
    """What an improver keeps from update to update."""

    baseline: Baseline
    """What values a state, fitted to the last batch."""
    moments: Any
    """Adam's; of improvers other than TRPO."""


_SHUFFLE, _VALUE = 2**31 - 1, 2**31 - 2
"""Derive keys that are none of the devices' (`metrpo.devices.share_of`)."""
Infos = tuple[ImproveInfo, Any]
"""Of the update, and of the rollouts it learned from."""
Improver = Callable[[Config, Simulate, Policy, Memory, Array, Array, str | None], tuple[Policy, Memory, Infos]]
Step = Callable[[Config, Policy, Any, Batch, Array, str | None], tuple[Policy, Any, ImproveInfo]]
"""(config, policy, moments, batch, key, axis) -> (policy, moments, info): a step of a score-function improver."""


def init_baseline(config: Config, state_size: int, key: Array) -> Baseline:
    """A baseline that predicts 0 everywhere."""
    if config.advantage.baseline == "network":
        return network.init(key, state_size, config.advantage)
    return linear.init(state_size)


def init_memory(config: Config, policy: Policy, baseline: Baseline) -> Memory:
    """The memory at the start of a policy phase: the baseline goes on, Adam starts afresh."""
    return Memory(baseline, () if config.improver == "trpo" else init_moments(policy, config.gradient))


def values_at_cut(config: Config, baseline: Baseline, states: Array) -> Array:
    """What `baseline` says of the states [N, S] in which imagined episodes are cut off, whatever the time: [N]."""
    if config.advantage.baseline == "network":
        return network.predict(baseline, network.inputs(states[None], timeless=True)[0])
    return linear.features(states[None], timeless=True)[0] @ baseline


def batch_of(
    config: Config, rollouts: Trajectories, baseline: Baseline, key: Array, axis: str | None = None
) -> tuple[Batch, Baseline]:
    """The rollouts [T, N] as a batch of T N steps with their advantages under `baseline`; and the baseline refitted.

    `key` is for the baseline that is fitted to minibatches.
    """
    a, cut = config.advantage, config.imagine.horizon is not None
    if a.baseline == "network":
        advantages, baseline = network.advantages_and_value(rollouts, baseline, a, key, axis, cut)
    else:
        advantages, baseline = linear.advantages_and_value(
            rollouts, baseline, a.discount, a.gae_lambda, a.ridge, axis, cut
        )
    batch = Batch(rollouts.states, rollouts.actions, advantages, rollouts.mask)
    # Episode by episode: every n-th step is then one of every episode, whatever their number.
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), batch), baseline


def _sound(new: Policy, improved: ImproveInfo, imagined: Any) -> Array:
    """Whether an update is to be made: accepted, finite, and learned from at least one step that counts."""
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((new, improved.kl))]
    return improved.accepted & (imagined.steps > 0) & jnp.all(jnp.array(finite))


def _where(made: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(partial(jnp.where, made), new, old)


def _reported(improved: ImproveInfo, made: Array) -> ImproveInfo:
    kl, improvement = (jnp.where(made, x, 0.0) for x in (improved.kl, improved.improvement))
    return improved._replace(kl=kl, improvement=improvement, accepted=made)


def _by_score_function(step: Step) -> Improver:
    """Learns from stochastic rollouts and their advantages; never asks the models for a gradient."""

    def update(
        config: Config, simulate: Simulate, policy: Policy, memory: Memory, starts: Array, key: Array, axis: str | None
    ) -> tuple[Policy, Memory, Infos]:
        rollouts, imagined = simulate(partial(gaussian.sample, policy), starts, key)
        batch, baseline = batch_of(config, rollouts, memory.baseline, jax.random.fold_in(key, _VALUE), axis)
        new, moments, improved = step(config, policy, memory.moments, batch, jax.random.fold_in(key, _SHUFFLE), axis)
        sound = _sound(new, improved, imagined)
        # A step that was rejected has been judged all the same: its rollouts fit the baseline, if there were any.
        kept = Memory(_where(imagined.steps > 0, baseline, memory.baseline), _where(sound, moments, memory.moments))
        return _where(sound, new, policy), kept, (_reported(improved, sound), imagined)

    return update


def _through_models(act: Callable[[Policy], Act]) -> Improver:
    """Follows the gradient of the imagined return itself."""

    def update(
        config: Config, simulate: Simulate, policy: Policy, memory: Memory, starts: Array, key: Array, axis: str | None
    ) -> tuple[Policy, Memory, Infos]:
        new, moments, (improved, imagined) = bptt.improve(
            policy, memory.moments, act, simulate, starts, config.gradient, key, axis
        )
        sound = _sound(new, improved, imagined)
        memory = memory._replace(moments=_where(sound, moments, memory.moments))
        return _where(sound, new, policy), memory, (_reported(improved, sound), imagined)

    return update


def _trpo(
    config: Config, policy: Policy, moments: Any, batch: Batch, key: Array, axis: str | None
) -> tuple[Policy, Any, ImproveInfo]:
    new, info = trpo.improve(policy, batch, config.trpo, axis, config.policy.mean_penalty)
    return new, moments, info


def _ppo(
    config: Config, policy: Policy, moments: Any, batch: Batch, key: Array, axis: str | None
) -> tuple[Policy, Any, ImproveInfo]:
    return ppo.improve(policy, moments, batch, config.ppo, config.gradient, key, axis, config.policy.mean_penalty)


def _vpg(
    config: Config, policy: Policy, moments: Any, batch: Batch, key: Array, axis: str | None
) -> tuple[Policy, Any, ImproveInfo]:
    return vpg.improve(policy, moments, batch, config.gradient, axis, config.policy.mean_penalty)


IMPROVERS: dict[str, Improver] = {
    "trpo": _by_score_function(_trpo),
    "ppo": _by_score_function(_ppo),
    "vpg": _by_score_function(_vpg),
    "bptt": _through_models(bptt.deterministic),
    "bptt-stochastic": _through_models(bptt.stochastic),
}
