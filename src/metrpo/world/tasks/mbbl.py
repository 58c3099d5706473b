"""Six tasks of the benchmark MBBL (Wang et al. 2019, "Benchmarking Model-Based Reinforcement Learning").

Every reward is read from the state in which a step starts, nothing ends an episode but the clock, and starts are Gym's.
The bodies are those that Gymnasium ships. v_x is q'[0], the speed of the root joint and not of the centre of mass: the
entry of the observation that the authors' code reads. a is the action in [-1, 1]. Units are MuJoCo's.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv, PendulumEnv
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from metrpo.errors import TaskError
from metrpo.types import Array, RewardFormula

_Step = tuple[NDArray[Any], float, bool, bool, dict[str, Any]]
MAX_TORQUE = 2.0
"""N m, the torque of Gym's Pendulum at an action of 1."""


# ---------------------------------------------------------------- rewards, NumPy and JAX alike


def _forward(speed: int, control: float, height: float | None = None) -> RewardFormula:
    """r = s[speed] - control ||a||^2, and where a `height` is aimed at, - 3 (s[0] - height)^2 + 1."""

    def reward(state: Array, action: Array, next_state: Array) -> Array:
        forward = state[..., speed] - control * (action * action).sum(axis=-1)
        return forward if height is None else forward - 3.0 * (state[..., 0] - height) ** 2 + 1.0

    return reward


def pendulum_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = -(cos th + 0.1 |sin th| + 0.1 thdot^2 + 0.001 torque^2), which is best (1) hanging down: th = 0 is up.

    `state` and `next_state` [..., 3] (cos th, sin th, thdot), `action` [..., 1]; returns [...]. Source: MBBL's code.
    """
    torque = MAX_TORQUE * action[..., 0]
    return -(state[..., 0] + 0.1 * abs(state[..., 1]) + 0.1 * state[..., 2] ** 2 + 0.001 * torque**2)


def cartpole_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = cos th - 0.01 x^2.

    `state` and `next_state` [..., 4] (x, x', th, th'), `action` [..., 1]; returns [...]. Source: MBBL's code.
    """
    return state.__array_namespace__().cos(state[..., 2]) - 0.01 * state[..., 0] ** 2


# ---------------------------------------------------------------- MuJoCo's robots


@dataclass(frozen=True)
class _Robot:
    asset: str
    frame_skip: int
    hidden: int
    """Leading positions that the observation leaves out."""
    noise: float
    """A start is q0 + uniform +-noise."""
    normal_rates: bool
    """q' starts as noise N(0, I) instead of uniform +-noise."""
    has_tip: bool = False
    """The state ends with the x velocity of the front end of the first link."""


_ROBOTS = {
    "HalfCheetah": _Robot("half_cheetah.xml", 5, 1, 0.1, True),
    "Swimmer": _Robot("swimmer.xml", 4, 2, 0.1, False, True),
    "Hopper": _Robot("hopper.xml", 4, 1, 0.005, False),
    "Ant": _Robot("ant.xml", 5, 2, 0.1, True),
}


class MbblRobot(MujocoEnv):
    """One of MBBL's tasks on MuJoCo: "HalfCheetah", "Swimmer", "Hopper" or "Ant".

    Observation [S] float64: positions without the global ones, velocities, and for Swimmer the x velocity (m/s) of the
    tip of its head, a finite difference over the last step. Raises `TaskError` when the simulation diverges.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # noqa: RUF012

    def __init__(self, name: str, render_mode: str | None = None, **kwargs: Any) -> None:
        self._name, self._robot, self._reward = name, _ROBOTS[name], TASKS[name].reward
        super().__init__(self._robot.asset, self._robot.frame_skip, None, render_mode, **kwargs)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.dt)}
        self._tip_speed = 0.0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, self._observe().shape, np.float64)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        spec = mujoco.MjSpec.from_file(self.fullpath)
        if self._robot.has_tip:
            spec.body("torso").add_site(name="tip", pos=[1.5, 0, 0])
        # MuJoCo would restart a diverged simulation from q0 in silence, and the jump would pass for dynamics.
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        with warnings.catch_warnings():
            # MuJoCo deprecates an attribute of Gymnasium's cheetah and still obeys it: nothing for a user to act on.
            warnings.filterwarnings("ignore", message=".*settotalmass")
            model = spec.compile()
        view = model.vis.global_
        view.offwidth, view.offheight = max(view.offwidth, self.width), max(view.offheight, self.height)
        return model, mujoco.MjData(model)

    def reset_model(self) -> NDArray[np.float64]:
        """A start near the robot's initial pose: state [S]."""
        noise, rng = self._robot.noise, self.np_random
        qpos = self.init_qpos + rng.uniform(-noise, noise, self.model.nq)
        rates = rng.standard_normal(self.model.nv) if self._robot.normal_rates else rng.uniform(-1, 1, self.model.nv)
        # The noise has stretched the quaternion; MuJoCo would normalise it in the first step, unseen by the state.
        mujoco.mj_normalizeQuat(self.model, qpos)
        self.set_state(qpos, self.init_qvel + noise * rates)
        # No step has been made. MBBL's code leaves the value of the episode before here.
        self._tip_speed = 0.0
        return self._observe()

    def step(self, action: NDArray[np.float32]) -> _Step:  # type: ignore[override]
        """Next state [S], reward, False, False and an empty info after one control interval."""
        state, before = self._observe(), self._tip()
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        # mj_step leaves the positions of sites as they were before its last integration.
        mujoco.mj_kinematics(self.model, self.data)
        self._tip_speed = (self._tip() - before) / self.dt
        next_state = self._observe()
        if not np.isfinite(next_state).all():
            raise TaskError(f"mbbl/{self._name}: the simulation diverged; reset() starts a new episode")
        if self.render_mode == "human":
            self.render()
        return next_state, float(self._reward(state, np.asarray(action, np.float64), next_state)), False, False, {}

    def _tip(self) -> float:
        return float(self.data.site("tip").xpos[0]) if self._robot.has_tip else 0.0

    def _observe(self) -> NDArray[np.float64]:
        extra = [self._tip_speed] if self._robot.has_tip else []
        return np.concatenate([self.data.qpos[self._robot.hidden :], self.data.qvel, extra])


