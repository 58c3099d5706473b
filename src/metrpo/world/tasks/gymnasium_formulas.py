"""Tasks whose reward and termination are known formulas: Gymnasium's own, and those of the benchmark MBBL (`mbbl`).

Each formula is read off the source of the environment named, in terms of its observation: rewards take states [..., S],
actions [..., A] in [-1, 1] and next states [..., S] and give [...], terminations take next states and give [...] of
bool. Where a reward needs the distance moved, the environment is made with global positions in its observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import mujoco

from metrpo.types import Array, EndFormula, RewardFormula
from metrpo.world.tasks import mbbl


@dataclass(frozen=True)
class Known:
    """An environment with its reward and termination as formulas."""

    name: str
    """As the user types it, "Swimmer-v5" or "mbbl/Swimmer"."""
    make: Callable[..., gymnasium.Env[Any, Any]]
    """Makes the environment, with its own range of actions and its time limit; takes `render_mode`."""
    reward: RewardFormula
    terminated: EndFormula | None = None
    """Ends the episode in s'; None: never."""
    unseen: tuple[int, ...] = ()
    """State dimensions on which the dynamics do not depend: global positions."""
    description: str = ""
    """One line."""
    added: int = 0
    """Global positions at the head of the observation, which the environment leaves out unless asked for them."""
    reward_error: float = 0.0
    """By how much a single reward may differ from the environment's."""


def _squared(x: Array) -> Array:
    return (x * x).sum(axis=-1)


def _length(x: Array) -> Array:
    return x.__array_namespace__().sqrt(_squared(x))


def _finite(x: Array) -> Array:
    return x.__array_namespace__().isfinite(x).all(axis=-1)


def _alive(terminated: EndFormula, next_state: Array) -> Array:
    """1 where the episode goes on, else 0."""
    return (~terminated(next_state)).astype(next_state.dtype)


# ---------------------------------------------------------------- classic control


def _pendulum_reward(state: Array, action: Array, next_state: Array) -> Array:
    """Pendulum-v1: -(th^2 + 0.1 thdot^2 + 0.001 torque^2), th in [-pi, pi] and thdot before the step, torque 2 a."""
    angle = state.__array_namespace__().arctan2(state[..., 1], state[..., 0])
    return -(angle**2 + 0.1 * state[..., 2] ** 2 + 0.001 * (2.0 * action[..., 0]) ** 2)


def _car_terminated(next_state: Array) -> Array:
    """MountainCarContinuous-v0: at the flag at 0.45, not rolling back."""
    return (next_state[..., 0] >= 0.45) & (next_state[..., 1] >= 0)


def _car_reward(state: Array, action: Array, next_state: Array) -> Array:
    """MountainCarContinuous-v0: 100 at the flag - 0.1 a^2."""
    return 100.0 * _car_terminated(next_state).astype(next_state.dtype) - 0.1 * action[..., 0] ** 2


# ---------------------------------------------------------------- pendulums and arms on MuJoCo


def _pole_terminated(next_state: Array) -> Array:
    """InvertedPendulum-v5: leaning by more than 0.2 rad, or not finite."""
    return ~(_finite(next_state) & (abs(next_state[..., 1]) <= 0.2))


def _pole_reward(state: Array, action: Array, next_state: Array) -> Array:
    """InvertedPendulum-v5: 1 while up."""
    return _alive(_pole_terminated, next_state)


def _tip(state: Array) -> tuple[Array, Array]:
    """InvertedDoublePendulum-v5: x and height of the upper end; both poles are 0.6 m, the angles count from below."""
    x, sin1, sin2, cos1, cos2 = (state[..., i] for i in range(5))
    return x + 0.6 * (sin1 + sin1 * cos2 + cos1 * sin2), 0.6 * (cos1 + cos1 * cos2 - sin1 * sin2)


def _poles_terminated(next_state: Array) -> Array:
    """InvertedDoublePendulum-v5: the tip not above 1 m."""
    return _tip(next_state)[1] <= 1.0


