"""The ways to search for a better policy in the fitted ensemble, in one table: `SEARCHES`.

A search is what an iteration does besides collecting, fitting and recording, which all share.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.model.ensemble import Ensemble
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.improver_table import IMPROVERS
from metrpo.policy.value.value_table import Baseline
from metrpo.policy_phase import PhaseInfo
from metrpo.run.clock import Clock
from metrpo.stages import actor_critic_search as by_critics
from metrpo.stages import policy_search as in_phases
from metrpo.stages.state import State
from metrpo.types import Array
from metrpo.world import collection as real
from metrpo.world.task import Task

Fresh = Callable[[Config, Task, Array], tuple[Policy, Baseline]]
"""(config, task, key) -> a policy, and what it learns with, that have learned nothing."""
Explorer = Callable[[Config, Task, State], Callable[[np.random.Generator], real.Act]]
"""What acts in real episodes."""


class ImprovePolicy(Protocol):
    """The signature of every search."""

    def __call__(
        self, config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock
    ) -> tuple[Policy, Baseline, PhaseInfo]:
        """The policy, what it learns with and what happened; `state` holds the data that the ensemble is fitted to."""


class PolicySearch(NamedTuple):
    """A row of the table."""

    fresh: Fresh
    explorer: Explorer
    improve: ImprovePolicy


_IN_PHASES = PolicySearch(in_phases.fresh, in_phases.explorer, in_phases.improve_policy)
"""The paper's: updates on imagined episodes until the models no longer agree that the policy improves."""
_BY_CRITICS = PolicySearch(by_critics.fresh, by_critics.explorer, by_critics.improve_policy)
SEARCHES: dict[str, PolicySearch] = {**dict.fromkeys(IMPROVERS, _IN_PHASES), "actor-critic": _BY_CRITICS}
"""By `Config.improver`."""


def improve_policy(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock
) -> tuple[Policy, Baseline, PhaseInfo]:
    """As the settings say."""
    return SEARCHES[config.improver].improve(config, task, state, ensemble, progress, clock)
