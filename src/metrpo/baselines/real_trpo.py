"""TRPO on the real environment: what ME-TRPO saves real steps against (paper, appendix "Baselines").

The policy, the advantages and the update are ME-TRPO's own; the rollouts are real.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from metrpo import budget
from metrpo.baselines import on_policy
from metrpo.baselines.on_policy import Drawn
from metrpo.config import AdvantageConfig, Config, TRPOConfig
from metrpo.console.progress import SILENT, Progress
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers import trpo
from metrpo.policy.improvers.batch import ImproveInfo
from metrpo.policy.improvers.improver_table import batch_of
from metrpo.policy.value.value_table import Baseline, init_baseline
from metrpo.run.clock import Clock
from metrpo.run.metrics import Row
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.stages.records import recorded_returns
from metrpo.types import Array, Trajectories
from metrpo.world.task import Task

_EPISODES = 64
"""Batches are padded to a multiple of so many episodes: where these end early their number changes all the time."""


class TRPOState(NamedTuple):
    """Everything that an iteration hands to the next."""

    iteration: int
    real_steps: int
    policy: Policy
    baseline: Baseline


def init(config: Config, task: Task) -> TRPOState:
    """The state before the first iteration."""
    p = config.policy
    key = key_of(config.seed, 0, Stage.INIT)
    policy = gaussian.init(key, task.state_size, task.action_size, p.hidden, p.initial_std)
    return TRPOState(
        0, 0, policy, init_baseline(config.advantage, task.state_size, key_of(config.seed, 0, Stage.IMPROVE))
    )


def step(config: Config, task: Task, state: TRPOState, progress: Progress = SILENT) -> tuple[TRPOState, Row]:
    """One update of TRPO on `config.collect.steps` real steps, or on what is left of the budget."""
    iteration, clock = state.iteration + 1, Clock()
    with clock("collect"):
        enough, at_most = budget.steps_wanted(config, state.real_steps), budget.steps_left(config, state.real_steps)
        progress.stage("collect", enough)
        rng, longest = rng_of(config.seed, iteration, Stage.COLLECT), budget.longest_episode(config, state.real_steps)
        drawn = on_policy.collect(task, state.policy, enough, rng, progress.update, longest, at_most)
    with clock("improve"):
        progress.stage("improve")
        batch = trajectories(drawn, task.horizon)
        key = key_of(config.seed, iteration, Stage.IMPROVE)
        policy, baseline, info = jax.device_get(
            _update(config.advantage, config.trpo, state.policy, state.baseline, batch, key)
        )
    with clock("evaluate"):
        progress.stage("evaluate", config.evaluation_episodes)
        returns = recorded_returns(config, task, policy, iteration)
    steps = state.real_steps + sum(len(e.rewards) for e in drawn.episodes)
    row: Row = {
        "iteration": iteration,
        "real_steps": steps,
        "return_real": float(np.mean(returns)),
        "return_real_std": float(np.std(returns)),
        "return_collected": float(np.mean([e.rewards.sum() for e in drawn.episodes])),
        "rejected_steps": int(not info.accepted),
        "kl": float(info.kl),
        "mean_std": float(np.mean(np.exp(policy.log_std))),
        **clock.row(),
    }
    return TRPOState(iteration, steps, policy, baseline), row


def trajectories(drawn: Drawn, horizon: int) -> Trajectories:
    """The episodes side by side, [T, N], with mask 0 after the end of each; N is padded."""
    count = -(-len(drawn.episodes) // _EPISODES) * _EPISODES

    def side_by_side(rows: list[np.ndarray]) -> np.ndarray:
        out = np.zeros((horizon, count, *rows[0].shape[1:]), np.float32)
        for i, row in enumerate(rows):
            out[: len(row), i] = row
        return out

    rewards = [e.rewards for e in drawn.episodes]
    return Trajectories(
        side_by_side([e.states[:-1] for e in drawn.episodes]),
        side_by_side(drawn.actions),
        side_by_side(rewards),
        side_by_side([np.ones_like(r) for r in rewards]),
    )


@partial(jax.jit, static_argnames=("advantage", "config"))
def _update(
    advantage: AdvantageConfig,
    config: TRPOConfig,
    policy: Policy,
    baseline: Baseline,
    rollouts: Trajectories,
    key: Array,
) -> tuple[Policy, Baseline, ImproveInfo]:
    batch, baseline = batch_of(advantage, rollouts, baseline, key)
    policy, info = trpo.improve(policy, batch, config)
    return policy, baseline, info
