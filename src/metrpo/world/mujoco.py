"""The paper's six tasks on MuJoCo (its appendix "Environment details"; the physics are rllab's).

The bodies are those that Gymnasium ships; the edits and `_Robot`s below turn them into rllab's, and `_add` gives them
rewards and horizons. COM is the centre of mass of the whole robot, v its velocity, a the action in [-1, 1], q and q'
MuJoCo's generalised positions and velocities. Units are MuJoCo's: metres, seconds, radians, N m.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from metrpo.environment_ids import HORIZONS, env_id, register_ids
from metrpo.errors import TaskError
from metrpo.gl import INSTALL_GL, gl_library
from metrpo.types import Array
from metrpo.world.interface import of_paper_task
from metrpo.world.registry import get_task, register
from metrpo.world.task import Task

_Reward = Callable[[Array, Array, Array], Array]
_StateOf = Callable[[mujoco.MjModel, Any], NDArray[np.float64]]
"""Of a model and its data, or of what stands for the data of many steps (`metrpo.world.open_loop`)."""

_ROOT = 1
"""Body 0 is the world; body 1 carries the whole robot, so its subtree is the robot."""
_FRAME_SIZE = 480
_EULER, _RK4 = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4


# ---------------------------------------------------------------- edits of Gymnasium's bodies


def _grow_snake(spec: mujoco.MjSpec) -> None:
    """Makes the 3-link swimmer the 5-link snake: two more links behind, as long and thick as the others."""
    parent = spec.body("back")
    for number in (3, 4):
        joint = f"motor{number}_rot"
        parent = parent.add_body(name=f"back{number - 1}", pos=[-1, 0, 0])
        parent.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, -1, 0, 0], size=[0.1, 0, 0], density=1000)
        parent.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], range=[-100, 100], limited=True)
        motor = spec.add_actuator(target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrlrange=[-1, 1], ctrllimited=True)
        motor.set_to_motor()


def _no_armature(spec: mujoco.MjSpec) -> None:
    for joint in spec.joints:
        joint.armature = 0.0


def _no_contacts(spec: mujoco.MjSpec) -> None:
    """rllab's collision="predefined" with no pairs: the capsules lie in the floor, and any contact would hold them."""
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0


def _rllab_contacts(spec: mujoco.MjSpec) -> None:
    """rllab's contact impedance, which Gymnasium's copies of these bodies leave out."""
    for geom in spec.geoms:
        geom.solimp[:3] = 0.8, 0.8, 0.01


# ---------------------------------------------------------------- states


def _com_state(position: str, velocity: str, first: int) -> _StateOf:
    """State [COM axes, q[first:], v axes, q'[first:]]; the COM replaces the coordinates of the root body."""
    axes, rates = _axes(position), _axes(velocity)

    def state(_: mujoco.MjModel, data: Any) -> NDArray[np.float64]:
        com, com_velocity = data.subtree_com[_ROOT], data.subtree_linvel[_ROOT]
        parts = (com[..., axes], data.qpos[..., first:], com_velocity[..., rates], data.qvel[..., first:])
        return np.concatenate(parts, axis=-1)

    return state


def _axes(names: str) -> slice:
    """Of a vector [3]; a slice, for a list of indices takes ten times as long."""
    first, last = "xyz".index(names[0]), "xyz".index(names[-1])
    return slice(first, last + 1, 2 if names == "xz" else 1)


def _humanoid_state(model: mujoco.MjModel, data: Any) -> NDArray[np.float64]:
    """State [q[3:], q', head xyz], the head being the centre of its sphere, as in the authors' code."""
    return np.concatenate([data.qpos[..., 3:], data.qvel, data.geom_xpos[model.geom("head").id]], axis=-1)


# ---------------------------------------------------------------- rewards and termination, NumPy and JAX alike


def _squared_norm(action: Array) -> Array:
    return (action * action).sum(axis=-1)


def _velocity_reward(index: int, control: float, bonus: float = 0.0) -> _Reward:
    """r = v_x - control ||a||^2 + bonus, with v_x = s'[index]."""

    def reward(state: Array, action: Array, next_state: Array) -> Array:
        return next_state[..., index] - control * _squared_norm(action) + bonus

    return reward


_hopper_speed = _velocity_reward(5, 0.005)


