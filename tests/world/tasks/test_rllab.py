"""The paper's tasks: physics, states, rewards, ends of episodes, pictures."""

from __future__ import annotations

import dataclasses
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from metrpo.errors import TaskError
from metrpo.world.registry import get_task, tasks

NAMES = ["Swimmer", "Snake", "Hopper", "HopperUpright", "HalfCheetah", "Ant", "Humanoid", "HumanoidStandup"]
EULER, RK4 = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4


def make(name, **kwargs):
    """The environment without Gymnasium's wrappers (no time limit)."""
    return get_task(name).make_env(**kwargs).unwrapped


def transitions(name, count, seed=0):
    """`count` random transitions (s, a, r, s', terminated), as arrays."""
    env, rng = make(name), np.random.default_rng(seed)
    rows, state = [], env.reset(seed=seed)[0]
    for step in range(count):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        if step % 2:
            action = np.sign(action)
        next_state, reward, terminated, _, _ = env.step(action)
        rows.append((state, action, reward, next_state, terminated))
        state = env.reset()[0] if terminated or step % 100 == 99 else next_state
    return [np.array(column) for column in zip(*rows, strict=True)]


def gait(amplitude, frequency, phase):
    """Two sines, one per motor of the swimmer: step -> action."""
    return lambda step: amplitude * np.sin(frequency * step * 0.05 * 2 * np.pi + np.array([0.0, phase]))


def swim(env, policy, seed=0, at_rest=False):
    env.reset(seed=seed)
    if at_rest:
        env.data.qpos[:], env.data.qvel[:] = 0, 0
    return sum(env.step(policy(step).astype(np.float32))[1] for step in range(200))


# ---------------------------------------------------------------- spaces and registration


@pytest.mark.parametrize(
    ("name", "state", "action", "horizon", "unseen"),
    [
        ("Swimmer", 10, 2, 200, (0, 1)),
        ("Snake", 14, 4, 200, (0, 1)),
        ("Hopper", 11, 3, 100, ()),
        ("HopperUpright", 11, 3, 100, ()),
        ("HalfCheetah", 18, 6, 100, (0,)),
        ("Ant", 29, 8, 100, (0, 1)),
        ("Humanoid", 47, 17, 100, ()),
        ("HumanoidStandup", 47, 17, 100, ()),
    ],
)
def test_sizes_bounds_and_horizon(name, state, action, horizon, unseen):
    task = get_task(name)
    env = gymnasium.make(f"metrpo/{name}-v0")
    assert (task.state_size, task.action_size, task.horizon, task.unseen) == (state, action, horizon, unseen)
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (state,), np.float64)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (action,), np.float32)
    env.reset(seed=0)
    env.unwrapped.task = dataclasses.replace(task, terminated=None)  # a still ant may topple
    ends = [env.step(np.zeros(action, np.float32))[2:4] for _ in range(horizon)]
    assert ends == [(False, False)] * (horizon - 1) + [(False, True)]
    assert task.description


def test_the_registry_holds_the_tasks_and_only_ant_terminates():
    assert set(NAMES) <= set(tasks())
    assert [name for name in NAMES if get_task(name).terminated is not None] == ["Ant"]


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_finds_no_fault(name):
    with warnings.catch_warnings():
        # The paper's states are unbounded; Gymnasium only asks whether that is meant.
        warnings.filterwarnings("ignore", message=".*A Box observation space m(in|ax)imum value is -?infinity")
        check_env(make(name), skip_render_check=True)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_episode(name):
    one, two, other = (transitions(name, 30, seed) for seed in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert not np.allclose(one[0], other[0])


# ---------------------------------------------------------------- physics

PHYSICS = {  # timestep, frame skip, integrator, density, viscosity, torque limits in the order of the motors
    "Swimmer": (0.001, 50, EULER, 4000, 0.1, [50] * 2),
    "Snake": (0.001, 50, EULER, 4000, 0.1, [50] * 4),
    "Hopper": (0.02, 1, RK4, 0, 0, [200] * 3),
    "HopperUpright": (0.02, 1, RK4, 0, 0, [200] * 3),
    "HalfCheetah": (0.01, 1, EULER, 0, 0, [120, 90, 60, 120, 60, 30]),
    "Ant": (0.02, 1, RK4, 0, 0, [150] * 8),
    "Humanoid": (0.002, 4, RK4, 0, 0, [80] * 5 + [240, 160, 80, 80, 240, 160] + [40, 40, 80] * 2),
    "HumanoidStandup": (0.002, 4, RK4, 0, 0, [80] * 5 + [240, 160, 80, 80, 240, 160] + [40, 40, 80] * 2),
}


@pytest.mark.parametrize("name", NAMES)
def test_physics(name):
    timestep, frame_skip, integrator, density, viscosity, torques = PHYSICS[name]
    env = make(name)
    option = env.model.opt
    assert (option.timestep, option.integrator) == (timestep, integrator)
    assert (option.density, option.viscosity) == (density, viscosity)
    np.testing.assert_allclose(option.gravity, [0, 0, -9.81])
    limits = env.model.actuator_gear[:, :1] * env.model.actuator_ctrlrange
    np.testing.assert_allclose(limits, np.outer(torques, [-1, 1]))
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))
    assert env.data.time == pytest.approx(timestep * frame_skip)
    assert env.metadata["render_fps"] == round(1 / (timestep * frame_skip))


