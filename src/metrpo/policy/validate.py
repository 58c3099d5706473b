"""When to stop improving the policy: the paper's rule (section 5, "Policy validation").

The rule is a small state machine on the host: it sees the values of every validated policy and says which policy is
the accepted one and whether to go on. Rules stand in one table, `RULES`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from metrpo.config import ValidateConfig
from metrpo.types import Array


class Verdict(NamedTuple):
    """What a validation found."""

    accepted: bool
    """This policy is the new reference."""
    fraction_improved: float
    """Share of the models in which it beats the reference."""


def fraction_improved(values: Array, reference: Array) -> float:
    """Share of the models whose value [K] exceeds the reference's [K] (paper, eq. 5); ties and NaN are no improvement.

    A model whose reference is NaN (its rollouts diverged) counts as improved when its value is finite again.
    """
    new, old = np.asarray(values), np.asarray(reference)
    return float(np.mean(np.isfinite(new) & ((new > old) | np.isnan(old))))


def ensemble_rule(values: Array, reference: Array, config: ValidateConfig) -> Verdict:
    """Accept while at least `threshold` of the models improve."""
    fraction = fraction_improved(values, reference)
    return Verdict(fraction >= config.threshold, fraction)


RULES: dict[str, Callable[[Array, Array, ValidateConfig], Verdict]] = {"ensemble": ensemble_rule}