def hopper_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = v_x - 0.005 ||a||^2 - 10 max(0.45 - COM z, 0) - 10 sum(max(s' - 100, 0)).

    `state` and `next_state` [..., 11], `action` [..., 3]; returns [...]. Source: the paper, "Environment details".
    """
    xp = next_state.__array_namespace__()
    too_low = xp.maximum(0.45 - next_state[..., 0], 0.0)
    too_large = xp.maximum(next_state - 100.0, 0.0).sum(axis=-1)
    return _hopper_speed(state, action, next_state) - 10.0 * too_low - 10.0 * too_large


def hopper_upright_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = v_x - 0.005 ||a||^2 - 10 max(0.45 - COM z, 0) - 10 max(|pitch| - 0.2, 0) - sum(max(|s'[2:]| - 100, 0)).

    `state` and `next_state` [..., 11], `action` [..., 3]; returns [...]. Source: the authors' code.
    """
    xp = next_state.__array_namespace__()
    too_low = xp.maximum(0.45 - next_state[..., 0], 0.0)
    too_tilted = xp.maximum(abs(next_state[..., 1]) - 0.2, 0.0)
    too_large = xp.maximum(abs(next_state[..., 2:]) - 100.0, 0.0).sum(axis=-1)
    return _hopper_speed(state, action, next_state) - 10.0 * (too_low + too_tilted) - too_large


def humanoid_reward(state: Array, action: Array, next_state: Array) -> Array:
    """r = -(head z - 1.5)^2 - 1e-5 ||a||^2.

    `state` and `next_state` [..., 47], `action` [..., 17]; returns [...]. Source: the authors' code; the paper prints
    both terms with a plus, which would reward lying down and wasting effort.
    """
    return -((next_state[..., -1] - 1.5) ** 2) - 1e-5 * _squared_norm(action)


def ant_terminated(next_state: Array) -> Array:
    """True where the COM height has left [0.2, 1.0], or is not a number.

    `next_state` [..., 29]; returns [...] of bool. Source: the paper, "Environment details".
    """
    height = next_state[..., 2]
    return ~((height >= 0.2) & (height <= 1.0))


# ---------------------------------------------------------------- the tables


@dataclass(frozen=True)
class _Robot:
    asset: str
    timestep: float
    frame_skip: int
    integrator: mujoco.mjtIntegrator
    state: _StateOf
    edits: tuple[Callable[[mujoco.MjSpec], None], ...] = ()
    gears: Mapping[str, float] = field(default_factory=dict)
    """By joint, sides left out; joints not named here keep Gymnasium's gear."""
    start: tuple[float, ...] = ()
    """Replaces the first entries of MuJoCo's q0."""
    camera: tuple[float, float, float] = (4.0, 90.0, -15.0)
    """Distance from the COM (m), azimuth and elevation (degrees)."""


_SWIMMER = _Robot(
    asset="swimmer.xml",
    timestep=0.001,
    frame_skip=50,
    integrator=_EULER,
    state=_com_state("xy", "xy", 2),
    edits=(_no_armature, _no_contacts),
    gears={f"motor{number}_rot": 50.0 for number in (1, 2, 3, 4)},
    camera=(6.0, 90.0, -60.0),
)
_SNAKE = replace(_SWIMMER, edits=(_grow_snake, *_SWIMMER.edits), camera=(9.0, 90.0, -60.0))
_HOPPER = _Robot("hopper.xml", 0.02, 1, _RK4, _com_state("z", "xz", 2))
_CHEETAH = _Robot("half_cheetah.xml", 0.01, 1, _EULER, _com_state("xz", "xz", 2))
_ANT = _Robot(
    asset="ant.xml",
    timestep=0.02,
    frame_skip=1,
    integrator=_RK4,
    state=_com_state("xyz", "xyz", 3),
    edits=(_rllab_contacts,),
    start=(0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1),
    camera=(4.0, 90.0, -25.0),
)
_HUMANOID = _Robot(
    asset="humanoid.xml",
    timestep=0.002,
    frame_skip=4,
    integrator=_RK4,
    state=_humanoid_state,
    edits=(_rllab_contacts,),
    gears={
        **dict.fromkeys(("abdomen_x", "abdomen_y", "abdomen_z", "hip_x", "hip_z", "elbow"), 200.0),
        **dict.fromkeys(("shoulder1", "shoulder2"), 100.0),
        **{"hip_y": 600.0, "knee": 400.0},
    },
)
# 0.1 m up and turned by 90 degrees about x, y and z in turn.
_LYING = replace(_HUMANOID, start=(0, 0, 0.1, 0, 0.5**0.5, 0, 0.5**0.5))

_ROBOTS: dict[str, _Robot] = {}
"""By task name."""


def _add(
    robot: _Robot,
    name: str,
    sizes: tuple[int, int],
    reward: _Reward,
    unseen: tuple[int, ...],
    description: str,
    terminated: Callable[[Array], Array] | None = None,
) -> None:
    """Makes a task known to metrpo; Gymnasium knows it by `metrpo.environment_ids`, with its time limit."""
    _ROBOTS[name] = robot
    shows = of_paper_task(name, sizes[1])
    register(Task(name, env_id(name), *sizes, HORIZONS[name], reward, terminated, unseen, description, interface=shows))


register_ids()
_add(_SWIMMER, "Swimmer", (10, 2), _velocity_reward(5, 0.005), (0, 1), "3 links swim along x in a viscous fluid")
_add(_SNAKE, "Snake", (14, 4), _velocity_reward(7, 0.005), (0, 1), "5 links swim along x in a viscous fluid")
_add(_HOPPER, "Hopper", (11, 3), hopper_reward, (), "one leg hops along x without sinking below 0.45 m")
_add(_HOPPER, "HopperUpright", (11, 3), hopper_upright_reward, (), "Hopper that must also stay upright")
_add(_CHEETAH, "HalfCheetah", (18, 6), _velocity_reward(9, 0.05), (0,), "two legs in a plane run along x")
_add(_ANT, "Ant", (29, 8), _velocity_reward(15, 0.005, 0.05), (0, 1), "four legs walk along x", ant_terminated)
_add(_HUMANOID, "Humanoid", (47, 17), humanoid_reward, (), "keep the head at 1.5 m, starting upright")
_add(_LYING, "HumanoidStandup", (47, 17), humanoid_reward, (), "bring the head to 1.5 m, starting on the floor")


def is_robot(name: str) -> bool:
    """Whether `name` is one of this file's tasks."""
    return name in _ROBOTS


# ---------------------------------------------------------------- the environment


def _compile(robot: _Robot, sensors: bool = False) -> mujoco.MjModel:
    """The robot's physics: Gymnasium's body with rllab's numbers; with `sensors`, of its COM, v and head."""
    path = resources.files("gymnasium") / "envs" / "mujoco" / "assets" / robot.asset
    if not path.is_file():
        raise TaskError(f"expected a robot's body at {path}, found none: reinstall gymnasium (1.2 or newer has it)")
    spec = mujoco.MjSpec.from_file(str(path))
    for edit in robot.edits:
        edit(spec)
    for actuator in spec.actuators:
        joint = actuator.target.removeprefix("left_").removeprefix("right_")
        actuator.gear[0] = robot.gears.get(joint, actuator.gear[0])
    spec.option.timestep, spec.option.integrator = robot.timestep, robot.integrator
    if sensors:
        _add_sensors(spec)
    # MuJoCo would restart a diverged simulation from q0 in silence, and the jump would pass for dynamics.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    with warnings.catch_warnings():
        # MuJoCo deprecates an attribute of Gymnasium's cheetah and still obeys it: nothing for a user to act on.
        warnings.filterwarnings("ignore", message=".*settotalmass")
        return spec.compile()


SENSORS = {"com": mujoco.mjtSensor.mjSENS_SUBTREECOM, "velocity": mujoco.mjtSensor.mjSENS_SUBTREELINVEL}
"""What a state takes from the data besides q and q', of the whole robot; a head's position comes to it."""


def _add_sensors(spec: mujoco.MjSpec) -> None:
    robot, body = spec.bodies[_ROOT].name, mujoco.mjtObj.mjOBJ_BODY
    for name, kind in SENSORS.items():
        spec.add_sensor(name=name, type=kind, objtype=body, objname=robot)
    if any(geom.name == "head" for geom in spec.geoms):
        kind, geom = mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtObj.mjOBJ_GEOM
        spec.add_sensor(name="head", type=kind, objtype=geom, objname="head")


def robot_of(name: str) -> tuple[_Robot, mujoco.MjModel]:
    """One of this file's robots with its physics and `SENSORS`."""
    return _ROBOTS[name], _compile(_ROBOTS[name], sensors=True)


class _Painter:
    """Draws off screen; raises `TaskError` when there is no GL to draw with.

    Not `mujoco.Renderer`, whose GL library is whatever MUJOCO_GL named when somebody first imported mujoco.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        try:
            name = gl_library()
        except ValueError as error:
            raise TaskError(str(error)) from None
        try:
            source = importlib.import_module(f"mujoco.{name}") if name else mujoco
            self._gl = source.GLContext(_FRAME_SIZE, _FRAME_SIZE)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each GL library fails in its own way
            raise TaskError(
                f"no OpenGL to render with (tried {name or 'the default of mujoco'}: {error}): {INSTALL_GL}"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        for costly in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[costly] = 0  # a frame without a GPU takes 0.03 s instead of 0.2 s
        self._rect = mujoco.MjrRect(0, 0, _FRAME_SIZE, _FRAME_SIZE)

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData, view: tuple[float, float, float]) -> NDArray[np.uint8]:
        camera = mujoco.MjvCamera()
        camera.lookat = data.subtree_com[_ROOT]
        camera.distance, camera.azimuth, camera.elevation = view
        mujoco.mj_camlight(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, self._scene)
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._context)
        frame = np.empty((_FRAME_SIZE, _FRAME_SIZE, 3), np.uint8)
        mujoco.mjr_readPixels(frame, None, self._rect, self._context)
        return frame[::-1].copy()

    def close(self) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()


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
        self._robot = _ROBOTS[self.task.name]
        # Every task of this file has formulas.
        self._reward: Any = self.task.reward
        self._terminated: Any = self.task.terminated
        self.model = _compile(self._robot) if model is None else model
        self.data = mujoco.MjData(self.model)
        self.metadata = {**self.metadata, "render_fps": round(1 / (self._robot.timestep * self._robot.frame_skip))}
        self._start = self.model.qpos0.copy()
        self._start[: len(self._robot.start)] = self._robot.start
        self._control_low, control_high = self.model.actuator_ctrlrange.T.copy()
        self._control_span = control_high - self._control_low
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.task.state_size,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.action_size,), np.float32)
        self._state = self._observe()
        self._painter: _Painter | None = None

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
            self._painter = _Painter(self.model)
        return self._painter.draw(self.model, self.data, self._robot.camera)

    def close(self) -> None:
        """Frees the renderer."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None
