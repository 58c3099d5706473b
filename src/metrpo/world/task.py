"""A task: an environment, its reward and termination as formulas, and its horizon."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium

from metrpo.errors import TaskError
from metrpo.limits import NONE, Limits
from metrpo.types import Array
from metrpo.world.env_wrapper import refuse_running_statistics
from metrpo.world.interface import Interface
from metrpo.world.size_limits import require_horizon, require_size


@dataclass(frozen=True)
class Task:
    """What the learner may know of the real system: everything but its dynamics."""

    name: str
    """As typed on the command line, "Swimmer"."""
    env_id: str | None
    """Gymnasium id, "metrpo/Swimmer-v0"; None, and no `make`: only another program can play it (see `metrpo init`)."""
    state_size: int
    """S"""
    action_size: int
    """A; actions lie in [-1, 1]."""
    horizon: int
    """T, steps per episode."""
    reward: Callable[[Array, Array, Array], Array] | None
    """r(s, a, s'): [..., S], [..., A], [..., S] -> [...]; `a` within [-1, 1]; NumPy or JAX arrays alike. None: learned,
    as one more output of every model."""
    terminated: Callable[[Array], Array] | Literal["learned"] | None = None
    """Ends the episode in s': [..., S] -> [...] of bool; "learned": one more output of every model; None: never."""
    unseen: tuple[int, ...] = ()
    """State dimensions kept from the dynamics networks' input (global position), but predicted all the same."""
    description: str = ""
    """One line for `metrpo tasks`."""
    make: Callable[..., gymnasium.Env] | None = None
    """Makes the environment, in place of `gymnasium.make(env_id)`."""
    interface: Interface | None = None
    """What the environment shows and takes, as a policy's file says it; None: unknown."""
    limits: Limits = NONE
    """What actions every policy is held to."""

    def __post_init__(self) -> None:
        require_size(self.name, self.state_size)
        require_horizon(self.name, self.horizon)

    @property
    def playable(self) -> bool:
        """Whether there is an environment to step."""
        return self.env_id is not None or self.make is not None

    @property
    def learned(self) -> tuple[str, ...]:
        """What the models predict besides the state, in the order of their outputs: "reward", "end"."""
        return ("reward",) * (self.reward is None) + ("end",) * (self.terminated == "learned")

    def make_env(self, **kwargs: Any) -> gymnasium.Env:
        """A fresh environment with the time limit of the task (`kwargs` such as `render_mode="rgb_array"`).

        Raises `TaskError` when there is none, and for wrappers with running statistics (`world.env_wrapper`).
        """
        made = self._made(**kwargs)
        refuse_running_statistics(made, self.name)
        return made

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
                f"{self.name}: expected an environment, got none: its episodes come from another program "
                "(metrpo.append_episode, or metrpo collect DIR --data FILE) and metrpo improve DIR learns from them"
            )
