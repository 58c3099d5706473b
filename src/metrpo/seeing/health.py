"""Whether a run is healthy, in plain words: what was measured, since when, what it means and what helps.

Pure functions from the rows of metrics.csv and the settings to a list of concerns. docs/report.md says on how many of
the runs under results/ each one fires.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from metrpo.config import Config
from metrpo.run.metrics import Row
from metrpo.seeing import model_signs, policy_signs
from metrpo.seeing.concern import Concern

CHECKS: tuple[Callable[[Sequence[Row], Config], Concern | None], ...] = (
    model_signs.not_finite,
    model_signs.model_exploited,
    policy_signs.not_evaluated,
    policy_signs.return_fell,
    policy_signs.no_improvement,
    model_signs.diverged,
    policy_signs.updates_rejected,
    policy_signs.std_collapsed,
    policy_signs.saturated,
    model_signs.models_blind,
    model_signs.unfit_dimensions,
    model_signs.member_apart,
    model_signs.loss_rises,
    policy_signs.never_stopped,
    policy_signs.nothing_accepted,
    model_signs.end_untrusted,
    policy_signs.few_episodes,
    policy_signs.failed_episodes,
)
"""Extend them by adding a row."""


def examine(
    rows: Sequence[Row], config: Config, yardsticks: Mapping[str, float] = MappingProxyType({})
) -> list[Concern]:
    """What there is to say about a run that has these rows, warnings first; nothing where it is healthy.

    `yardsticks` are the returns of ways to act that have learned nothing, by name.
    """
    if not rows:
        return []
    with np.errstate(all="ignore"):  # what is not finite has a sign of its own
        signs = [*(check(rows, config) for check in CHECKS), policy_signs.no_skill(rows, config, yardsticks)]
    found = [sign for sign in signs if sign is not None]
    return sorted(found, key=lambda concern: concern.level != "warning")
