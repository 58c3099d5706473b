"""Stochastic value gradients in the real environment (Heess et al. 2015; settings: the paper, appendix "Baselines").

After every real episode the model is trained on all data so far, and the policy takes one gradient step along that
very episode (`metrpo.baselines.path_gradient`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from metrpo import budget
from metrpo.baselines import on_policy
from metrpo.baselines.path_gradient import RealPath, padded, state_value, value_gradient
from metrpo.config import Config, FitConfig, GradientConfig, SVGConfig
from metrpo.console.progress import SILENT, Progress
from metrpo.errors import ConfigError
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble, Networks
from metrpo.model.epochs import losses_of, minibatch
from metrpo.policy import gaussian
from metrpo.policy.advantage import discounted_returns
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.adam import ascend, init_moments
from metrpo.run.clock import Clock
from metrpo.run.metrics import Row
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.ensemble_fit import ensemble_of
from metrpo.stages.records import recorded_returns
from metrpo.types import Array, Episode, Normaliser, Transitions
from metrpo.world import dataset as datasets
from metrpo.world.task import Task

_VALUE_HIDDEN = (64, 64)


@dataclass(frozen=True)
class PolicySettings:
    """What decides the compiled update of the policy."""

    svg: SVGConfig
    gradient: GradientConfig
    discount: float


class SVGState(NamedTuple):
    """Everything that an iteration hands to the next; `*_moments` are Adam's, which go on from episode to episode."""

    iteration: int
    real_steps: int
    policy: Policy
    policy_moments: Any
    networks: Networks
    model_moments: Any
    value: Policy
    """SVG(1): a network from state and time to value, in its `layers`."""
    value_moments: Any
    replay: Transitions


def init(config: Config, task: Task) -> SVGState:
    """The state before the first iteration."""
    p, e = config.policy, config.ensemble
    if task.reward is None:
        raise ConfigError(f"method: svg needs the reward of {task.name} as a formula, got a task that learns it")
    keys = jax.random.split(key_of(config.seed, 0, Stage.INIT), 3)
    policy = gaussian.init(keys[0], task.state_size, task.action_size, p.hidden, p.initial_std)
    networks = ensembles.init(keys[1], 1, task.state_size, task.action_size, e.hidden, task.observation_size)
    value = gaussian.init(keys[2], task.state_size + 1, 1, _VALUE_HIDDEN, 1.0)
    return SVGState(
        iteration=0,
        real_steps=0,
        policy=policy,
        policy_moments=init_moments(policy, config.gradient),
        networks=networks,
        model_moments=optax.adam(config.fit.learning_rate).init(networks),
        value=value,
        value_moments=optax.adam(config.svg.value_learning_rate).init(value),
        replay=datasets.empty(task.state_size, task.action_size, task.observation_size).train,
    )


def step(config: Config, task: Task, state: SVGState, progress: Progress = SILENT) -> tuple[SVGState, Row]:
    """Episodes of `config.collect.steps` real steps together, each followed by training the model and the policy."""
    iteration, clock = state.iteration + 1, Clock()
    rng, key = rng_of(config.seed, iteration, Stage.COLLECT), key_of(config.seed, iteration, Stage.IMPROVE)
    collected: list[Episode] = []
    losses, norms, finite = [], [], []
    enough, left = budget.steps_wanted(config, state.real_steps), budget.steps_left(config, state.real_steps)
    longest = budget.longest_episode(config, state.real_steps)
    progress.stage("learn", enough)
    while (steps := sum(len(e.rewards) for e in collected)) < enough:
        with clock("collect"):
            drawn = on_policy.collect(task, state.policy, 1, rng, longest=longest, at_most=left - steps)
            collected += drawn.episodes
            most = config.collect.max_train
            replay = datasets.append(state.replay, drawn.episodes, most, carried=task.carried)
            state = state._replace(replay=replay)
            path = padded(drawn.episodes[0].states, drawn.actions[0], drawn.episodes[0].rewards, task.horizon)
        ensemble = ensemble_of(config, task, state.networks, state.replay)
        with clock("fit"):
            replay = jax.device_put(datasets.with_capacity(state.replay, config.collect.max_train))
            state, loss = _fit(config, state, ensemble, replay, jax.random.fold_in(key, steps))
            jax.block_until_ready(state.networks)
        with clock("improve"):
            state, norm, made = _improve(config, task, state, ensemble._replace(networks=state.networks), path)
        losses.append(float(loss))
        norms.append(float(norm))
        finite.append(bool(made))
        progress.update(steps, f"model loss {losses[-1]:.3g}, gradient {norms[-1]:.3g}")
    steps = sum(len(e.rewards) for e in collected)
    with clock("evaluate"):
        progress.stage("evaluate", config.evaluation_episodes)
        returns = recorded_returns(config, task, state.policy, iteration)
    state = state._replace(iteration=iteration, real_steps=state.real_steps + steps)
    row: Row = {
        "iteration": iteration,
        "real_steps": state.real_steps,
        "return_real": float(np.mean(returns)),
        "return_real_std": float(np.std(returns)),
        "return_collected": float(np.mean([e.rewards.sum() for e in collected])),
        "train_loss": float(np.mean(losses)),
        "updates": len(collected),
        "rejected_steps": int(np.sum(~np.array(finite))),
        "gradient_norm": float(np.mean(norms)),
        "mean_std": float(np.mean(np.exp(np.asarray(state.policy.log_std)))),
        **clock.row(),
    }
    return state, row


