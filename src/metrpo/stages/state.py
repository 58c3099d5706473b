"""What one outer iteration hands to the next."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from metrpo.config import Config
from metrpo.model.ensemble import Networks
from metrpo.policy.gaussian import Policy
from metrpo.policy.inputs import Inputs, inputs_of
from metrpo.policy.value.value_table import Baseline
from metrpo.world.dataset import Dataset
from metrpo.world.task import Task


class Proven(NamedTuple):
    """The best policy so far, by real episodes without noise."""

    policy: Policy
    mean: float
    """Of their returns."""
    error: float
    """Standard error of the mean."""
    episodes: int
    """0: none has been played."""


class State(NamedTuple):
    """Everything that an iteration hands to the next: a pytree whose structure the config fixes."""

    iteration: int
    """Outer iterations finished."""
    real_steps: int
    """Real steps collected so far (evaluation does not count: nothing is learned from it)."""
    policy: Policy
    previous_policy: Policy
    """The policy before the last policy phase that changed it; scales the parameter noise."""
    networks: Networks
    """Of the ensemble; its normaliser derives from the dataset."""
    baseline: Baseline
    dataset: Dataset
    proven: Proven

    @property
    def origin(self) -> np.ndarray:
        """[S], float64: what the states are counted from that models and policy see (`world.origin`)."""
        return self.dataset.origin


def inputs_for(config: Config, task: Task, dataset: Dataset) -> Inputs | None:
    """What the policy sees of a state; None: all of it, as it is."""
    seen = config.policy.normalise and dataset.train.size > 0
    return inputs_of(dataset.train.states, task.unseen) if seen else None


def on_host(policy: Policy) -> Policy:
    """The policy as NumPy arrays."""
    return jax.tree.map(np.asarray, policy)
