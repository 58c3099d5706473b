"""The actor-critic's stage: what acts in real episodes, and the updates in the fitted ensemble.

In place of `metrpo.stages.policy_search` where `improver` is "actor-critic". The state's `baseline` holds all that the
updates hand on (`policy.improvers.actor_critic.Learner`), its `policy` what the actor does without noise.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from metrpo.actor_critic_phase import branches, run_block
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.model.bounds import bounds_of
from metrpo.model.ensemble import Ensemble, with_carried
from metrpo.model.imagine import ImagineInfo, Simulator, disagreement, outcome
from metrpo.policy import gaussian, squashed
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers import actor_critic
from metrpo.policy.improvers.actor_critic import Learner, Steps, UpdateInfo, UpdateSettings
from metrpo.policy.inputs import normalised
from metrpo.policy.stopping import RULES, Evidence, improved
from metrpo.policy.value.critics import ValueScale, rescaled, reward_spread, scale_of
from metrpo.policy_phase import PhaseInfo, simulator_of, values_of
from metrpo.run.clock import Clock
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.state import State, inputs_for
from metrpo.types import Array
from metrpo.world import collection as real
from metrpo.world.dataset import Dataset
from metrpo.world.origin import of_real, shifted
from metrpo.world.task import Task

_LOOKED_AT = 1000
"""States of the dataset, the newest, on which the policy is described for the record."""
_COMPARED, _MOST = 1000, 0.95
"""Held-out steps, and the share of them, that decide how far models are trusted."""
_disagreement = jax.jit(disagreement)
_JUDGE = 2**31 - 6
"""Derives the key of the noise in which policies are valued."""
_NO_RETURN = np.array([math.nan])
_NEAR = 0.99
"""Mean actions of a squashed policy beyond this saturate."""


def fresh(config: Config, task: Task, key: Array) -> tuple[Policy, Learner]:
    """A policy and a learner that have learned nothing. (The values' scale rests on a discount below 1.)"""
    sizes = task.state_size, task.action_size, config.policy.hidden
    learner = actor_critic.init(UpdateSettings.of(config), key, *sizes)
    policy = squashed.mean_policy(learner.actor, None, np.zeros((0, task.state_size), np.float32))
    return jax.tree.map(jnp.asarray, policy), learner


def explorer(config: Config, task: Task, state: State) -> Callable[[np.random.Generator], real.Act]:
    """What acts in an episode: uniformly random actions at first, then the actor. Its noise is `real.correlated`."""
    inputs, actor = inputs_for(config, task, state.dataset), squashed.on_host(state.baseline.actor)
    at_random = state.iteration == 0

    def draw_act(rng: np.random.Generator) -> real.Act:
        noise = real.correlated(config.collect.noise_correlation, rng)

        def act(observed: np.ndarray) -> np.ndarray:
            step = noise((task.action_size,))
            if at_random:
                return _uniform(step)
            return squashed.draw(actor, normalised(inputs, observed), step)

        return of_real(act, state.origin)

    return draw_act


def _uniform(noise: np.ndarray) -> np.ndarray:
    """Numbers N(0, 1) as numbers uniform in [-1, 1]: what was correlated stays so."""
    return np.vectorize(math.erf)(noise / math.sqrt(2))


def improve_policy(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock, steps: int = 0
) -> tuple[Policy, Learner, PhaseInfo]:
    """The policy after the updates of an iteration that collected `steps` real steps, the learner and what happened.

    Where the models vote (`validate.rule`), it is the policy that they accepted last; the learner goes on in any case.

    `state` holds the dataset that the ensemble was fitted to.
    """
    iteration, dataset, settings = state.iteration + 1, state.dataset, UpdateSettings.of(config)
    rng, key = rng_of(config.seed, iteration, Stage.IMPROVE), key_of(config.seed, iteration, Stage.IMPROVE)
    known, inputs = shifted(task, dataset.origin), inputs_for(config, task, dataset)
    bounds = bounds_of(dataset.train, config.actor_critic.margin, task.unseen, task.carried)
    simulator = dataclasses.replace(
        simulator_of(config, known, ensemble, inputs), bounds=bounds, trusted=_trusted(config, ensemble, dataset, rng)
    )
    real_steps = _real_steps(known, ensemble, dataset)
    scale = scale_of(real_steps.rewards, settings.discount, bool(task.terminated))
    before = learner = _in_units(state, scale, settings.discount)
    real_steps = real_steps._replace(
        states=normalised(inputs, real_steps.states), following=normalised(inputs, real_steps.following)
    )
    infos: list[tuple[UpdateInfo, ImagineInfo]] = []
    block = config.actor_critic.block
    for number in range(updates_for(config, steps) // block):
        starts = dataset.train.states[rng.integers(dataset.train.size, size=branches(settings, block))]
        rows = rng.integers(dataset.train.size, size=(block, config.actor_critic.real_batch))
        drawn = jax.tree.map(lambda x, rows=rows: x[rows], real_steps)
        keys = jax.random.split(jax.random.fold_in(key, number), block)
        learner, info = run_block(settings, simulator, learner, starts, drawn, keys)
        infos.append(jax.device_get(info))
        progress.update((number + 1) * block, _note(infos[-1][0]))
    learner = jax.device_get(learner)
    happened = jax.tree.map(lambda *xs: np.concatenate(xs), *infos)
    seen = dataset.train.states[-_LOOKED_AT:]
    new = squashed.mean_policy(learner.actor, inputs, seen)
    old = state.policy if config.takes_votes else squashed.mean_policy(before.actor, inputs, seen)
    with clock("validate"):
        values = _values(config, simulator, [old, new], dataset.starts, jax.random.fold_in(key, _JUDGE))
    distance = squashed.kl(squashed.on_host(before.actor), learner.actor, normalised(inputs, seen))
    accepted = _is_accepted(config, *values)
    policy = new if accepted else old
    more = _columns(happened[0], learner, policy, seen)
    return policy, learner, _phase_info(happened, values, distance, more, accepted)


def _is_accepted(config: Config, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether the policy with values `after` [K] takes the place of the accepted one, with `before`."""
    rule = RULES[config.validate.rule]
    old, new = (rule.evidence(Evidence(x, _NO_RETURN, lambda: math.nan)) for x in (before, after))
    return rule.decide(new, old, config.validate)


def _phase_info(
    happened: tuple[UpdateInfo, ImagineInfo],
    values: list[np.ndarray],
    distance: np.ndarray,
    more: dict[str, float],
    accepted: bool,
) -> PhaseInfo:
    """Of all updates: `values` [2, K] of the policy accepted before and of the one after them; KL `distance`."""
    (made, imagined), (before, after) = happened, values
    count = len(made.accepted)
    return PhaseInfo(
        values=after if accepted else before,
        updates=count,
        accepted_updates=count if accepted else 0,
        rejected_steps=int(np.sum(~made.accepted)),
        validations=1,
        improved=improved(after, before).astype(np.float64),
        kl=float(np.mean(distance)) / count,
        diverged=float(np.mean(imagined.diverged)),
        more=more,
    )


def updates_for(config: Config, steps: int) -> int:
    """The updates of an iteration that collected `steps` real steps, in whole blocks.

    Where there is a log alone and nothing is collected, as many as for `collect.steps`.
    """
    a = config.actor_critic
    return a.block * max(1, round(a.updates_per_step * (steps or config.collect.steps) / a.block))


def _in_units(state: State, scale: ValueScale, discount: float) -> Learner:
    """The learner, critics in the units of the data as they are now; at first, its entropy is too."""
    learner: Learner = state.baseline
    if state.iteration == 0:  # it says the middle of what is possible, whatever that turns out to be
        weight = learner.log_entropy_weight + np.float32(math.log(reward_spread(scale, discount)))
        return learner._replace(scale=scale, log_entropy_weight=weight)
    critics, targets = (rescaled(x, learner.scale, scale) for x in (learner.critics, learner.targets))
    return learner._replace(critics=critics, targets=targets, scale=scale)


def _real_steps(task: Task, ensemble: Ensemble, dataset: Dataset) -> Steps:
    """The transitions to learn from, in raw states."""
    states, actions, deltas, _ = dataset.train
    size = states.shape[1] - len(ensemble.carried.indices)
    changing = np.concatenate([states[:, :size] + deltas[:, :size], deltas[:, size:]], axis=1)
    predicted = np.asarray(with_carried(ensemble, states, actions, changing))
    following, rewards, ended = outcome(task.reward, task.terminated, states, actions, predicted)
    going_on = np.ones(len(states)) if ended is None else 1.0 - np.asarray(ended)
    return Steps(states, actions, np.asarray(rewards, np.float32), following, going_on.astype(np.float32))


def _trusted(config: Config, ensemble: Ensemble, dataset: Dataset, rng: np.random.Generator) -> Array | None:
    """The disagreement, [], beyond which branches are cut: the models' on held-out real steps, at least a little."""
    if not config.actor_critic.trust:
        return None
    rows = rng.integers(dataset.validation.size, size=_COMPARED)
    real = _disagreement(ensemble, dataset.validation.states[rows], dataset.validation.actions[rows])
    return jnp.float32(max(config.actor_critic.trust * np.quantile(real, _MOST), config.actor_critic.agreement))


def _values(
    config: Config, simulator: Simulator, policies: list[Policy], starts: np.ndarray, key: Array
) -> list[np.ndarray]:
    """[K] for each of the `policies` of raw states: its mean return in every model, over whole episodes, with noise."""
    rng = np.random.default_rng(0)  # the same starts for both; nothing is learned from these
    chosen = starts[rng.integers(len(starts), size=config.validate.starts)]
    plain = dataclasses.replace(simulator, inputs=None)
    keys = jax.random.split(key, len(policies))
    return [values_of(plain, policy, chosen, key=k) for policy, k in zip(policies, keys, strict=True)]


def _columns(updates: UpdateInfo, learner: Learner, policy: Policy, states: np.ndarray) -> dict[str, float]:
    """What the row of metrics says of an actor-critic alone."""
    made = updates.accepted

    def mean(values: np.ndarray) -> float:
        return float(np.mean(values[made])) if made.any() else math.nan

    actions = gaussian.mean(policy, states)
    return {
        "critic_loss": mean(updates.critic_loss),
        "value": mean(updates.value),
        "entropy": mean(updates.entropy),
        "entropy_weight": float(np.exp(learner.log_entropy_weight)),
        "actor_gradient_norm": mean(updates.gradient_norm),
        "saturated": float(np.mean(np.abs(actions) > _NEAR)),
    }


def _note(updates: UpdateInfo) -> str:
    value, loss, entropy = (float(np.mean(x)) for x in (updates.value, updates.critic_loss, updates.entropy))
    return f"value {value:.4g}, critic loss {loss:.3g}, entropy {entropy:.2f}"