def _fit(
    config: Config, state: SVGState, ensemble: Ensemble, replay: Transitions, key: Array
) -> tuple[SVGState, Array]:
    networks, moments, loss = _train_model(
        config.fit, config.svg.model_steps, ensemble, state.model_moments, replay, key
    )
    return state._replace(networks=networks, model_moments=moments), loss


@partial(jax.jit, static_argnames=("config", "steps"))
def _train_model(
    config: FitConfig,
    steps: int,
    ensemble: Ensemble,
    moments: Any,
    replay: Transitions,
    key: Array,
) -> tuple[Networks, Any, Array]:
    optimizer = optax.adam(config.learning_rate)

    def loss(networks: Networks, *batch: Array) -> Array:
        return jnp.mean(losses_of(ensemble._replace(networks=networks), config.loss_units, *batch)[0])

    def step(carry: tuple[Networks, Any], key: Array) -> tuple[tuple[Networks, Any], Array]:
        networks, moments = carry
        index = minibatch(key, jnp.arange(1), config.batch_size, replay.size)
        now, gradient = jax.value_and_grad(loss)(networks, *(jnp.take(x, index, axis=0) for x in replay[:3]))
        change, moments = optimizer.update(gradient, moments)
        return (optax.apply_updates(networks, change), moments), now

    (networks, moments), losses = jax.lax.scan(step, (ensemble.networks, moments), jax.random.split(key, steps))
    return networks, moments, jnp.mean(losses)


def _improve(
    config: Config, task: Task, state: SVGState, ensemble: Ensemble, path: RealPath
) -> tuple[SVGState, Array, Array]:
    learned, norm, made = _train_policy(
        PolicySettings(config.svg, config.gradient, config.advantage.discount),
        task,
        ensemble,
        (state.policy, state.policy_moments, state.value, state.value_moments),
        path,
    )
    policy, policy_moments, value, value_moments = learned
    changed = state._replace(policy=policy, policy_moments=policy_moments, value=value, value_moments=value_moments)
    return changed, norm, made


@partial(jax.jit, static_argnames=("settings", "task"))
def _train_policy(
    settings: PolicySettings, task: Task, ensemble: Ensemble, learned: tuple[Policy, Any, Policy, Any], path: RealPath
) -> tuple[tuple[Policy, Any, Policy, Any], Array, Array]:
    policy, moments, value, value_moments = learned
    discount = settings.discount
    if settings.svg.horizon == "1":
        value, value_moments = _train_value(settings, ensemble.normaliser, value, value_moments, path)
        gradient = value_gradient(task, ensemble, policy, path, discount, value)
    else:
        gradient = value_gradient(task, ensemble, policy, path, discount)
    policy, moments, made = ascend(policy, moments, gradient, settings.gradient)
    return (policy, moments, value, value_moments), optax.tree.norm(gradient), made


def _train_value(
    settings: PolicySettings, normaliser: Normaliser, value: Policy, moments: Any, path: RealPath
) -> tuple[Policy, Any]:
    """The value network fitted to the path's own returns to go, which are the policy's."""
    optimizer = optax.adam(settings.svg.value_learning_rate)
    returns = discounted_returns(path.rewards[:, None], path.mask[:, None], settings.discount)[:, 0]

    def loss(value: Policy) -> Array:
        errors = state_value(value, normaliser, path.states[:-1], jnp.arange(path.mask.size)) - returns
        return jnp.sum(path.mask * jnp.square(errors)) / jnp.sum(path.mask)

    def step(_: Array, carry: tuple[Policy, Any]) -> tuple[Policy, Any]:
        change, moments = optimizer.update(jax.grad(loss)(carry[0]), carry[1])
        return optax.apply_updates(carry[0], change), moments

    return jax.lax.fori_loop(0, settings.svg.value_steps, step, (value, moments))
