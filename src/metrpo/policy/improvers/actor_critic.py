"""One update of an off-policy actor-critic in the ensemble.

Both learn from the same imagined episodes of a few steps. The critics' targets are the soft return along these and the
target critics' value where they are cut (value expansion, Feinberg et al. 2018); the actor follows the gradient of the
same sum through models, actions and critics (stochastic value gradients, Heess et al. 2015; Amos et al. 2021). A
learned weight steers the actor's entropy, and the least of the critics counts (Haarnoja et al. 2018).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from metrpo.config import ActorCriticConfig, Config, GradientConfig
from metrpo.devices import across, share_of
from metrpo.policy import squashed
from metrpo.policy.squashed import Actor
from metrpo.policy.value import critics as critic_networks
from metrpo.policy.value.critics import Critics, ValueScale, averaged, valued
from metrpo.types import Array, Simulate, Trajectories

_LAST, _REAL = 2**31 - 3, 2**31 - 2
"""Derive the keys of the actions in the last imagined states, and in those after real steps."""


@dataclass(frozen=True)
class UpdateSettings:
    """What decides the compiled update, and nothing else."""

    actor_critic: ActorCriticConfig
    gradient: GradientConfig
    discount: float

    @classmethod
    def of(cls, config: Config) -> UpdateSettings:
        """The settings of `config`."""
        return cls(config.actor_critic, config.gradient, config.advantage.discount)


class Moments(NamedTuple):
    """Adam's."""

    actor: Any
    critics: Any
    entropy: Any


class Learner(NamedTuple):
    """All that updates hand on; a pytree."""

    actor: Actor
    critics: Critics
    targets: Critics
    """Moving average of the critics."""
    log_entropy_weight: Array
    """[]"""
    moments: Moments
    scale: ValueScale


class Steps(NamedTuple):
    """Real transitions, which critics learn from; states as the actor sees them."""

    states: Array
    """[M, S]"""
    actions: Array
    """[M, A]"""
    rewards: Array
    """[M]"""
    following: Array
    """[M, S], the next states."""
    going_on: Array
    """[M], 0 where the episode ended with the step."""


class UpdateInfo(NamedTuple):
    """What one update did."""

    critic_loss: Array
    """In squared units of the critics' scale, mean over critics."""
    value: Array
    """Mean over critics and states of what they say."""
    entropy: Array
    """Nats, mean over the states that the update starts in."""
    gradient_norm: Array
    """Of the actor's objective, in units of the critics' scale."""
    accepted: Array
    """Whether all is finite; else nothing has changed."""


def init(settings: UpdateSettings, key: Array, state_size: int, action_size: int, hidden: tuple[int, ...]) -> Learner:
    """What has learned nothing."""
    a, keys = settings.actor_critic, jax.random.split(key)
    actor = squashed.init(keys[0], state_size, action_size, hidden)
    critics = critic_networks.init(keys[1], a.critics, state_size + action_size, a.critic_hidden)
    log_weight = jnp.log(jnp.float32(a.entropy_weight))
    of_actor, of_critics, of_entropy = _optimizers(settings)
    moments = Moments(of_actor.init(actor), of_critics.init(critics), of_entropy.init(log_weight))
    one, zero = jnp.float32(1), jnp.float32(0)
    return Learner(actor, critics, critics, log_weight, moments, ValueScale(zero, one, zero, zero))


def _optimizers(settings: UpdateSettings) -> tuple[optax.GradientTransformation, ...]:
    a, g = settings.actor_critic, settings.gradient
    of_actor = optax.chain(optax.clip_by_global_norm(g.max_norm), optax.adam(g.learning_rate))
    return of_actor, optax.adam(a.critic_learning_rate), optax.adam(a.entropy_learning_rate)


