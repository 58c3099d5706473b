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
        self, config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock, steps: int
    ) -> tuple[Policy, Baseline, PhaseInfo]:
        """The policy, what it learns with and what happened.

        `state` holds the data that the ensemble is fitted to; the iteration collected `steps` real steps of it.
        """


class PolicySearch(NamedTuple):
    """A row of the table."""

    fresh: Fresh
    explorer: Explorer
    improve: ImprovePolicy
    most_updates: Callable[[Config, int], int]
    """(config, real steps that the iteration collected) -> the updates that it makes at most."""


_IN_PHASES = PolicySearch(
    in_phases.fresh, in_phases.explorer, in_phases.improve_policy, lambda config, steps: config.validate.max_updates
)
"""The paper's: updates on imagined episodes until the models no longer agree that the policy improves."""
_BY_CRITICS = PolicySearch(by_critics.fresh, by_critics.explorer, by_critics.improve_policy, by_critics.updates_for)
SEARCHES: dict[str, PolicySearch] = {**dict.fromkeys(IMPROVERS, _IN_PHASES), "actor-critic": _BY_CRITICS}
"""By `Config.improver`."""


def improve_policy(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock, steps: int
) -> tuple[Policy, Baseline, PhaseInfo]:
    """As the settings say; `progress` hears of it as the stage "improve"."""
    search = SEARCHES[config.improver]
    progress.stage("improve", search.most_updates(config, steps))
    return search.improve(config, task, state, ensemble, progress, clock, steps)