@pytest.mark.parametrize(("name", "links"), [("Swimmer", 3), ("Snake", 5)])
def test_swimmers_are_chains_of_equal_capsules_without_armature(name, links):
    model = make(name).model
    assert (model.nbody, model.ngeom) == (links + 1, links + 1)
    assert (model.nq, model.nv, model.nu) == (links + 2, links + 2, links - 1)
    np.testing.assert_array_equal(model.geom_type[1:], int(mujoco.mjtGeom.mjGEOM_CAPSULE))
    np.testing.assert_allclose(model.geom_size[1:, :2], [[0.1, 0.5]] * links)  # radius, half length
    volume = np.pi * 0.1**2 * 1.0 + 4 / 3 * np.pi * 0.1**3
    np.testing.assert_allclose(model.body_mass[1:], 1000 * volume)
    np.testing.assert_allclose(model.jnt_range[3:], np.radians([[-100, 100]] * (links - 1)))
    assert list(model.jnt_limited) == [0, 0, 0] + [1] * (links - 1)
    assert not model.dof_armature.any()
    assert not model.dof_damping.any()


def test_the_links_of_the_snake_hang_one_behind_the_other():
    env = make("Snake")
    env.data.qpos[:] = 0
    env._observe()
    np.testing.assert_allclose(env.data.geom_xpos[1:], [[x, 0, 0] for x in (1, 0, -1, -2, -3)], atol=1e-9)
    np.testing.assert_array_equal(env.model.actuator_trnid[:, 0], [3, 4, 5, 6])


def test_joints_of_the_other_robots():
    hopper, cheetah, ant, humanoid = (make(name).model for name in ("Hopper", "HalfCheetah", "Ant", "Humanoid"))
    for model, root in ((hopper, 3), (ant, 6)):
        assert not model.dof_armature[:root].any()
        assert set(model.dof_armature[root:]) == set(model.dof_damping[root:]) == {1.0}
    for model in (hopper, ant, humanoid):
        np.testing.assert_allclose(model.geom_solimp[:, :3], [[0.8, 0.8, 0.01]] * model.ngeom)
    assert cheetah.body_mass.sum() == pytest.approx(14)
    assert humanoid.dof_armature.max() <= 0.02  # rllab's; Gymnasium's default of 1 would stiffen every joint
    assert (humanoid.opt.solver, humanoid.opt.iterations) == (mujoco.mjtSolver.mjSOL_PGS, 50)
    np.testing.assert_allclose(humanoid.actuator_ctrlrange, [[-0.4, 0.4]] * 17)
    gears = {humanoid.actuator(i).name: humanoid.actuator_gear[i, 0] for i in range(17)}
    assert gears["left_hip_y"] == gears["right_hip_y"] == 600
    assert gears["left_knee"] == 400
    assert gears["right_shoulder2"] == 100
    assert gears["right_elbow"] == gears["abdomen_z"] == gears["left_hip_z"] == 200


def test_a_full_action_is_the_full_torque():
    env = make("Humanoid")
    env.reset(seed=0)
    env.step(np.full(17, 5.0, np.float32))  # clipped
    np.testing.assert_allclose(env.data.ctrl, 0.4)
    np.testing.assert_allclose(env.data.actuator_force, 0.4)
    env.step(np.full(17, -0.5, np.float32))
    np.testing.assert_allclose(env.data.ctrl, -0.2)


@pytest.mark.parametrize("name", ["Swimmer", "Snake"])
def test_nothing_ever_touches_a_swimmer(name):
    env, rng = make(name), np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(300):
        env.step(np.sign(rng.standard_normal(env.action_space.shape)).astype(np.float32))
        assert env.data.ncon == 0


