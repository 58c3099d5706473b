"""What no skill earns: real episodes of zero actions and of random ones, beside which a return means something."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from metrpo.world import batch_episodes, collection
from metrpo.world.size_limits import RECORDED
from metrpo.world.task import Task

EPISODES, STEPS = 10, 10_000
"""Most episodes each way; of long ones fewer, so that they have about so many steps together, but one at least."""


@dataclass(frozen=True)
class Yardstick:
    """Real returns of a way to act that has learned nothing."""

    mean: float
    std: float
    """Over the episodes."""
    episodes: int


@dataclass(frozen=True)
class Yardsticks:
    """What doing nothing and random actions earn."""

    zero: Yardstick
    """Of the action 0, the middle of the range."""
    random: Yardstick
    """Of actions drawn uniformly from [-1, 1], at every step anew."""

    def text(self) -> str:
        """In a line."""
        return f"doing nothing earns {_short(self.zero)}, random actions {_short(self.random)}"

    def record(self) -> dict[str, Any]:
        """As plain numbers, for JSON."""
        return asdict(self)


def measure(task: Task, episodes: int | None = None, seed: int = 0) -> Yardsticks:
    """Plays `episodes` real episodes each way (by default up to 10), from the same start states, cut as in evaluation.

    Raises `TaskError` where the environment fails.
    """
    episodes = episodes or min(EPISODES, max(1, STEPS // task.horizon))
    rng = np.random.default_rng(seed)

    def zero(states: np.ndarray) -> np.ndarray:
        return np.zeros((*states.shape[:-1], task.action_size))

    def random(state: np.ndarray) -> np.ndarray:
        return rng.uniform(-1.0, 1.0, task.action_size)

    of_zero = batch_episodes.evaluate(task, zero, episodes, seed, longest=RECORDED)
    of_random = collection.evaluate(task, random, episodes, seed, longest=RECORDED)
    return Yardsticks(_summary(of_zero), _summary(of_random))


def _summary(returns: np.ndarray) -> Yardstick:
    return Yardstick(float(np.mean(returns)), float(np.std(returns)), len(returns))


def _short(yardstick: Yardstick) -> str:
    return f"{yardstick.mean:.4g}"
