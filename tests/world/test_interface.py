"""What a task says of its states and actions is what its environment shows and takes."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Tuple

import metrpo
from metrpo import external
from metrpo.world.interface import of_env
from metrpo.world.tasks.gymnasium_formulas import KNOWN

EACH = ["Pendulum-v1", "mbbl/HalfCheetah", *(name for name, known in KNOWN.items() if known.added)]


@pytest.mark.parametrize("name", [*metrpo.tasks(), *EACH])
def test_the_parts_make_up_the_state(name):
    task = metrpo.get_task(name)
    shows = task.interface
    assert sum(size for size, _ in shows.observation) == task.state_size
    assert len(shows.action_low) == len(shows.action_high) == task.action_size


@pytest.mark.parametrize("name", sorted(name for name, known in KNOWN.items() if known.added))
def test_what_is_not_added_is_what_the_plain_environment_shows(name):
    task = metrpo.get_task(name)
    (added, text), (rest, _) = task.interface.observation
    plain, ours = gymnasium.make(name, disable_env_checker=True), task.make_env()
    shown, state = plain.reset(seed=0)[0], ours.reset(seed=0)[0]
    np.testing.assert_array_equal(shown, state[added:])
    np.testing.assert_array_equal(plain.unwrapped.data.qpos[:added], state[:added])
    assert len(shown) == rest
    assert text.startswith("global x and y" if added == 2 else "global x,")
    np.testing.assert_array_equal(task.interface.action_high, plain.action_space.high)
    plain.close()
    ours.close()


@pytest.mark.parametrize("name", ["Swimmer", "Snake", "Hopper", "HalfCheetah", "Ant"])
def test_the_papers_tasks_show_what_they_say(name):
    task = metrpo.get_task(name)
    env = task.make_env()
    state, data = env.reset(seed=0)[0], env.unwrapped.data
    position, angles, velocity, rates = np.split(
        state, np.cumsum([size for size, _ in task.interface.observation])[:-1]
    )
    axes = ["xyz".index(axis) for axis in task.interface.observation[0][1].split(" of ")[0].split(", ")]
    np.testing.assert_array_equal(position, data.subtree_com[1][axes])
    np.testing.assert_array_equal(angles, data.qpos[-len(angles) :])
    np.testing.assert_array_equal(rates, data.qvel[-len(rates) :])
    assert len(velocity) == len(task.interface.observation[2][1].split("along ")[1].split(","))
    env.close()


def test_the_humanoid_shows_what_it_says():
    env = metrpo.get_task("Humanoid").make_env()
    state, data = env.reset(seed=0)[0], env.unwrapped.data
    np.testing.assert_array_equal(state[:21], data.qpos[3:])
    np.testing.assert_array_equal(state[21:44], data.qvel)
    env.close()


def test_parts_of_dicts_and_tuples_are_named_in_state_order():
    class Nested(gymnasium.Env):
        observation_space = Dict({"b": Box(0, 1, (2, 2)), "a": Tuple([Box(0, 1, (1,)), Box(0, 1, (3,))])})
        action_space = Box(np.array([-1, 0], np.float32), np.array([1, 5], np.float32))

    shows = of_env(Nested(), "Mine")
    space = Nested.observation_space
    flat = gymnasium.spaces.flatten(space, {"a": (np.full(1, 0.1), np.full(3, 0.2)), "b": np.full((2, 2), 0.3)})
    expected = {"Mine['a'][0]": 0.1, "Mine['a'][1]": 0.2, "Mine['b']": 0.3}
    start = 0
    for size, text in shows.observation:
        np.testing.assert_allclose(flat[start : start + size], expected[text.removeprefix("the observation of ")])
        start += size
    assert start == len(flat)
    assert (shows.action_low, shows.action_high) == ((-1, 0), (1, 5))


def test_a_run_writes_its_tasks_interface_into_the_policys_file(tmp_path):
    config = metrpo.preset("Swimmer")
    external.begin(config, tmp_path)
    assert metrpo.load_policy(tmp_path).info.observation == metrpo.get_task("Swimmer").interface.observation