@pytest.mark.parametrize("name", ["Hopper", "HalfCheetah", "Ant", "Humanoid"])
def test_the_others_stand_on_the_floor(name):
    env = make(name)
    env.reset(seed=0)
    touched = set()
    for _ in range(100):
        env.step(np.zeros(env.action_space.shape, np.float32))
        touched |= {env.model.geom(geom).name for geom in env.data.contact.geom.ravel()}
    assert "floor" in touched
    assert env.data.subtree_com[1, 2] > 0


# ---------------------------------------------------------------- starts


def test_reset_noise():
    env = make("HalfCheetah")
    starts = np.array([(env.reset(seed=seed), env.data.qpos.copy(), env.data.qvel.copy())[1:] for seed in range(1500)])
    np.testing.assert_allclose(starts.mean(0), 0, atol=0.012)
    np.testing.assert_allclose(starts[:, 0].std(0), 0.01, rtol=0.08)
    np.testing.assert_allclose(starts[:, 1].std(0), 0.1, rtol=0.08)


@pytest.mark.parametrize(("name", "up"), [("Humanoid", 1.0), ("HumanoidStandup", 0.0)])
def test_the_humanoids_stand_or_lie(name, up):
    env = make(name)
    state = env.reset(seed=0)[0]
    assert env.data.qpos[2] == pytest.approx({1.0: 1.4, 0.0: 0.1}[up], abs=0.05)
    assert env.data.xmat[1].reshape(3, 3)[2, 2] == pytest.approx(up, abs=0.1)  # the torso's axis against the vertical
    assert state[-1] == pytest.approx({1.0: 1.59, 0.0: 0.1}[up], abs=0.05)  # the head is 0.19 up that axis
    np.testing.assert_allclose(state[-3:], env.data.geom("head").xpos)


def test_lying_is_three_quarter_turns_about_x_y_and_z():
    env = make("HumanoidStandup")
    expected = np.zeros(4)
    mujoco.mju_euler2Quat(expected, np.radians([90.0, 90, 90]), "xyz")
    np.testing.assert_allclose(env._start[3:7], expected, atol=1e-12)


def test_the_ant_starts_on_its_feet():
    env = make("Ant")
    env.reset(seed=0)
    np.testing.assert_allclose(env.data.qpos[2:], [0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1], atol=0.05)
    assert np.linalg.norm(env.data.qpos[3:7]) == pytest.approx(1)


# ---------------------------------------------------------------- states


@pytest.mark.parametrize(
    ("name", "com", "velocity", "first"),
    [
        ("Swimmer", [0, 1], [0, 1], 2),
        ("Snake", [0, 1], [0, 1], 2),
        ("Hopper", [2], [0, 2], 2),
        ("HalfCheetah", [0, 2], [0, 2], 2),
        ("Ant", [0, 1, 2], [0, 1, 2], 3),
    ],
)
def test_the_state_is_com_and_joints_and_their_rates(name, com, velocity, first):
    env = make(name)
    env.reset(seed=1)
    for _ in range(5):
        state = env.step(env.action_space.sample())[0]
    fresh = mujoco.MjData(env.model)
    fresh.qpos, fresh.qvel = env.data.qpos, env.data.qvel
    mujoco.mj_forward(env.model, fresh)
    mass = env.model.body_mass[:, None]
    centre = (mass * fresh.xipos).sum(0) / mass.sum()
    eps = 1e-7
    mujoco.mj_integratePos(env.model, fresh.qpos, env.data.qvel, eps)
    mujoco.mj_kinematics(env.model, fresh)
    rate = ((mass * fresh.xipos).sum(0) / mass.sum() - centre) / eps
    expected = np.concatenate([centre[com], env.data.qpos[first:], rate[velocity], env.data.qvel[first:]])
    np.testing.assert_allclose(state, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "x", "vx", "dt"), [("Swimmer", 0, 5, 0.05), ("Snake", 0, 7, 0.05), ("HalfCheetah", 0, 9, 0.01)]
)
def test_com_velocity_is_the_rate_of_the_com_along_an_episode(name, x, vx, dt):
    env = make(name)
    states = [env.reset(seed=0)[0]]
    for step in range(100):
        states.append(env.step(np.full(env.action_space.shape, 0.3 * np.sin(step / 10), np.float32))[0])
    states = np.array(states)
    travelled = dt * (states[1:, vx] + states[:-1, vx]).sum() / 2
    assert travelled == pytest.approx(states[-1, x] - states[0, x], abs=0.01)
    assert abs(states[:, vx]).max() > 0.02


