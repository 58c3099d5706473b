"""What OpenAI baselines' PPO (ppo1) and DDPG have and Stable-Baselines3's have not, and the settings of both.

The paper refers to that implementation: "the default hyper-parameters", networks of the policy's size, its discount. As
there, observations are standardised by running statistics and the end of an episode by the clock is an end. Needs
PyTorch and Stable-Baselines3.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.td3.policies import TD3Policy

PPO_STEPS = 2048
"""Real steps per update."""
PPO_SETTINGS: dict[str, Any] = {
    **{"learning_rate": 3e-4, "batch_size": 64, "n_epochs": 10, "clip_range": 0.2, "max_grad_norm": math.inf},
    **{"gae_lambda": 0.95, "vf_coef": 1.0, "ent_coef": 0.0},
}
"""ppo1's defaults for MuJoCo, but for the linear decay of learning rate and clipping range."""
DDPG_SETTINGS: dict[str, Any] = {"tau": 0.01, "batch_size": 64, "gradient_steps": 50}
DDPG_BUFFER, DDPG_STEPS = 1_000_000, 100
"""Most transitions kept (the oldest go first), and real steps between two rounds of `gradient_steps`."""
DDPG_CRITIC, DDPG_RATES, DDPG_DECAY = (64, 64), (1e-4, 1e-3), 1e-2
"""Sizes of the critic's hidden layers, Adam's step sizes for actor and critic, L2 on the critic's hidden weights."""
DDPG_NOISE = 0.2
"""Standard deviation of the actions' Gaussian noise (there, of parameter noise adapted to have that effect)."""
DDPG_WARM_UP = 1000
"""Uniform actions before the first update (TD3's, Fujimoto et al. 2018); half an iteration at most."""
_LAST = 3e-3
"""DDPG's last layers start uniform within it."""
_LEAST_VARIANCE = 1e-2


class Statistics:
    """Running mean and standard deviation of observations; a fresh one standardises nothing."""

    def __init__(self, size: int) -> None:
        self.sums = {"sum": np.zeros(size), "squares": np.full(size, 1e-2), "count": np.full((), 1e-2)}
        self._refresh()

    def update(self, observations: np.ndarray) -> None:
        """Takes in [n, S] more."""
        x = np.asarray(observations, np.float64)
        self.put({"sum": x.sum(0), "squares": np.square(x).sum(0), "count": np.array(float(len(x)))}, add=True)

    def put(self, sums: dict[str, np.ndarray], add: bool = False) -> None:
        """Replaces the sums by others, or adds these to them."""
        self.sums = {name: np.array(value + self.sums[name] if add else value) for name, value in sums.items()}
        self._refresh()

    def _refresh(self) -> None:
        mean = self.sums["sum"] / self.sums["count"]
        std = np.sqrt(np.maximum(self.sums["squares"] / self.sums["count"] - np.square(mean), _LEAST_VARIANCE))
        self.mean, self.std = mean.astype(np.float32), std.astype(np.float32)
        self.tensors = torch.from_numpy(self.mean), torch.from_numpy(self.std)

    def folded(self, weights: np.ndarray, biases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A first layer [S, H], [H] for raw observations that does what the given one does for standardised ones."""
        scaled = weights / self.std[:, None]
        return scaled, biases - self.mean @ scaled


class Standardised(BaseFeaturesExtractor):
    """Observations by the running statistics; unlike there not clipped at 5, for an exported policy cannot be."""

    def __init__(self, space: Box, statistics: Statistics) -> None:
        super().__init__(space, int(space.shape[0]))
        self._statistics = statistics

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """[n, S] -> [n, S]"""
        mean, std = self._statistics.tensors
        return (observations - mean) / std


class ClockEnds(gymnasium.Wrapper):
    """The clock's end of an episode as the task's: undiscounted, what would follow cannot be valued."""

    def step(self, action: np.ndarray) -> Any:
        """As the environment's, but never truncated."""
        state, reward, terminated, truncated, info = self.env.step(action)
        return state, reward, bool(terminated or truncated), False, info


class NormedPPO(PPO):
    """PPO whose observations are standardised by the statistics of all batches before the present one."""

    def train(self) -> None:
        """A batch counts once it has been learned from: the probabilities compared in an update are of one policy."""
        super().train()
        observations = self.rollout_buffer.observations
        self.policy.features_extractor._statistics.update(observations.reshape(-1, observations.shape[-1]))


class _Value(torch.nn.Module):
    """DDPG's critic: layer normalisation before every ReLU, the action joined to the second layer's input."""

    def __init__(self, states: int, actions: int, hidden: tuple[int, int]) -> None:
        super().__init__()
        self._states = states
        self.first, self.second = torch.nn.Linear(states, hidden[0]), torch.nn.Linear(hidden[0] + actions, hidden[1])
        self.norms = torch.nn.ModuleList(torch.nn.LayerNorm(width) for width in hidden)
        self.last = torch.nn.Linear(hidden[1], 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[n, S + A] -> [n, 1]"""
        states, actions = x[:, : self._states], x[:, self._states :]
        hidden = torch.relu(self.norms[0](self.first(states)))
        hidden = torch.relu(self.norms[1](self.second(torch.cat([hidden, actions], dim=1))))
        return self.last(hidden)


class _Critic(ContinuousCritic):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        states, actions = self.observation_space.shape[0], self.action_space.shape[0]
        self.qf0 = _Value(states, actions, DDPG_CRITIC)
        self.q_networks = [self.qf0]


class NormedTD3Policy(TD3Policy):
    """Actor and critic of OpenAI baselines' DDPG; the actor a tanh network without layer normalisation."""

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        """A critic with layer normalisation."""
        return _Critic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        for network, last in ((self.actor, self.actor.mu[-2]), (self.critic, self.critic.qf0.last)):
            for module in network.modules():
                if isinstance(module, torch.nn.Linear):
                    torch.nn.init.xavier_uniform_(module.weight)
                    torch.nn.init.zeros_(module.bias)
            torch.nn.init.uniform_(last.weight, -_LAST, _LAST)
            torch.nn.init.uniform_(last.bias, -_LAST, _LAST)
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.critic_target.load_state_dict(self.critic.state_dict())
        value = self.critic.qf0
        kept = [value.first.weight, value.second.weight]
        others = [p for p in self.critic.parameters() if all(p is not k for k in kept)]
        # Adam's "weight decay" is the gradient of L2.
        groups = [{"params": kept, "weight_decay": DDPG_DECAY}, {"params": others}]
        self.critic.optimizer = torch.optim.Adam(groups, lr=DDPG_RATES[1])


class NormedDDPG(DDPG):
    """DDPG with `DDPG_RATES`."""

    def _update_learning_rate(self, optimizers: Any) -> None:
        # Called before every round of updates; Stable-Baselines3 would give both networks one rate.
        for optimizer, rate in zip(optimizers, DDPG_RATES, strict=True):
            update_learning_rate(optimizer, rate)
