"""Health checks in plain words: what was measured, since when, what it means and what helps.

Pure functions from the rows of metrics.csv and the settings to a list of findings. docs/report.md says on how many of
the runs under results/ each one fires.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from metrpo.checks import model_checks, policy_checks
from metrpo.checks.finding import Concern
from metrpo.config import Config
from metrpo.run.metrics import Row

CHECKS: tuple[Callable[[Sequence[Row], Config], Concern | None], ...] = (
    model_checks.not_finite,
    model_checks.model_exploited,
    policy_checks.not_evaluated,
    policy_checks.return_fell,
    model_checks.diverged,
    policy_checks.updates_rejected,
    policy_checks.std_collapsed,
    policy_checks.saturated,
    model_checks.models_blind,
    model_checks.unfit_dimensions,
    model_checks.member_apart,
    model_checks.loss_rises,
    policy_checks.never_stopped,
    policy_checks.nothing_accepted,
    model_checks.end_untrusted,
    policy_checks.few_episodes,
    policy_checks.failed_episodes,
)
"""To add a check, add a row."""
COMPARED = (policy_checks.no_improvement, policy_checks.no_skill)
"""Those that also ask what no skill earns."""


def examine(
    rows: Sequence[Row], config: Config, yardsticks: Mapping[str, float] = MappingProxyType({})
) -> list[Concern]:
    """The findings about a run with these rows, warnings first; none where it is healthy.

    `yardsticks` are the returns of unskilled ways to act, by name.
    """
    if not rows:
        return []
    with np.errstate(all="ignore"):  # a check of its own reports what is not finite
        measured = [check(rows, config) for check in CHECKS]
        compared = [check(rows, config, yardsticks) for check in COMPARED]
    concerns = [concern for concern in (*compared, *measured) if concern is not None]
    return sorted(concerns, key=lambda concern: concern.level != "warning")
