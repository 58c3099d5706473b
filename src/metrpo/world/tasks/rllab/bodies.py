"""The paper's six tasks on MuJoCo (its appendix "Environment details"; the physics are rllab's).

The bodies are those that Gymnasium ships; the edits and `Robot`s below turn them into rllab's, and `_add` gives them
rewards and horizons. COM is the centre of mass of the whole robot, v its velocity, a the action in [-1, 1], q and q'
MuJoCo's generalised positions and velocities. Units are MuJoCo's: metres, seconds, radians, N m.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from metrpo.errors import TaskError

_StateOf = Callable[[mujoco.MjModel, Any], NDArray[np.float64]]
"""Of a model and its data, or of what stands for the data of many steps (`metrpo.world.open_loop`)."""

ROOT = 1
"""Body 0 is the world; body 1 carries the whole robot, so its subtree is the robot."""
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
        com, com_velocity = data.subtree_com[ROOT], data.subtree_linvel[ROOT]
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


# ---------------------------------------------------------------- the tables


@dataclass(frozen=True)
class Robot:
    """What turns one of Gymnasium's bodies into rllab's."""

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


SWIMMER = Robot(
    asset="swimmer.xml",
    timestep=0.001,
    frame_skip=50,
    integrator=_EULER,
    state=_com_state("xy", "xy", 2),
    edits=(_no_armature, _no_contacts),
    gears={f"motor{number}_rot": 50.0 for number in (1, 2, 3, 4)},
    camera=(6.0, 90.0, -60.0),
)
SNAKE = replace(SWIMMER, edits=(_grow_snake, *SWIMMER.edits), camera=(9.0, 90.0, -60.0))
HOPPER = Robot("hopper.xml", 0.02, 1, _RK4, _com_state("z", "xz", 2))
CHEETAH = Robot("half_cheetah.xml", 0.01, 1, _EULER, _com_state("xz", "xz", 2))
ANT = Robot(
    asset="ant.xml",
    timestep=0.02,
    frame_skip=1,
    integrator=_RK4,
    state=_com_state("xyz", "xyz", 3),
    edits=(_rllab_contacts,),
    start=(0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1),
    camera=(4.0, 90.0, -25.0),
)
HUMANOID = Robot(
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
LYING = replace(HUMANOID, start=(0, 0, 0.1, 0, 0.5**0.5, 0, 0.5**0.5))

ROBOTS: dict[str, Robot] = {}
"""By task name."""


def is_robot(name: str) -> bool:
    """Whether `name` is one of this file's tasks."""
    return name in ROBOTS


# ---------------------------------------------------------------- the environment


def compile_robot(robot: Robot, sensors: bool = False) -> mujoco.MjModel:
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
    robot, body = spec.bodies[ROOT].name, mujoco.mjtObj.mjOBJ_BODY
    for name, kind in SENSORS.items():
        spec.add_sensor(name=name, type=kind, objtype=body, objname=robot)
    if any(geom.name == "head" for geom in spec.geoms):
        kind, geom = mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtObj.mjOBJ_GEOM
        spec.add_sensor(name="head", type=kind, objtype=geom, objname="head")


def robot_of(name: str) -> tuple[Robot, mujoco.MjModel]:
    """One of this file's robots with its physics and `SENSORS`."""
    return ROBOTS[name], compile_robot(ROBOTS[name], sensors=True)
