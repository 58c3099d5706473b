"""The layout of a task's observations and actions, for users of a policy without metrpo."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np

_LONGEST = 80
"""Characters of a part's description."""


@dataclass(frozen=True)
class Interface:
    """The layout of a task's states, and its environment's own range of actions."""

    observation: tuple[tuple[int, str], ...]
    """The parts of a state, in order: size and description."""
    action_low: tuple[float, ...]
    """[A], the environment's action for -1."""
    action_high: tuple[float, ...]
    """[A], the environment's action for 1."""


def of_env(env: gymnasium.Env[Any, Any], name: str) -> Interface:
    """The interface of an environment with Boxes, or Dicts and Tuples of them, as `world.env_wrapper` flattens them."""
    actions: Any = env.action_space
    low, high = (tuple(map(float, np.ravel(bound))) for bound in (actions.low, actions.high))
    return Interface(tuple(_parts(env.observation_space, f"the observation of {name}")), low, high)


def _parts(space: Any, called: str) -> Iterator[tuple[int, str]]:
    inner: Any = getattr(space, "spaces", None)
    if inner is None:
        yield int(np.prod(space.shape)), called if len(called) <= _LONGEST else f"{called[: _LONGEST - 3]}..."
        return
    for key, part in inner.items() if isinstance(inner, dict) else enumerate(inner):
        yield from _parts(part, f"{called}[{key!r}]")


def with_positions(interface: Interface, name: str, positions: int) -> Interface:
    """The interface of one of Gymnasium's walkers, whose first numbers metrpo has asked for in addition."""
    axes = " and ".join("xyz"[:positions])
    added = f"global {axes}, added by metrpo: exclude_current_positions_from_observation=False"
    rest = sum(size for size, _ in interface.observation) - positions
    return replace(
        interface, observation=((positions, added), (rest, f"the observation of {name} as Gymnasium makes it"))
    )


def of_paper_task(name: str, action_size: int) -> Interface:
    """The interface of one of the paper's tasks, whose states `world.tasks.rllab` puts together."""
    return Interface(_PAPER[name], (-1.0,) * action_size, (1.0,) * action_size)


def _com(axes: str, rates: str, angles: tuple[int, str], speeds: tuple[int, str]) -> tuple[tuple[int, str], ...]:
    return (
        (len(axes), f"{', '.join(axes)} of the centre of mass (m)"),
        angles,
        (len(rates), f"velocity of the centre of mass along {', '.join(rates)} (m/s)"),
        speeds,
    )


def _planar(axes: str, rates: str, joints: int, root: str) -> tuple[tuple[int, str], ...]:
    angles, speeds = f"{root} and joint angles (rad)", f"rates of {root} and joints (rad/s)"
    return _com(axes, rates, (1 + joints, angles), (1 + joints, speeds))


_ANT = _com(
    "xyz",
    "xyz",
    (12, "orientation of the torso (quaternion w, x, y, z), joint angles (rad)"),
    (11, "angular velocity of the torso, rates of the joints (rad/s)"),
)
_HUMANOID = (
    (21, "orientation of the torso (quaternion w, x, y, z), joint angles (rad)"),
    (23, "velocity (m/s) and angular velocity of the torso, rates of the joints (rad/s)"),
    (3, "x, y, z of the head (m)"),
)
_PAPER = {
    "Swimmer": _planar("xy", "xy", 2, "heading"),
    "Snake": _planar("xy", "xy", 4, "heading"),
    "Hopper": _planar("z", "xz", 3, "pitch"),
    "HopperUpright": _planar("z", "xz", 3, "pitch"),
    "HalfCheetah": _planar("xz", "xz", 6, "pitch"),
    "Ant": _ANT,
    "Humanoid": _HUMANOID,
    "HumanoidStandup": _HUMANOID,
}
