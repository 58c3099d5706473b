"""When to stop improving the policy: the paper's rule and those it compares (section 5 and "Ensemble validation").

A rule looks at some evidence of every validated policy and decides whether it takes the place of the accepted one.
Rules stand in one table, `RULES`; the phase goes on until nothing has been accepted for a while.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from metrpo.config import ValidateConfig
from metrpo.types import Array


class Evidence(NamedTuple):
    """What a rule may look at."""

    values: Float[np.ndarray, "K"]
    """Each model's value of the policy: mean return of the deterministic policy over the full horizon."""
    rollouts: Float[np.ndarray, "1"]
    """Mean return of the stochastic rollouts of the last update; before the first update -inf."""
    real: Callable[[], float]
    """The policy's return in the real environment: an oracle."""


class Rule(NamedTuple):
    """What to look at, and when that accepts a policy."""

    evidence: Callable[[Evidence], Float[np.ndarray, "n"]]
    """Numbers, of every policy."""
    decide: Callable[[Float[Array, "n"], Float[Array, "n"], ValidateConfig], bool]
    """(of the policy, of the accepted one, config) -> whether the policy becomes the accepted one."""


def improved(values: Float[Array, "K"], reference: Float[Array, "K"]) -> Bool[np.ndarray, "K"]:
    """Which models' value exceeds the reference's; ties and NaN are no improvement.

    A model whose reference is NaN (its rollouts diverged) counts as improved when its value is finite again.
    """
    new, old = np.asarray(values), np.asarray(reference)
    found: Bool[np.ndarray, "K"] = np.isfinite(new) & ((new > old) | np.isnan(old))
    return found


def fraction_improved(values: Float[Array, "K"], reference: Float[Array, "K"]) -> float:
    """Share of the models whose value exceeds the reference's (paper, eq. 5)."""
    return float(np.mean(improved(values, reference)))


def most_improve(values: Float[Array, "n"], reference: Float[Array, "n"], config: ValidateConfig) -> bool:
    """At least `threshold` of the numbers improve (of a single number: it does)."""
    return fraction_improved(values, reference) >= config.threshold


def always(values: Float[Array, "n"], reference: Float[Array, "n"], config: ValidateConfig) -> bool:
    """Every policy is accepted, so that `max_updates` alone ends the phase."""
    return True


RULES: dict[str, Rule] = {
    "ensemble": Rule(lambda e: e.values, most_improve),
    "one_model": Rule(lambda e: e.values[:1], most_improve),
    "real": Rule(lambda e: np.array([e.real()]), most_improve),
    "trpo_mean": Rule(lambda e: e.rollouts, most_improve),
    "no_early": Rule(lambda e: e.values, always),
}