# ---------------------------------------------------------------- the classics


class Pendulum(PendulumEnv):
    """Gym's pendulum with MBBL's reward.

    Observation [3] float32 (cos th, sin th, thdot), action [1] a torque within +-2 N m.
    """

    def step(self, u: NDArray[np.float32]) -> _Step:
        """Next state [3], reward, False, False and an empty info after 0.05 s."""
        angle, rate = self.state
        state, torque = self._get_obs(), float(np.clip(u, -self.max_torque, self.max_torque)[0])
        faster = rate + (1.5 * self.g / self.l * np.sin(angle) + 3.0 / (self.m * self.l**2) * torque) * self.dt
        # Pendulum-v0, which MBBL ran, limited the speed after turning by it; v1 limits it before.
        self.state = np.array([angle + faster * self.dt, np.clip(faster, -self.max_speed, self.max_speed)])
        self.last_u = torque
        if self.render_mode == "human":
            self.render()
        next_state = self._get_obs()
        return next_state, float(pendulum_reward(state, np.array([torque / MAX_TORQUE]), next_state)), False, False, {}


class CartPole(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Gym's cart-pole with MBBL's reward, where nothing ends an episode.

    Observation [4] float32 (x, x', th, th'), unbounded; action [1]: above 0 pushes right, else left, always with 10 N.
    """

    metadata: dict[str, Any] = CartPoleEnv.metadata

    def __init__(self, render_mode: str | None = None) -> None:
        self._gym, self.render_mode = CartPoleEnv(render_mode=render_mode), render_mode
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """A start with all four within +-0.05: state [4] and an empty info."""
        super().reset(seed=seed)
        self._gym.np_random = self.np_random
        return self._gym.reset(options=options)

    def step(self, action: NDArray[np.float32]) -> _Step:
        """Next state [4], reward, False, False and an empty info after 0.02 s."""
        state = np.asarray(self._gym.state, np.float32)
        self._gym.steps_beyond_terminated = None  # Gym would warn that it ended the episode long ago
        next_state = self._gym.step(int(action[0] > 0))[0]
        return next_state, float(cartpole_reward(state, action, next_state)), False, False, {}

    def render(self) -> Any:
        """What Gym's cart-pole renders."""
        return self._gym.render()

    def close(self) -> None:
        """Closes Gym's cart-pole."""
        self._gym.close()


# ---------------------------------------------------------------- the table


@dataclass(frozen=True)
class MbblTask:
    """One of the benchmark's tasks."""

    env: Callable[..., gymnasium.Env[Any, Any]]
    """Without a time limit."""
    horizon: int
    """T, steps per episode."""
    reward: RewardFormula
    """r(s, a, s'): [..., S], [..., A], [..., S] -> [...]."""
    description: str


TASKS: dict[str, MbblTask] = {
    "Pendulum": MbblTask(Pendulum, 200, pendulum_reward, "hang still"),
    "CartPole": MbblTask(CartPole, 200, cartpole_reward, "balance a pole on a cart"),
    "HalfCheetah": MbblTask(MbblRobot, 1000, _forward(8, 0.1), "two legs in a plane run along x"),
    "Swimmer": MbblTask(MbblRobot, 1000, _forward(8, 1e-4), "3 links swim head first along x"),
    "Hopper": MbblTask(MbblRobot, 1000, _forward(5, 0.1, 1.3), "one leg hops along x at a height of 1.3 m"),
    "Ant": MbblTask(MbblRobot, 1000, _forward(13, 0.1, 0.57), "four legs walk along x at a height of 0.57 m"),
}
"""By name in the benchmark."""


def make(name: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """The environment of that name with its time limit (`kwargs` such as `render_mode="rgb_array"`)."""
    task = TASKS[name]
    named = {"name": name} if task.env is MbblRobot else {}
    spec = EnvSpec(f"mbbl/{name}-v0", task.env, max_episode_steps=task.horizon, disable_env_checker=True, kwargs=named)
    return gymnasium.make(spec, **kwargs)