def test_humanoid_state():
    env = make("Humanoid")
    env.reset(seed=0)
    state = env.step(env.action_space.sample())[0]
    torso = env.data.xpos[1] + env.data.xmat[1].reshape(3, 3) @ [0, 0, 0.19]
    np.testing.assert_allclose(state, np.concatenate([env.data.qpos[3:], env.data.qvel, torso]))


# ---------------------------------------------------------------- rewards and ends


@pytest.mark.parametrize("name", NAMES)
def test_reward_and_end_in_jax_are_those_of_the_environment(name):
    task = get_task(name)
    states, actions, rewards, next_states, ends = transitions(name, 1000)
    np.testing.assert_allclose(task.reward(states, actions, next_states), rewards, rtol=1e-5, atol=1e-5)
    in_jax = jax.jit(task.reward)(*map(jnp.asarray, (states, actions, next_states)))
    assert isinstance(in_jax, jax.Array)
    np.testing.assert_allclose(in_jax, rewards, rtol=1e-4, atol=1e-3)
    grid = [a[:12].reshape(3, 4, -1) for a in (states, actions, next_states)]
    np.testing.assert_allclose(task.reward(*grid).ravel(), rewards[:12], rtol=1e-5, atol=1e-5)
    if task.terminated is None:
        assert not ends.any()
    else:
        assert ends.any()
        np.testing.assert_array_equal(task.terminated(next_states), ends)
        np.testing.assert_array_equal(jax.jit(task.terminated)(jnp.asarray(next_states)), ends)


