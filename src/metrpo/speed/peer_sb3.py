"""The peer sb3-contrib: one update of its TRPO on a filled rollout buffer."""

from __future__ import annotations

import copy
import warnings
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from peer_data import ACTION, HORIZON, ROLLOUTS, STATE
from peer_loop import Repetition, serve, timed
from sb3_contrib import TRPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

VALUE_UPDATES = 10
"""The library's default."""


class Nowhere(gymnasium.Env[Any, Any]):
    """Has HalfCheetah's spaces and is never stepped: the buffer holds random data."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (STATE,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION,), np.float32)


def trpo(value_updates: int) -> Repetition:
    """`TRPO.train` on 50,000 samples, every time from the same parameters; the buffer is filled once."""
    model = TRPO(
        "MlpPolicy",
        DummyVecEnv([Nowhere] * ROLLOUTS),
        n_steps=HORIZON,
        cg_max_steps=10,
        cg_damping=1e-5,
        line_search_max_iter=15,
        n_critic_updates=value_updates,
        target_kl=0.01,
        sub_sampling_factor=1,
        policy_kwargs={"net_arch": [32, 32], "activation_fn": torch.nn.Tanh},
        device="cpu",
        seed=0,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    _fill(model)
    start = copy.deepcopy(model.policy.state_dict())

    def repetition() -> float:
        model.policy.load_state_dict(start)
        with warnings.catch_warnings():
            # Without value updates it logs the mean of no losses.
            warnings.filterwarnings("ignore", category=RuntimeWarning)
            return timed(model.train)

    return repetition


@torch.no_grad()
def _fill(model: Any) -> None:
    random = np.random.default_rng(0)
    for step in range(HORIZON):
        states = random.standard_normal((ROLLOUTS, STATE), dtype=np.float32)
        actions, values, log_probabilities = model.policy(torch.from_numpy(states))
        rewards = random.standard_normal(ROLLOUTS, dtype=np.float32)
        first = np.full(ROLLOUTS, step == 0)
        model.rollout_buffer.add(states, actions.numpy(), rewards, first, values, log_probabilities)
    model.rollout_buffer.compute_returns_and_advantage(values, np.ones(ROLLOUTS))


WORK = {"trpo": partial(trpo, 0), "trpo-value": partial(trpo, VALUE_UPDATES)}

if __name__ == "__main__":
    serve(WORK)
