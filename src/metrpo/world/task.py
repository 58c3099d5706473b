"""A task: an environment, its reward and termination as formulas, and its horizon."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium

from metrpo.errors import TaskError
from metrpo.history import History
from metrpo.limits import NONE, Limits
from metrpo.types import EndFormula, RewardFormula
from metrpo.world.env_wrapper import refuse_running_statistics
from metrpo.world.interface import Interface
from metrpo.world.size_limits import require_horizon, require_size


@dataclass(frozen=True)
class Task:
    """What the learner may know of the real system: all but its dynamics."""

    name: str
    """As typed on the command line, "Swimmer"."""
    env_id: str | None
    """Gymnasium id, "metrpo/Swimmer-v0"; None, without `make`: only another program plays it (see `metrpo init`)."""
    state_size: int
    """S, with the history."""
    action_size: int
    """A; actions lie in [-1, 1]."""
    horizon: int
    """T, steps per episode."""
    reward: RewardFormula | None
    """r(s, a, s'); None: learned, as one more output of every model."""
    terminated: EndFormula | Literal["learned"] | None = None
    """Ends the episode in s'; "learned": one more output of every model; None: never."""
    unseen: tuple[int, ...] = ()
    """State dimensions kept from the dynamics networks' input (global position), but predicted all the same."""
    description: str = ""
    """One line for `metrpo tasks`."""
    make: Callable[..., gymnasium.Env] | None = None
    """Makes the environment, in place of `gymnasium.make(env_id)`."""
    interface: Interface | None = None
    """The layout of observations and actions, for a policy's file; None: unknown."""
    limits: Limits = NONE
    """Limits on every policy's actions."""
    history: int = 1
    """N, the observations that a state holds, with the N-1 actions between them (`metrpo.history`). The setting
    `history` changes it (`world.history_env`): leave it at 1 in your own tasks."""

    reward_error: float = 0.0
    """By how much a single reward of the formula may differ from the environment's."""

    def __post_init__(self) -> None:
        require_size(self.name, self.state_size)
        require_horizon(self.name, self.horizon)
        try:
            self.layout  # noqa: B018  # raises where there is none
        except ValueError as error:
            raise TaskError(f"{self.name}: history: {error}; leave it at 1 and set --history") from None

    @property
    def layout(self) -> History:
        """How states are composed of observations and actions."""
        return History.of_state(self.history, self.state_size, self.action_size)

    @property
    def observation_size(self) -> int:
        """O, of what the environment shows at a time: the state, unless that holds a history."""
        return self.layout.observation_size

    @property
    def carried(self) -> tuple[int, ...]:
        """[S - O], indices into state and action, [S + A], of what models need not predict of the next state."""
        return self.layout.carried

    @property
    def playable(self) -> bool:
        """Whether there is an environment to step."""
        return self.env_id is not None or self.make is not None

    @property
    def learned(self) -> tuple[str, ...]:
        """What the models predict besides the observation, in the order of their outputs: "reward", "end"."""
        return ("reward",) * (self.reward is None) + ("end",) * (self.terminated == "learned")

    @property
    def predicted(self) -> int:
        """D, of all that the models predict."""
        return self.observation_size + len(self.learned)

    def make_env(self, **kwargs: Any) -> gymnasium.Env:
        """A fresh environment with the time limit of the task (`kwargs` such as `render_mode="rgb_array"`).

        Raises `TaskError` when there is none, and for wrappers with running statistics (`world.env_wrapper`).
        """
        env = self._made(**kwargs)
        refuse_running_statistics(env, self.name)
        return env

    def _made(self, **kwargs: Any) -> gymnasium.Env:
        if self.make is not None:
            return self.make(**kwargs)
        self.require_playable()
        assert self.env_id is not None
        return gymnasium.make(self.env_id, **kwargs)

    def require_playable(self) -> None:
        """Raises `TaskError` when there is no environment to step."""
        if not self.playable:
            raise TaskError(
                f"{self.name}: expected an environment, got none: your own program plays its episodes "
                "(metrpo.append_episode, or metrpo collect DIR --data FILE) and metrpo improve DIR learns from them"
            )
