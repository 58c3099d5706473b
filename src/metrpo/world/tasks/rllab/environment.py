"""The paper's six tasks as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from metrpo.errors import TaskError
from metrpo.world.registry import get_task
from metrpo.world.tasks.rllab.bodies import ROBOTS, compile_robot
from metrpo.world.tasks.rllab.rendering import Painter


class MujocoTask(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """One of the paper's tasks; its reward and termination are the very functions of the `Task` of that name.

    Observation [S] float64, unbounded; action [A] float32 in [-1, 1], clipped to it, then scaled to the motors' control
    range. A reset draws q = q0 + 0.01 N and q' = 0 + 0.1 N (rllab). The time limit comes from Gymnasium's registration.
    `model` and `data` are MuJoCo's own; environments of one task may share the model.
    Raises `TaskError` for an unknown task and where frames cannot be rendered.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium reads it from the class)

    def __init__(self, task: str, render_mode: str | None = None, model: mujoco.MjModel | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise TaskError(f'render_mode: expected None or "rgb_array", got {render_mode!r}')
        self.task = get_task(task)
        self.render_mode = render_mode
        self._robot = ROBOTS[self.task.name]
        # Every task of this file has formulas.
        self._reward: Any = self.task.reward
        self._terminated: Any = self.task.terminated
        self.model = compile_robot(self._robot) if model is None else model
        self.data = mujoco.MjData(self.model)
        self.metadata = {**self.metadata, "render_fps": round(1 / (self._robot.timestep * self._robot.frame_skip))}
        self._start = self.model.qpos0.copy()
        self._start[: len(self._robot.start)] = self._robot.start
        self._control_low, control_high = self.model.actuator_ctrlrange.T.copy()
        self._control_span = control_high - self._control_low
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.task.state_size,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.action_size,), np.float32)
        self._state = self._observe()
        self._painter: Painter | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """A start near the robot's initial pose: state [S] and an empty info."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._start + 0.01 * self.np_random.standard_normal(self.model.nq)
        self.data.qvel[:] = 0.1 * self.np_random.standard_normal(self.model.nv)
        # The noise has stretched the quaternions; MuJoCo would normalise them in the first step, unseen by the state.
        mujoco.mj_normalizeQuat(self.model, self.data.qpos)
        self._state = self._observe()
        return self._state.copy(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Next state [S], reward, terminated, False and an empty info after one control interval."""
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise TaskError(
                f"{self.task.name}: expected {self.task.action_size} finite numbers as action, got {action}"
            )
        state = self._state
        self.advance(self.controls(action))
        if not np.isfinite(self._state).all():
            raise TaskError(f"{self.task.name}: the simulation diverged; reset() starts a new episode")
        reward = float(self._reward(state, action, self._state))
        terminated = self._terminated is not None and bool(self._terminated(self._state))
        return self._state.copy(), reward, terminated, False, {}

    def controls(self, action: NDArray[Any]) -> NDArray[np.float64]:
        """The motors' controls for actions in [-1, 1], [..., A]."""
        return self._control_low + 0.5 * (action + 1.0) * self._control_span

    def advance(self, controls: NDArray[np.float64]) -> NDArray[np.float64]:
        """Only the physics of a step: the state [S] after one control interval. Lets other threads run meanwhile."""
        self.data.ctrl[:] = controls
        mujoco.mj_step(self.model, self.data, self._robot.frame_skip)
        self._state = self._observe()
        return self._state

    def _observe(self) -> NDArray[np.float64]:
        # mj_step leaves positions and velocities of bodies as they were before its last integration.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        mujoco.mj_subtreeVel(self.model, self.data)
        return self._robot.state(self.model, self.data)

    def render(self) -> NDArray[np.uint8] | None:
        """The scene around the robot, [480, 480, 3] uint8; None unless `render_mode` is "rgb_array"."""
        if self.render_mode is None:
            return None
        if self._painter is None:
            self._painter = Painter(self.model)
        return self._painter.draw(self.model, self.data, self._robot.camera)

    def close(self) -> None:
        """Frees the renderer."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None