def update(
    settings: UpdateSettings, simulate: Simulate, learner: Learner, starts: Array, real: Steps, key: Array
) -> tuple[Learner, UpdateInfo, Any]:
    """One step of critics, actor and entropy weight on episodes imagined from `starts` [N, S] and on `real` steps.

    The third part of the result is what the simulation says of its episodes. An update that is not finite anywhere
    changes nothing.
    """
    gradient, (rollouts, last, imagined) = actor_gradient(settings, simulate, learner, starts, key)
    lessons = of_real(settings, learner, real, jax.random.fold_in(key, _REAL))
    if settings.actor_critic.horizon:
        lessons = jax.tree.map(lambda *xs: jnp.concatenate(xs), lessons, expanded(settings, learner, rollouts, last))
    loss, value, critic_gradient = _critic_gradient(learner, lessons)
    log_probs, counts = _at_first(rollouts, last[2])
    entropy = _mean(-log_probs, counts)
    new = _stepped(settings, learner, gradient, critic_gradient, entropy)
    leaves = jax.tree.leaves((new, gradient, critic_gradient, loss))
    sound = (jnp.sum(counts) > 0) & jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))
    new = jax.tree.map(lambda now, before: jnp.where(sound, now, before), new, learner)
    info = UpdateInfo(loss, value, entropy, optax.tree.norm(gradient), sound)
    return new, jax.tree.map(lambda x: jnp.where(sound, x, jnp.zeros_like(x)), info), imagined


Last = tuple[Array, Array, Array]
"""The states [N, S] in which episodes are cut, actions there [N, A] and their log-probabilities [N]."""


def actor_gradient(
    settings: UpdateSettings, simulate: Simulate, learner: Learner, starts: Array, key: Array
) -> tuple[Actor, tuple[Trajectories, Last, Any]]:
    """The gradient of the mean soft return, in units of the scale; and the episodes that it was taken on."""
    a, weight = settings.actor_critic, jnp.exp(learner.log_entropy_weight)

    def total(actor: Actor) -> tuple[Array, tuple[Trajectories, Last, Any]]:
        rollouts, imagined = simulate(lambda states, key: squashed.sample(actor, states, key), starts, key)
        last_key = share_of(jax.random.fold_in(key, _LAST))
        actions, log_probs = squashed.sample(actor, rollouts.last, last_key)
        said = critic_networks.outputs(learner.critics, rollouts.last, actions)
        after = valued(learner.scale, jnp.mean(said, axis=0) if a.terminal == "mean" else jnp.min(said, axis=0))
        _, first = soft_returns(rollouts, weight, settings.discount, after - weight * log_probs)
        # Diverged episodes do not count, but what they met may be no number.
        counts = _at_first(rollouts, log_probs)[1]
        summed = jnp.sum(jnp.where(counts > 0, first, 0.0)) / learner.scale.width
        return summed, (rollouts, (rollouts.last, actions, log_probs), imagined)

    gradient, happened = jax.grad(total, has_aux=True)(learner.actor)
    count = across(jnp.float32(starts.shape[0]))
    return jax.tree.map(lambda g: g / count, across(gradient)), jax.lax.stop_gradient(happened)


def _at_first(rollouts: Trajectories, last_log_probs: Array) -> tuple[Array, Array]:
    """Of the states that episodes start in: log-probabilities of actions there, and 1 where one counts, [N] each."""
    if len(rollouts.mask):
        return rollouts.noted[0], rollouts.mask[0]
    return last_log_probs, rollouts.going_on  # no step is imagined: the last state is the first


def soft_returns(rollouts: Trajectories, weight: Array, discount: float, after: Array) -> tuple[Array, Array]:
    """[T, N]: rewards from each step on, the entropy of actions after it, and `after` [N], the value of the last state.

    The entropy of a step's own action is left out, as in Q(s, a). The second result, [N], is of the first states, with
    it. An episode that stands still has the value of the state that it stands in.
    """

    def back(following: Array, step: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array]:
        reward, log_prob, mask, goes_on, moves = step
        value = mask * (reward + discount * goes_on * following)
        return jnp.where(moves > 0, value - weight * log_prob, following), value

    # An episode that ends at a step has a mask of 0 from the next one on.
    goes_on = jnp.concatenate([rollouts.mask, rollouts.going_on[None]])[1:]
    steps = (rollouts.rewards, rollouts.noted, rollouts.mask, goes_on, _moves(rollouts))
    first, values = jax.lax.scan(back, after, steps, reverse=True)
    return values, first


class Lessons(NamedTuple):
    """What critics learn from."""

    states: Array
    """[L, S]"""
    actions: Array
    """[L, A]"""
    targets: Array
    """[L], soft returns within the bounds of the scale."""
    mask: Array
    """[L], 1 where a lesson is one."""


