"""What the workers share: HalfCheetah's sizes, random data, the policy and the reward, in PyTorch."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import torch

STATE, ACTION = 18, 6
MEMBERS, BATCH = 5, 1000
ROLLOUTS, HORIZON = 500, 100
HIDDEN = {"1024": (1024, 1024), "200x4": (200, 200, 200, 200), "200x3": (200, 200, 200)}
FIT_STEPS = 5
"""Training steps that one repetition averages over."""
LEARNING_RATE = 1e-3


def minibatches() -> Any:
    """Endless pairs of inputs [5, 1000, 24] and targets [5, 1000, 18]."""
    torch.manual_seed(0)
    pairs = [
        (torch.randn(MEMBERS, BATCH, STATE + ACTION), torch.randn(MEMBERS, BATCH, STATE)) for _ in range(FIT_STEPS)
    ]
    return cycle(pairs)


def starts() -> Any:
    """States where rollouts begin: [500, 18]."""
    torch.manual_seed(0)
    return 0.1 * torch.randn(ROLLOUTS, STATE)


def mean_network() -> Any:
    """The policy's mean: tanh layers of 32 and 32; the noise has standard deviation 1."""
    torch.manual_seed(1)
    return torch.nn.Sequential(
        torch.nn.Linear(STATE, 32),
        torch.nn.Tanh(),
        torch.nn.Linear(32, 32),
        torch.nn.Tanh(),
        torch.nn.Linear(32, ACTION),
    )


def draw(means: Any) -> Any:
    """Actions around `means`, as drawn."""
    return means + torch.randn_like(means)


def reward(actions: Any, next_states: Any) -> Any:
    """Of HalfCheetah's kind, forward velocity less the cost of control: [N, 1]."""
    return (next_states[:, 9] - 0.05 * actions.square().sum(dim=1))[:, None]
