"""The ways to improve a policy in the ensemble, in one table: `IMPROVERS`.

An improver is one policy update on rollouts that it imagines (`Improver`). Its batch may be one device's share of the
whole; means and sums over it are taken `metrpo.devices.across` all shares.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Key

from metrpo.config import AdvantageConfig
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers import bptt, ppo, trpo, vpg
from metrpo.policy.improvers.adam import init_moments
from metrpo.policy.improvers.batch import Batch, ImproveInfo
from metrpo.policy.improvers.settings import PhaseSettings
from metrpo.policy.value.value_table import VALUE_FUNCTIONS, Baseline
from metrpo.types import Array, SampleActions, Simulate, Trajectories


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


@runtime_checkable
class Improver(Protocol):
    """The signature of every improver."""

    def __call__(
        self,
        settings: PhaseSettings,
        simulate: Simulate,
        policy: Policy,
        memory: Memory,
        starts: Float[Array, "N S"],
        key: Key[Array, ""],
    ) -> tuple[Policy, Memory, Infos]:
        """One policy update on rollouts from `starts`."""


@runtime_checkable
class Step(Protocol):
    """One step of an improver that learns from advantages; `key` shuffles."""

    def __call__(
        self, settings: PhaseSettings, policy: Policy, moments: Any, batch: Batch, key: Key[Array, ""]
    ) -> tuple[Policy, Any, ImproveInfo]:
        """The new policy, Adam's moments and what the step did."""


def init_memory(settings: PhaseSettings, policy: Policy, baseline: Baseline) -> Memory:
    """The memory at the start of a policy phase: the baseline goes on, Adam starts afresh."""
    return Memory(baseline, () if settings.improver == "trpo" else init_moments(policy, settings.gradient))


def batch_of(
    config: AdvantageConfig, rollouts: Trajectories, baseline: Baseline, key: Key[Array, ""], cut: bool = False
) -> tuple[Batch, Baseline]:
    """The rollouts [T, N] as a batch of T N steps with their advantages under `baseline`; and the baseline refitted.

    `key` is for the baseline that is fitted to minibatches.
    """
    advantages, baseline = VALUE_FUNCTIONS[config.baseline].learn(rollouts, baseline, config, key, cut)
    batch = Batch(rollouts.states, rollouts.actions, advantages, rollouts.mask)
    # Episode by episode: every n-th step is then one of every episode, whatever their number.
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), batch), baseline


def _sound(new: Policy, improved: ImproveInfo, imagined: Any) -> Bool[Array, ""]:
    """Whether an update is to be made: accepted, finite, and learned from at least one step that counts."""
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((new, improved.kl))]
    return improved.accepted & (imagined.steps > 0) & jnp.all(jnp.array(finite))


def _where(made: Bool[Array, ""], new: Any, old: Any) -> Any:
    return jax.tree.map(partial(jnp.where, made), new, old)


def _reported(improved: ImproveInfo, made: Bool[Array, ""]) -> ImproveInfo:
    kl, improvement = (jnp.where(made, x, 0.0) for x in (improved.kl, improved.improvement))
    return improved._replace(kl=kl, improvement=improvement, accepted=made)


def _by_score_function(step: Step) -> Improver:
    """Learns from stochastic rollouts and their advantages; never asks the models for a gradient."""

    def update(
        settings: PhaseSettings,
        simulate: Simulate,
        policy: Policy,
        memory: Memory,
        starts: Float[Array, "N S"],
        key: Key[Array, ""],
    ) -> tuple[Policy, Memory, Infos]:
        rollouts, imagined = simulate(partial(gaussian.sample, policy), starts, key)
        batch, baseline = batch_of(
            settings.advantage, rollouts, memory.baseline, jax.random.fold_in(key, _VALUE), settings.cut
        )
        new, moments, improved = step(settings, policy, memory.moments, batch, jax.random.fold_in(key, _SHUFFLE))
        sound = _sound(new, improved, imagined)
        # A step that was rejected has been judged all the same: its rollouts fit the baseline, if there were any.
        kept = Memory(_where(imagined.steps > 0, baseline, memory.baseline), _where(sound, moments, memory.moments))
        return _where(sound, new, policy), kept, (_reported(improved, sound), imagined)

    return update


def _through_models(act: Callable[[Policy], SampleActions]) -> Improver:
    """Follows the gradient of the imagined return itself."""

    def update(
        settings: PhaseSettings,
        simulate: Simulate,
        policy: Policy,
        memory: Memory,
        starts: Float[Array, "N S"],
        key: Key[Array, ""],
    ) -> tuple[Policy, Memory, Infos]:
        new, moments, (improved, imagined) = bptt.improve(
            policy, memory.moments, act, simulate, starts, settings.gradient, key
        )
        sound = _sound(new, improved, imagined)
        memory = memory._replace(moments=_where(sound, moments, memory.moments))
        return _where(sound, new, policy), memory, (_reported(improved, sound), imagined)

    return update


def _trpo(
    settings: PhaseSettings, policy: Policy, moments: Any, batch: Batch, key: Key[Array, ""]
) -> tuple[Policy, Any, ImproveInfo]:
    new, info = trpo.improve(policy, batch, settings.trpo, settings.mean_penalty)
    return new, moments, info


def _ppo(
    settings: PhaseSettings, policy: Policy, moments: Any, batch: Batch, key: Key[Array, ""]
) -> tuple[Policy, Any, ImproveInfo]:
    return ppo.improve(policy, moments, batch, settings.ppo, settings.gradient, key, settings.mean_penalty)


def _vpg(
    settings: PhaseSettings, policy: Policy, moments: Any, batch: Batch, key: Key[Array, ""]
) -> tuple[Policy, Any, ImproveInfo]:
    return vpg.improve(policy, moments, batch, settings.gradient, settings.mean_penalty)


IMPROVERS: dict[str, Improver] = {
    "trpo": _by_score_function(_trpo),
    "ppo": _by_score_function(_ppo),
    "vpg": _by_score_function(_vpg),
    "bptt": _through_models(bptt.deterministic),
    "bptt-stochastic": _through_models(bptt.stochastic),
}