def plain_reward(name, env, action):
    """The reward written out from MuJoCo's own data after the step."""
    mass = env.model.body_mass
    com_z = (mass * env.data.xipos[:, 2]).sum() / mass.sum()
    momentum = 0.0
    for body in range(1, env.model.nbody):
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(env.model, env.data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        momentum += mass[body] * velocity[3]
    vx = momentum / mass.sum()
    effort = sum(float(a) ** 2 for a in action)
    pitch = env.data.qpos[2]
    if name == "HalfCheetah":
        return vx - 0.05 * effort
    if name == "Ant":
        return vx - 0.005 * effort + 0.05
    if name == "Hopper":
        return vx - 0.005 * effort - (10 * (0.45 - com_z) if com_z < 0.45 else 0)
    if name == "HopperUpright":
        low = 10 * (0.45 - com_z) if com_z < 0.45 else 0
        return vx - 0.005 * effort - low - (10 * (abs(pitch) - 0.2) if abs(pitch) > 0.2 else 0)
    if name.startswith("Humanoid"):
        return -((env.data.geom("head").xpos[2] - 1.5) ** 2) - 0.00001 * effort
    return vx - 0.005 * effort


@pytest.mark.parametrize("name", NAMES)
def test_reward_against_mujocos_own_data(name):
    env, rng = make(name), np.random.default_rng(1)
    env.reset(seed=1)
    for _ in range(150):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        reward = env.step(action)[1]
        assert abs(env.data.qvel).max() < 100
        # A clean forward pass: mj_objectVelocity of a body is that of its frame, so measure at the inertial frame.
        mujoco.mj_forward(env.model, env.data)
        assert reward == pytest.approx(plain_reward(name, env, action), rel=1e-6, abs=1e-6)


def test_rewards_by_hand():
    def reward(name, action, **state):
        task = get_task(name)
        next_state = np.zeros(task.state_size)
        for key, value in state.items():
            next_state[int(key[1:])] = value
        return float(task.reward(np.full(task.state_size, 7.0), np.array(action), next_state))

    assert reward("Swimmer", [1, -1], s5=2.0) == pytest.approx(2 - 0.01)
    assert reward("Snake", [1, 0, 0.5, 0], s7=1.0) == pytest.approx(1 - 0.00625)
    assert reward("HalfCheetah", [1] * 6, s9=3.0) == pytest.approx(3 - 0.3)
    assert reward("HalfCheetah", [0] * 6, s9=30.0) == pytest.approx(30)  # the authors' code clips to 10
    assert reward("Ant", [0.5] * 8, s15=1.0) == pytest.approx(1 - 0.01 + 0.05)
    assert reward("Hopper", [1, 1, 1], s0=1.0, s1=2.0, s5=1.0) == pytest.approx(1 - 0.015)
    assert reward("Hopper", [0, 0, 0], s0=0.4, s5=1.0) == pytest.approx(1 - 0.5)
    assert reward("Hopper", [0, 0, 0], s0=1.0, s8=103.0, s9=-103.0) == pytest.approx(-30)
    assert reward("HopperUpright", [1, 1, 1], s0=1.0, s1=-0.5, s5=1.0) == pytest.approx(1 - 0.015 - 3)
    assert reward("HopperUpright", [0, 0, 0], s0=0.4, s8=103.0, s9=-104.0) == pytest.approx(-0.5 - 3 - 4)
    assert reward("Humanoid", [1] * 17, s46=1.2) == pytest.approx(-0.09 - 0.00017)
    assert reward("HumanoidStandup", [0] * 17, s46=1.7) == pytest.approx(-0.04)


@pytest.mark.parametrize(
    ("height", "ends"), [(0.19, True), (0.2, False), (0.5, False), (1.0, False), (1.01, True), (np.nan, True)]
)
def test_where_the_ant_ends(height, ends):
    state = np.zeros(29)
    state[2] = height
    assert bool(get_task("Ant").terminated(state)) is ends


def test_an_ant_lifted_out_of_its_range_ends_the_episode():
    env = make("Ant")
    env.reset(seed=0)
    assert not env.step(np.zeros(8, np.float32))[2]
    env.data.qpos[2] += 1.0
    assert env.step(np.zeros(8, np.float32))[2]


@pytest.mark.parametrize(("name", "motors"), [("Swimmer", 2), ("Snake", 4)])
def test_a_still_swimmer_goes_nowhere(name, motors):
    assert swim(make(name), lambda step: np.zeros(motors), at_rest=True) == pytest.approx(0, abs=1e-9)


def test_a_swimmer_coasts_on_its_starts_noise_to_either_side():
    env = make("Swimmer")
    returns = [swim(env, lambda step: np.zeros(2), seed) for seed in range(40)]
    assert abs(np.mean(returns)) < 3.0
    assert 2.0 < np.std(returns) < 12.0


def test_some_random_gait_swims():
    """From rest, because the start's noise alone can carry a still swimmer as far; 12.0 when written."""
    rng, env = np.random.default_rng(0), make("Swimmer")
    gaits = [gait(rng.uniform(0.2, 1, 2), rng.uniform(0.2, 2), rng.uniform(-3, 3)) for _ in range(60)]
    assert 8 < max(swim(env, policy, at_rest=True) for policy in gaits) < 30


# ---------------------------------------------------------------- misuse


def test_errors_name_the_remedy():
    with pytest.raises(TaskError, match="did you mean Swimmer"):
        get_task("swimer")
    with pytest.raises(TaskError, match="rgb_array"):
        make("Hopper").__class__("Hopper", render_mode="human")
    env = make("Hopper")
    env.reset(seed=0)
    with pytest.raises(TaskError, match="3 finite numbers"):
        env.step(np.array([0, np.nan, 0], np.float32))
    with pytest.raises(TaskError, match="3 finite numbers"):
        env.step(np.zeros(1, np.float32))


def test_a_diverged_simulation_is_reported_and_over_after_reset():
    env = make("Hopper")
    env.reset(seed=0)
    env.data.qvel[:] = np.nan
    with pytest.raises(TaskError, match="diverged"):
        env.step(np.zeros(3, np.float32))
    assert np.isfinite(env.reset()[0]).all()


# ---------------------------------------------------------------- pictures


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_shows_the_robot_wherever_it_is(name):
    env = make(name, render_mode="rgb_array")
    env.reset(seed=0)
    try:
        near = env.render()
    except TaskError as error:
        pytest.skip(f"no GL here: {error}")
    assert near.shape == (480, 480, 3)
    assert near.dtype == np.uint8
    middle = near[120:360, 120:360]
    assert (middle[..., 0] > middle[..., 2] + 40.0).mean() > 0.005  # the robots are orange, the floor and sky are not
    if name not in ("Humanoid", "HumanoidStandup"):
        env.data.qpos[0] += 7.0
        env._observe()
        far = env.render()[120:360, 120:360]
        assert (far[..., 0] > far[..., 2] + 40.0).mean() > 0.005
    env.close()
    env.close()


def test_no_picture_unless_asked_for():
    assert make("Swimmer").render() is None


@pytest.mark.parametrize("setting", ["glfw", "egl"])
def test_no_gl_says_what_to_install(monkeypatch, setting):
    monkeypatch.setenv("MUJOCO_GL", setting)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setattr(mujoco, "GLContext", None)
    env = make("Hopper", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(TaskError, match=r"no OpenGL to render with .*: apt install libosmesa6"):
        env.render()
