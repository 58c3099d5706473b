"""Tasks with known formulas: Gymnasium's own and MBBL's; formulas against the environments, step by step."""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RescaleAction

from metrpo.errors import TaskError
from metrpo.world.tasks import mbbl
from metrpo.world.tasks.gymnasium_formulas import _TORSO, KNOWN, _centre_x

SIZES = {  # S, A, T, dimensions that are global positions
    "Pendulum-v1": (3, 1, 200, ()),
    "MountainCarContinuous-v0": (2, 1, 999, ()),
    "InvertedPendulum-v5": (4, 1, 1000, ()),
    "InvertedDoublePendulum-v5": (9, 1, 1000, ()),
    "Reacher-v5": (10, 2, 50, ()),
    "Pusher-v5": (23, 7, 100, ()),
    "Swimmer-v5": (10, 2, 1000, (0, 1)),
    "HalfCheetah-v5": (18, 6, 1000, (0,)),
    "Hopper-v5": (12, 3, 1000, (0,)),
    "Walker2d-v5": (18, 6, 1000, (0,)),
    "Ant-v5": (107, 8, 1000, (0, 1)),
    "Humanoid-v5": (350, 17, 1000, (0, 1)),
    "mbbl/Pendulum": (3, 1, 200, ()),
    "mbbl/CartPole": (4, 1, 200, ()),
    "mbbl/HalfCheetah": (17, 6, 1000, ()),
    "mbbl/Swimmer": (9, 2, 1000, ()),
    "mbbl/Hopper": (11, 3, 1000, ()),
    "mbbl/Ant": (27, 8, 1000, ()),
}
NAMES = list(SIZES)
MBBL = [name for name in NAMES if name.startswith("mbbl/")]
ROBOTS = ["mbbl/HalfCheetah", "mbbl/Swimmer", "mbbl/Hopper", "mbbl/Ant"]
ENDING = ["MountainCarContinuous-v0", "InvertedPendulum-v5", "InvertedDoublePendulum-v5"]
HEALTHY = ["Hopper-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5"]


def rescaled(name):
    return RescaleAction(KNOWN[name].make(), np.float32(-1), np.float32(1))


def action_of(step, rng, env):
    action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
    return np.sign(action) if step % 3 == 2 else action


def pump(state, rng):
    """Along with the motion: climbs out of the mountain car's valley."""
    return rng.uniform(0.8, 1.0, 1).astype(np.float32) * (1 if state[1] >= 0 else -1)


@cache
def transitions(name, count=400, seed=0):
    """`count` transitions (s, a, r, s', terminated, episode) of at most 120 steps a start, as arrays."""
    env, rng = rescaled(name), np.random.default_rng(seed)
    rows, episode, length = [], 0, 0
    state = env.reset(seed=seed)[0]
    for step in range(count):
        climbs = name == "MountainCarContinuous-v0" and episode % 2 == 0  # random actions never get there
        action = pump(state, rng) if climbs else action_of(step, rng, env)
        next_state, reward, terminated, truncated, _ = env.step(action)
        rows.append((state, action, reward, next_state, terminated, episode))
        length += 1
        state = next_state
        if terminated or truncated or length >= 120:
            episode, length = episode + 1, 0
            state = env.reset(seed=seed + 1000 * episode)[0]
    env.close()
    return [np.array(column) for column in zip(*rows, strict=True)]


# ---------------------------------------------------------------- the table


def test_the_table_is_the_one_of_these_tests():
    assert list(KNOWN) == NAMES
    assert all(known.name == name and known.description for name, known in KNOWN.items())
    assert {name for name in NAMES if KNOWN[name].terminated} == {*ENDING, *HEALTHY}