def _poles_reward(state: Array, action: Array, next_state: Array) -> Array:
    """InvertedDoublePendulum-v5: 10 while up - 0.01 x^2 - (height - 2)^2 of the tip - 0.001 w1^2 - 0.005 w2^2.

    The observation clips the rates w to +-10, the environment's reward does not. It takes the tip from before the last
    stage of MuJoCo's integration, as all the rewards below that say "nearly" do: the observation is from after it.
    """
    x, height = _tip(next_state)
    rates = 1e-3 * next_state[..., 6] ** 2 + 5e-3 * next_state[..., 7] ** 2
    return 10.0 * _alive(_poles_terminated, next_state) - 0.01 * x**2 - (height - 2.0) ** 2 - rates


def _reacher_reward(state: Array, action: Array, next_state: Array) -> Array:
    """Reacher-v5: -|fingertip - target| - ||a||^2; both are at the same height, so the observed x and y suffice."""
    return -_length(next_state[..., 8:10]) - _squared(action)


def _pusher_reward(state: Array, action: Array, next_state: Array) -> Array:
    """Pusher-v5: -|object - goal| - 0.5 |object - tips of the arm| - 0.1 ||2 a||^2."""
    tips, thing, goal = (next_state[..., i : i + 3] for i in (14, 17, 20))
    return -_length(thing - goal) - 0.5 * _length(thing - tips) - 0.1 * _squared(2.0 * action)


# ---------------------------------------------------------------- walkers on MuJoCo


def _hopper_terminated(next_state: Array) -> Array:
    """Hopper-v5: z <= 0.7, |pitch| >= 0.2, or an entry from the pitch on of 100 or more.

    The environment looks at the rates as they are; the observation clips them to +-10, so that they never end it here.
    """
    height, pitch = next_state[..., 1], next_state[..., 2]
    return ~((abs(next_state[..., 2:]) < 100).all(axis=-1) & (height > 0.7) & (abs(pitch) < 0.2))


def _walker_terminated(next_state: Array) -> Array:
    """Walker2d-v5: z out of (0.8, 2), or |pitch| >= 1."""
    height, pitch = next_state[..., 1], next_state[..., 2]
    return ~((height > 0.8) & (height < 2.0) & (abs(pitch) < 1.0))


def _ant_terminated(next_state: Array) -> Array:
    """Ant-v5: z out of [0.2, 1], or a position or rate that is not finite."""
    height = next_state[..., 2]
    return ~(_finite(next_state[..., :29]) & (height >= 0.2) & (height <= 1.0))


def _humanoid_terminated(next_state: Array) -> Array:
    """Humanoid-v5: z out of (1, 2)."""
    return ~((next_state[..., 2] > 1.0) & (next_state[..., 2] < 2.0))


def _forward(seconds: float, control: float, terminated: EndFormula | None = None) -> RewardFormula:
    """(x' - x) / seconds - control ||a||^2, and 1 while alive where something ends the episode."""

    def reward(state: Array, action: Array, next_state: Array) -> Array:
        walked = (next_state[..., 0] - state[..., 0]) / seconds - control * _squared(action)
        return walked if terminated is None else walked + _alive(terminated, next_state)

    return reward


_ant_walk = _forward(0.05, 0.5, _ant_terminated)


def _ant_reward(state: Array, action: Array, next_state: Array) -> Array:
    """Ant-v5, nearly: (x' - x) / 0.05 s - 0.5 ||a||^2 + 1 while alive - 5e-4 ||contact forces, within +-1 each||^2.

    A single reward is off by up to 0.1 where a foot hits the ground; over an episode the errors cancel.
    """
    forces = next_state.__array_namespace__().clip(next_state[..., 29:], -1.0, 1.0)
    return _ant_walk(state, action, next_state) - 5e-4 * _squared(forces)


_TORSO = {"mass": 8.907462370478262, "x": -0.0025393839642605218, "z": 0.034662591112156124}
"""kg, and m from its frame to its centre of mass, of the torso in Gymnasium's humanoid.xml."""


