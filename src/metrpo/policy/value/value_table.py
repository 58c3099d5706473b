"""The value functions that advantages are measured against, in one table: `VALUE_FUNCTIONS`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Key

from metrpo.config import AdvantageConfig
from metrpo.policy.value import linear, network
from metrpo.types import Array, Trajectories

Baseline = Any
"""What a value function has learned, a pytree: weights [2S + 4] of the linear one, a `network.Value` of the other."""


@runtime_checkable
class Learn(Protocol):
    """Advantages under what has been learned so far, and what the batch then teaches."""

    def __call__(
        self, trajectories: Trajectories, baseline: Baseline, config: AdvantageConfig, key: Key[Array, ""], cut: bool
    ) -> tuple[Float[Array, "T N"], Baseline]:
        """Standardised advantages, and the baseline for the next batch; `cut`: episodes go on after the last."""


class ValueFunction(NamedTuple):
    """One way to value states."""

    init: Callable[[Key[Array, ""], int, AdvantageConfig], Baseline]
    """(key, S, config) -> a baseline that predicts 0 everywhere."""
    learn: Learn
    at_cut: Callable[[Baseline, Float[Array, "N S"]], Float[Array, "N"]]
    """(baseline, states) -> what follows where episodes are cut off, whatever the time."""


VALUE_FUNCTIONS: dict[str, ValueFunction] = {
    "linear": ValueFunction(lambda key, size, config: linear.init(size), linear.advantages_and_value, linear.at_cut),
    "network": ValueFunction(network.init, network.advantages_and_value, network.at_cut),
}


def init_baseline(config: AdvantageConfig, state_size: int, key: Key[Array, ""]) -> Baseline:
    """A baseline that predicts 0 everywhere."""
    return VALUE_FUNCTIONS[config.baseline].init(key, state_size, config)