def test_the_import_makes_no_environment_and_leaves_jax_alone():
    code = (
        "import gymnasium, sys\n"
        "def never(*_, **__): raise AssertionError('made at import')\n"
        "gymnasium.make = gymnasium.Env.reset = never\n"
        "from metrpo.world.tasks.gymnasium_formulas import KNOWN\n"
        "assert len(KNOWN) > 10 and 'jax' not in sys.modules and 'pygame' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("name", NAMES)
def test_sizes_and_horizon(name):
    size, actions, horizon, unseen = SIZES[name]
    env = KNOWN[name].make()
    assert env.observation_space.shape == (size,)
    assert env.action_space.shape == (actions,)
    assert env.spec.max_episode_steps == horizon
    assert KNOWN[name].unseen == unseen
    assert isinstance(env.observation_space, gymnasium.spaces.Box)
    assert env.render_mode is None
    env.close()


@pytest.mark.parametrize("name", [name for name in NAMES if SIZES[name][3]])
def test_the_unseen_are_global_positions_that_nothing_feels(name):
    """A robot moved far away moves on alike: neither its state elsewhere nor its reward changes."""
    known, results = KNOWN[name], []
    unseen = list(known.unseen)
    for offset in (0.0, 5.0):
        env = known.make().unwrapped
        env.reset(seed=3)
        qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
        qpos[unseen] += offset
        env.set_state(qpos, qvel)
        # Not np.zeros: a robot at rest would hide much.
        action = np.full(env.action_space.shape, 0.3 * env.action_space.high[0], np.float32)
        steps = [env.step(action) for _ in range(3)]
        np.testing.assert_allclose(steps[-1][0][unseen], env.data.qpos[unseen])
        results.append((steps[-1][0], steps[-1][1]))
    (near, reward), (far, far_reward) = results
    np.testing.assert_allclose(far[unseen] - near[unseen], 5.0, atol=1e-6)
    np.testing.assert_allclose(np.delete(far, unseen), np.delete(near, unseen), atol=1e-5)
    assert far_reward == pytest.approx(reward, abs=1e-5)


@pytest.mark.parametrize("name", ["Pendulum-v1", "Reacher-v5", "Pusher-v5", "Swimmer-v5", *MBBL])
def test_where_nothing_ends_an_episode_the_clock_does(name):
    env, rng, horizon = rescaled(name), np.random.default_rng(0), SIZES[name][2]
    env.reset(seed=0)
    ends = [env.step(action_of(step, rng, env))[2:4] for step in range(horizon)]
    assert ends == [(False, False)] * (horizon - 1) + [(False, True)]


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_episode(name):
    one = transitions(name, 40, 7)
    transitions.cache_clear()
    two, other = transitions(name, 40, 7), transitions(name, 40, 8)
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert not np.allclose(one[0], other[0])


# ---------------------------------------------------------------- formulas against environments


@pytest.mark.parametrize("name", NAMES)
def test_reward_and_end_are_those_of_the_environment(name):
    known = KNOWN[name]
    states, actions, rewards, next_states, ends, episodes = transitions(name)
    assert len(rewards) >= 300
    assert episodes[-1] >= 2
    assert len(np.unique(rewards)) > 2 or name == "InvertedPendulum-v5"  # its reward is 1 or 0
    close = {"rtol": 1e-4, "atol": max(known.reward_error, 1e-6)}
    np.testing.assert_allclose(known.reward(states, actions, next_states), rewards, **close)
    if known.terminated is None:
        assert not ends.any()
    else:
        assert ends.any()
        assert not ends.all()
        np.testing.assert_array_equal(known.terminated(next_states), ends)
    if known.reward_error:
        # Of an episode's errors only that of its last position remains, the others cancel.
        errors = known.reward(states, actions, next_states) - rewards
        sums = np.array([errors[episodes == episode].sum() for episode in range(episodes[-1])])
        assert abs(sums).max() < 2 * known.reward_error
        assert abs(errors).mean() < 0.1 * known.reward_error


@pytest.mark.parametrize("name", NAMES)
def test_jax_numpy_batches_and_single_precision_agree(name):
    known = KNOWN[name]
    exact = known.reward(*(x.astype(np.float64) for x in _triple(name)))
    single = [x.astype(np.float32) for x in _triple(name)]
    # Global positions of metres over hundredths of a second: single precision leaves 1e-4 m/s and less.
    close = {"rtol": 1e-4, "atol": 2e-3 if known.unseen else 2e-5}
    rewards = known.reward(*single)
    assert rewards.dtype == np.float32
    np.testing.assert_allclose(rewards, exact, **close)
    grid = [x[:12].reshape(3, 4, -1) for x in single]
    assert known.reward(*grid).shape == (3, 4)
    np.testing.assert_allclose(known.reward(*grid).ravel(), rewards[:12], rtol=1e-6)
    assert np.shape(known.reward(*(x[0] for x in single))) == ()
    reward = jax.jit(known.reward)
    in_jax = reward(*map(jnp.asarray, grid))
    assert isinstance(in_jax, jax.Array)
    assert (in_jax.shape, in_jax.dtype) == ((3, 4), jnp.float32)
    np.testing.assert_allclose(np.ravel(in_jax), exact[:12], **close)
    if known.terminated is not None:
        ends = known.terminated(single[2])
        assert ends.dtype == bool
        assert known.terminated(grid[2]).shape == (3, 4)
        assert np.shape(known.terminated(single[2][0])) == ()
        in_jax = jax.jit(known.terminated)(jnp.asarray(single[2]))
        assert in_jax.dtype == bool
        np.testing.assert_array_equal(in_jax, ends)


def _triple(name):
    states, actions, _, next_states, _, _ = transitions(name)
    return states, actions, next_states


@pytest.mark.parametrize("name", HEALTHY)
def test_health_is_the_environments_in_states_of_every_kind(name):
    """States drawn far beyond every threshold, each side of each of which is visited."""
    env, rng, expected, got = KNOWN[name].make().unwrapped, np.random.default_rng(0), [], []
    env.reset(seed=0)
    planar = name in ("Hopper-v5", "Walker2d-v5")
    height = 1 if planar else 2
    for _ in range(400):
        qpos, qvel = env.init_qpos.copy(), rng.normal(size=env.model.nv)
        qpos[height] = rng.uniform(0.0, 2.5)
        if planar:
            qpos[2] = rng.uniform(-1.5, 1.5) * (0.2 if name == "Hopper-v5" else 1.0)
        if name == "Hopper-v5" and rng.random() < 0.1:
            qpos[3] = rng.choice([-1, 1]) * rng.uniform(90, 110)
        env.set_state(qpos, qvel)
        expected.append(bool(env.is_healthy))
        got.append(not KNOWN[name].terminated(env._get_obs()))
    assert 0.02 < np.mean(expected) < 0.98
    assert got == expected


@pytest.mark.parametrize(
    ("name", "index"),
    [("InvertedPendulum-v5", 3), ("Ant-v5", 20), ("Hopper-v5", 8), ("Walker2d-v5", 2), ("Humanoid-v5", 2)],
)
def test_what_is_not_a_number_is_an_end(name, index):
    state = KNOWN[name].make().reset(seed=0)[0]
    assert not KNOWN[name].terminated(state)
    state[index] = np.nan
    assert KNOWN[name].terminated(state)


def test_hoppers_rates_beyond_the_clip_cannot_be_seen():
    """The one part of a termination that the observation does not hold."""
    env = KNOWN["Hopper-v5"].make().unwrapped
    env.reset(seed=0)
    qvel = np.zeros(6)
    qvel[5] = 120.0
    env.set_state(env.init_qpos, qvel)
    assert not env.is_healthy
    assert env._get_obs()[-1] == 10.0
    assert not KNOWN["Hopper-v5"].terminated(env._get_obs())


@pytest.mark.parametrize(
    ("position", "velocity", "there"), [(0.46, 0.01, True), (0.46, -0.01, False), (0.4, 0.05, False)]
)
def test_the_mountain_car_is_there_only_forwards(position, velocity, there):
    state = np.array([position, velocity], np.float32)
    assert bool(KNOWN["MountainCarContinuous-v0"].terminated(state)) is there
    reward = KNOWN["MountainCarContinuous-v0"].reward(state, np.array([0.5], np.float32), state)
    assert reward == pytest.approx(100 * there - 0.025)


def test_pendulum_reads_the_angle_before_the_step_on_either_side():
    env = rescaled("Pendulum-v1")
    for angle in (-3 * np.pi, -3.2, -3.1, 0.0, 0.4, 3.1, 3.2, 7.0):
        env.reset(seed=0)
        env.unwrapped.state = np.array([angle, -1.5])
        state = env.unwrapped._get_obs()
        next_state, reward, *_ = env.step(np.array([0.7], np.float32))
        formula = KNOWN["Pendulum-v1"].reward(state, np.array([0.7], np.float32), next_state)
        assert formula == pytest.approx(reward, rel=1e-5)


def test_actions_are_scaled_back():
    """A full action costs what the environment's own largest action does."""

    def cost(name):
        size, actions, _, _ = SIZES[name]
        state = np.ones(size)
        still, full = np.zeros(actions), np.ones(actions)
        return float(KNOWN[name].reward(state, still, state) - KNOWN[name].reward(state, full, state))

    assert cost("Pendulum-v1") == pytest.approx(0.001 * 2**2)
    assert cost("Pusher-v5") == pytest.approx(0.1 * 7 * 2**2)
    assert cost("Humanoid-v5") == pytest.approx(0.1 * 17 * 0.4**2)
    assert cost("Ant-v5") == pytest.approx(0.5 * 8)
    assert cost("Reacher-v5") == pytest.approx(2.0)
    assert cost("mbbl/Pendulum") == pytest.approx(0.001 * 2**2)
    assert cost("mbbl/CartPole") == 0.0
    for name, scale in (("Pendulum-v1", 2.0), ("Pusher-v5", 2.0), ("Humanoid-v5", 0.4), ("mbbl/Pendulum", 2.0)):
        np.testing.assert_allclose(KNOWN[name].make().action_space.high, scale)


@pytest.mark.parametrize("name", ["Ant-v5", "Humanoid-v5"])
def test_all_but_the_distance_is_exact(name):
    """What the distance is worth aside, the rewards that are nearly the environment's are exactly its."""
    known, env, rng = KNOWN[name], rescaled(name), np.random.default_rng(1)
    state = env.reset(seed=1)[0]
    for step in range(300):
        action = action_of(step, rng, env)
        next_state, reward, terminated, _, info = env.step(action)
        if name == "Ant-v5":
            forward = (next_state[0] - state[0]) / env.unwrapped.dt
        else:
            forward = 1.25 * (_centre_x(next_state) - _centre_x(state)) / env.unwrapped.dt
        rest = known.reward(state, action, next_state) - forward
        assert rest == pytest.approx(reward - info["reward_forward"], rel=1e-6, abs=1e-6)
        state = env.reset()[0] if terminated else next_state


def test_the_humanoids_torso_and_centre_of_mass_are_gymnasiums():
    env = KNOWN["Humanoid-v5"].make().unwrapped
    torso = env.model.body("torso")
    assert _TORSO["mass"] == pytest.approx(torso.mass[0], rel=1e-12)
    np.testing.assert_allclose(torso.ipos, [_TORSO["x"], 0.0, _TORSO["z"]], atol=1e-12)
    assert torso.id == 1
    rng, mass = np.random.default_rng(0), env.model.body_mass
    env.reset(seed=0)
    for _ in range(20):
        qpos = env.init_qpos + 0.5 * rng.normal(size=env.model.nq)
        mujoco.mj_normalizeQuat(env.model, qpos)
        env.set_state(qpos, rng.normal(size=env.model.nv))
        centre = (mass * env.data.xipos[:, 0]).sum() / mass.sum()
        assert _centre_x(env._get_obs()) == pytest.approx(centre, abs=1e-9)


def test_contact_forces_are_part_of_the_rewards_that_count_them():
    for name, first in (("Ant-v5", 29), ("Humanoid-v5", 272)):
        next_states = transitions(name)[3]
        assert (abs(next_states[:, first:]).max(axis=1) > 0.5).mean() > 0.05
        ignoring = next_states.copy()
        ignoring[:, first:] = 0
        states, actions, _, _, _, _ = transitions(name)
        cost = KNOWN[name].reward(states, actions, ignoring) - KNOWN[name].reward(states, actions, next_states)
        assert cost.max() > 1e-3
        assert cost.min() >= -1e-12
    state = KNOWN["Humanoid-v5"].make().reset(seed=0)[0]
    state[272:] = 1e6  # a crash costs 10 at most
    assert KNOWN["Humanoid-v5"].reward(state, np.zeros(17), state) == pytest.approx(5 - 10)
    state = KNOWN["Ant-v5"].make().reset(seed=0)[0]
    state[29:] = 1e6  # and here 1 per force
    assert KNOWN["Ant-v5"].reward(state, np.zeros(8), state) == pytest.approx(1 - 5e-4 * 78)


def test_making_a_cheetah_writes_no_log_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    KNOWN["HalfCheetah-v5"].make().close()
    KNOWN["mbbl/HalfCheetah"].make().close()
    assert not list(tmp_path.iterdir())
    assert mujoco.get_mju_user_warning() is None


# ---------------------------------------------------------------- MBBL


# Gymnasium's own pendulum takes torques in N m, too.
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
@pytest.mark.parametrize("name", MBBL)
def test_gymnasium_finds_no_fault(name):
    check_env(KNOWN[name].make().unwrapped, skip_render_check=True)


def slow_reward(name, before, action, tip_speed):
    """MBBL's reward from MuJoCo's own numbers before the step, one term after the other."""
    qpos, qvel = before
    effort = sum(float(a) * float(a) for a in action)
    if name == "mbbl/HalfCheetah":
        return qvel[0] - 0.1 * effort
    if name == "mbbl/Hopper":
        return qvel[0] - 3.0 * (qpos[1] - 1.3) ** 2 - 0.1 * effort + 1.0
    if name == "mbbl/Ant":
        return qvel[0] - 3.0 * (qpos[2] - 0.57) ** 2 - 0.1 * effort + 1.0
    return tip_speed - 0.0001 * effort


def head_x(qpos):
    """x of the swimmer's head, 1.5 m ahead of its root."""
    return qpos[0] + 1.5 * np.cos(qpos[2])


@pytest.mark.parametrize("name", ROBOTS)
def test_rewards_and_states_against_mujocos_own_numbers(name):
    env, rng = KNOWN[name].make(), np.random.default_rng(5)
    data, hidden = env.unwrapped.data, 2 if name in ("mbbl/Swimmer", "mbbl/Ant") else 1
    dt = {"mbbl/HalfCheetah": 0.05, "mbbl/Swimmer": 0.04, "mbbl/Hopper": 0.008, "mbbl/Ant": 0.05}[name]
    for seed in range(3):
        env.reset(seed=seed)
        tip_speed = 0.0
        for step in range(110):
            before, time = (data.qpos.copy(), data.qvel.copy()), data.time
            action = action_of(step, rng, env)
            state, reward, terminated, truncated, _ = env.step(action)
            assert reward == pytest.approx(slow_reward(name, before, action, tip_speed), rel=1e-6, abs=1e-7)
            assert (terminated, truncated) == (False, False)
            assert data.time - time == pytest.approx(dt)
            tip_speed = (head_x(data.qpos) - head_x(before[0])) / dt
            expected = np.concatenate([data.qpos[hidden:], data.qvel, [tip_speed] if name == "mbbl/Swimmer" else []])
            np.testing.assert_allclose(state, expected, atol=1e-7)


def test_the_swimmer_is_gymnasiums_with_a_tip_without_contacts():
    env = KNOWN["mbbl/Swimmer"].make().unwrapped
    model = env.model
    assert (model.opt.timestep, env.frame_skip, model.opt.integrator) == (0.01, 4, mujoco.mjtIntegrator.mjINT_RK4)
    np.testing.assert_allclose(model.actuator_gear[:, 0], 150)
    np.testing.assert_allclose(model.dof_armature, 0.1)
    assert env.reset(seed=0)[0][-1] == 0.0
    rng = np.random.default_rng(0)
    for _ in range(200):
        env.step(np.sign(rng.standard_normal(2)).astype(np.float32))
        assert env.data.ncon == 0


@pytest.mark.parametrize(
    ("name", "position", "rate", "normal"),
    [
        ("mbbl/HalfCheetah", 0.1, 0.1, True),
        ("mbbl/Swimmer", 0.1, 0.1, False),
        ("mbbl/Hopper", 0.005, 0.005, False),
        ("mbbl/Ant", 0.1, 0.1, True),
    ],
)
def test_starts(name, position, rate, normal):
    env = KNOWN[name].make().unwrapped
    starts = []
    for seed in range(300):
        env.reset(seed=seed)
        starts.append((env.data.qpos - env.init_qpos, env.data.qvel.copy()))
    moved, rates = (np.array(column) for column in zip(*starts, strict=True))
    if name == "mbbl/Ant":
        np.testing.assert_allclose(np.linalg.norm((moved + env.init_qpos)[:, 3:7], axis=1), 1)
        assert env.init_qpos[2] == 0.75
        moved = np.delete(moved, range(3, 7), axis=1)
    assert abs(moved).max() <= position
    np.testing.assert_allclose(moved.std(0), position / np.sqrt(3), rtol=0.15)
    np.testing.assert_allclose(rates.std(0), rate if normal else rate / np.sqrt(3), rtol=0.15)
    assert (abs(rates).max() > rate) == normal


def test_a_fallen_hopper_goes_on():
    env = KNOWN["mbbl/Hopper"].make()
    env.reset(seed=0)
    states = [env.step(np.ones(3, np.float32))[0] for _ in range(300)]
    assert min(state[0] for state in states) < 0.6


def test_a_diverged_simulation_is_an_error_and_not_a_new_start(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs it to a file
    env = KNOWN["mbbl/Ant"].make()
    env.reset(seed=0)
    env.unwrapped.data.qvel[:] = 1e12
    with pytest.raises(TaskError, match="mbbl/Ant: the simulation diverged"):
        env.step(np.zeros(8, np.float32))


def test_a_pendulum_hanging_still_gets_200():
    env = KNOWN["mbbl/Pendulum"].make()
    env.reset(seed=0)
    env.unwrapped.state = np.array([np.pi, 0.0])
    rewards = [env.step(np.zeros(1, np.float32))[1] for _ in range(200)]
    assert sum(rewards) == pytest.approx(200, abs=1e-4)
    env.unwrapped.state = np.array([0.0, 0.0])
    assert env.step(np.zeros(1, np.float32))[1] == pytest.approx(-1.0)  # upright, Gym's goal, is the worst place


def test_the_pendulum_is_gyms_and_turns_by_its_unlimited_speed():
    ours, gyms = KNOWN["mbbl/Pendulum"].make().unwrapped, KNOWN["Pendulum-v1"].make().unwrapped
    rng = np.random.default_rng(0)
    for _ in range(200):
        start, torque = rng.uniform([-4, -7], [4, 7]), rng.uniform(-3, 3, 1)
        state, reward = _from(ours, start, torque)
        expected = -(
            np.cos(start[0])
            + 0.1 * abs(np.sin(start[0]))
            + 0.1 * start[1] ** 2
            + 0.001 * np.clip(torque[0], -2, 2) ** 2
        )
        assert reward == pytest.approx(expected, abs=1e-5)
        gyms_state, _ = _from(gyms, start, torque)
        if abs(state[2]) < 8:
            np.testing.assert_allclose(state, gyms_state, atol=1e-6)
    _from(ours, np.array([np.pi / 2, 7.9]), np.array([2.0]))
    np.testing.assert_allclose(ours.state, [np.pi / 2 + 0.05 * (7.9 + 0.75 + 0.3), 8.0])


def _from(env, start, torque):
    env.reset(seed=0)
    env.state = start.copy()
    return env.step(torque)[:2]


def test_a_balanced_cart_pole_gets_200():
    env = KNOWN["mbbl/CartPole"].make()
    env.reset(seed=0)
    total = 0.0
    for _ in range(200):
        env.unwrapped._gym.state = np.zeros(4)  # held still
        total += env.step(np.array([0.3], np.float32))[1]
    assert total == 200.0
    state, _ = env.reset(seed=1)
    total = 0.0
    for _ in range(200):  # pushed towards where the pole falls
        state, reward, _, _, _ = env.step(np.array([state[2] + 0.3 * state[3] + 0.01 * state[0]], np.float32))
        total += reward
    assert 199 < total < 200


@pytest.mark.parametrize(("action", "push"), [(1.0, 1), (0.01, 1), (0.0, 0), (-0.01, 0), (-1.0, 0)])
def test_the_cart_is_pushed_right_above_0_as_gyms_is(action, push):
    env, gyms = KNOWN["mbbl/CartPole"].make(), gymnasium.make("CartPole-v1")
    np.testing.assert_array_equal(env.reset(seed=4)[0], gyms.reset(seed=4)[0])
    start = gyms.unwrapped.state
    state, reward, _, _, _ = env.step(np.array([action], np.float32))
    np.testing.assert_array_equal(state, gyms.step(push)[0])
    assert reward == pytest.approx(np.cos(start[2]) - 0.01 * start[0] ** 2, abs=1e-6)


def test_a_fallen_pole_goes_on_without_a_word():
    env = KNOWN["mbbl/CartPole"].make()
    env.reset(seed=0)
    states = [env.step(np.array([1.0], np.float32)) for _ in range(150)]
    assert max(abs(state[0][2]) for state in states) > 1.0
    assert abs(states[-1][0][0]) > 2.4
    assert not any(state[2] for state in states)
    assert all(env.observation_space.contains(state[0]) for state in states)


@pytest.mark.parametrize(("name", "mean", "std"), [("mbbl/Hopper", -2573, 631), ("mbbl/Ant", 474, 41)])
def test_random_actions_get_about_what_the_benchmark_reports(name, mean, std):
    """One episode each; the published mean and deviation are over many."""
    env, rng, total = KNOWN[name].make(), np.random.default_rng(0), 0.0
    env.reset(seed=0)
    for _ in range(mbbl.TASKS[name.removeprefix("mbbl/")].horizon):
        total += env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))[1]
    assert abs(total - mean) < 4 * std