def _moves(rollouts: Trajectories) -> Array:
    return jnp.ones_like(rollouts.mask) if rollouts.trusted is None else rollouts.trusted


def expanded(settings: UpdateSettings, learner: Learner, rollouts: Trajectories, last: Last) -> Lessons:
    """Of the first states of imagined episodes: all that follows there, then the target critics (value expansion)."""
    weight, scale, steps = jnp.exp(learner.log_entropy_weight), learner.scale, settings.actor_critic.critic_steps
    returns, _ = soft_returns(rollouts, weight, settings.discount, _after(learner, *last))
    targets, mask = jnp.clip(returns, scale.lowest, scale.highest), rollouts.mask * _moves(rollouts)
    lessons = Lessons(rollouts.states, rollouts.actions, targets, mask)
    return jax.tree.map(lambda x: x[:steps].reshape(-1, *x.shape[2:]), lessons)


def of_real(settings: UpdateSettings, learner: Learner, real: Steps, key: Array) -> Lessons:
    """Of real steps: their reward, then the target critics."""
    actions, log_probs = squashed.sample(learner.actor, real.following, share_of(key))
    after = _after(learner, real.following, actions, log_probs)
    targets = real.rewards + settings.discount * real.going_on * after
    clipped = jnp.clip(targets, learner.scale.lowest, learner.scale.highest)
    return Lessons(real.states, real.actions, clipped, jnp.ones_like(clipped))


def _after(learner: Learner, states: Array, actions: Array, log_probs: Array) -> Array:
    """The soft value of states [N, S] in which the actor draws `actions`, by the least of the target critics, [N]."""
    scale = learner.scale
    said = jnp.min(critic_networks.outputs(learner.targets, states, actions), axis=0)
    value = jnp.clip(valued(scale, said), scale.lowest, scale.highest)
    return value - jnp.exp(learner.log_entropy_weight) * log_probs


def _critic_gradient(learner: Learner, lessons: Lessons) -> tuple[Array, Array, Critics]:
    """The critics' loss, what they say on average, and the loss's gradient."""
    scale, (states, actions, targets, mask) = learner.scale, lessons
    aims = (targets - scale.middle) / scale.width

    def loss(critics: Critics) -> tuple[Array, tuple[Array, Array]]:
        said = critic_networks.outputs(critics, states, actions)
        squares = jnp.where(mask > 0, jnp.square(said - aims), 0.0)
        return jnp.sum(squares), (jnp.sum(squares), jnp.sum(mask * said))

    gradient, sums = jax.grad(loss, has_aux=True)(learner.critics)
    gradient, (squares, said), count = across((gradient, sums, jnp.sum(mask)))
    count = jnp.maximum(count, 1.0)
    each = count * len(learner.critics)
    return squares / each, valued(scale, said / each), jax.tree.map(lambda g: g / count, gradient)


def _stepped(settings: UpdateSettings, learner: Learner, actor: Actor, critics: Critics, entropy: Array) -> Learner:
    """The learner one step on along these gradients: uphill for the actor, downhill for the critics."""
    of_actor, of_critics, of_entropy = _optimizers(settings)
    a, actions = settings.actor_critic, learner.actor.layers[-1][1].shape[0] // 2
    moments = learner.moments
    move, for_actor = of_actor.update(jax.tree.map(jnp.negative, actor), moments.actor)
    new_actor = optax.apply_updates(learner.actor, move)
    move, for_critics = of_critics.update(critics, moments.critics)
    new_critics = optax.apply_updates(learner.critics, move)
    # Above its target the entropy is worth less, below it more.
    surplus = entropy - a.entropy_target * actions
    move, for_entropy = of_entropy.update(surplus, moments.entropy)
    return Learner(
        new_actor,
        new_critics,
        averaged(learner.targets, new_critics, a.target_rate),
        optax.apply_updates(learner.log_entropy_weight, move),
        Moments(for_actor, for_critics, for_entropy),
        learner.scale,
    )


def _mean(values: Array, mask: Array) -> Array:
    total, count = across((jnp.sum(mask * values), jnp.sum(mask)))
    return total / jnp.maximum(count, 1.0)