def _centre_x(state: Array) -> Array:
    """x of the humanoid's centre of mass: its torso's, less that one's offset from it, which the observation holds."""
    w, x, y, z = (state[..., i] for i in range(3, 7))
    ahead, up = w * w + x * x - y * y - z * z, 2.0 * (x * z + w * y)
    turned = (ahead * _TORSO["x"] + up * _TORSO["z"]) / _squared(state[..., 3:7])
    return state[..., 0] + turned - state[..., 53] / _TORSO["mass"]


def _humanoid_reward(state: Array, action: Array, next_state: Array) -> Array:
    """Humanoid-v5, nearly: 1.25 v_x of the centre of mass - 0.1 ||0.4 a||^2 + 5 while alive - contact forces' cost.

    v_x is the distance over 0.015 s, the cost min(5e-7 ||forces||^2, 10). A single reward is off by up to 0.01.
    """
    speed = (_centre_x(next_state) - _centre_x(state)) / 0.015
    contact = next_state.__array_namespace__().minimum(5e-7 * _squared(next_state[..., 272:]), 10.0)
    return 1.25 * speed - 0.1 * _squared(0.4 * action) + 5.0 * _alive(_humanoid_terminated, next_state) - contact


# ---------------------------------------------------------------- the table


def _make(name: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    previous = mujoco.get_mju_user_warning()
    # MuJoCo deprecates an attribute of Gymnasium's cheetah and still obeys it: it would write a log file at every make.
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        return gymnasium.make(name, disable_env_checker=True, **kwargs)
    finally:
        mujoco.set_mju_user_warning(previous)


def _known(
    name: str,
    description: str,
    reward: RewardFormula,
    terminated: EndFormula | None = None,
    unseen: tuple[int, ...] = (),
    reward_error: float = 0.0,
) -> Known:
    """A task of Gymnasium; where global positions are unseen, they are added to the observation."""
    added = {"exclude_current_positions_from_observation": False} if unseen else {}
    return Known(
        name, partial(_make, name, **added), reward, terminated, unseen, description, len(unseen), reward_error
    )


_hopper, _walker = (_forward(0.008, 1e-3, ends) for ends in (_hopper_terminated, _walker_terminated))
_TASKS = (
    _known("Pendulum-v1", "swing a pendulum up", _pendulum_reward),
    _known("MountainCarContinuous-v0", "drive out of a valley", _car_reward, _car_terminated),
    _known("InvertedPendulum-v5", "balance a pole on a cart", _pole_reward, _pole_terminated),
    _known("InvertedDoublePendulum-v5", "balance two poles on a cart", _poles_reward, _poles_terminated),
    _known("Reacher-v5", "move a fingertip to a target", _reacher_reward),
    _known("Pusher-v5", "push an object to a goal", _pusher_reward),
    _known("Swimmer-v5", "3 links swim along x in a viscous fluid", _forward(0.04, 1e-4), None, (0, 1)),
    _known("HalfCheetah-v5", "two legs in a plane run along x", _forward(0.05, 0.1), None, (0,)),
    _known("Hopper-v5", "one leg hops along x", _hopper, _hopper_terminated, (0,)),
    _known("Walker2d-v5", "two legs in a plane walk along x", _walker, _walker_terminated, (0,)),
    # MuJoCo's bodies lie where the last of the four stages of its integration saw them, the observed positions are what
    # came out of it: the distance that the next two rewards read off bodies is no exact function of the observation.
    _known("Ant-v5", "four legs walk along x", _ant_reward, _ant_terminated, (0, 1), 0.15),
    _known("Humanoid-v5", "a humanoid walks along x", _humanoid_reward, _humanoid_terminated, (0, 1), 0.02),
    *(
        Known(f"mbbl/{name}", partial(mbbl.make, name), t.reward, None, (), t.description)
        for name, t in mbbl.TASKS.items()
    ),
)
KNOWN: dict[str, Known] = {known.name: known for known in _TASKS}
"""By name."""
