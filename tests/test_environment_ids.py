"""`gymnasium.make("metrpo/Swimmer-v0")` works wherever metrpo and Gymnasium are imported, in either order."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import metrpo
from metrpo.environment_ids import HORIZONS, env_id, register_ids


@pytest.mark.parametrize("imports", ["import metrpo, gymnasium", "import gymnasium, metrpo"])
def test_the_ids_are_known_after_both_imports(imports):
    code = (
        f"import sys; {imports}; print([m for m in ('jax', 'mujoco', 'metrpo.world') if m in sys.modules]); "
        "env = gymnasium.make('metrpo/Swimmer-v0'); print(env.reset(seed=0)[0].shape, 'jax' in sys.modules); "
        "print(importlib.resources.files('gymnasium').joinpath('envs').is_dir())"
    )
    command = [sys.executable, "-c", f"import importlib.resources; {code}"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (ran.stdout.splitlines(), ran.stderr) == (["[]", "(10,) False", "True"], "")


def test_metrpo_alone_does_not_import_gymnasium():
    code = "import metrpo, sys; print([m for m in ('gymnasium', 'numpy', 'jax', 'mujoco') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_gymnasium_imports_us_for_an_id_with_our_name_before_it():
    code = "import gymnasium; print(gymnasium.make('metrpo:metrpo/Swimmer-v0').reset(seed=0)[0].shape)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "(10,)\n"


def test_every_task_has_its_id_and_horizon():
    ours = {task.name: task.horizon for task in metrpo.tasks().values() if (task.env_id or "").startswith("metrpo/")}
    assert ours == HORIZONS
    for task, horizon in HORIZONS.items():
        assert gymnasium.spec(env_id(task)).max_episode_steps == horizon


def test_an_id_that_is_known_stays_as_it_is(monkeypatch):
    mine = gymnasium.registry[env_id("Swimmer")]
    register_ids()  # warnings are errors: Gymnasium would warn of the second
    assert gymnasium.registry[env_id("Swimmer")] is mine


def made_of_dicts(**kwargs):
    """An environment with a Dict of observations and a range of actions that is not even."""
    env = gymnasium.make("Pendulum-v1", disable_env_checker=True, **kwargs)
    space = gymnasium.spaces.Dict({"arm": env.observation_space})
    env = gymnasium.wrappers.TransformObservation(env, lambda x: {"arm": x}, space)
    return gymnasium.wrappers.RescaleAction(env, np.float32(-0.5), np.float32(3))


@pytest.mark.parametrize("name", ["Pendulum-v1", "HalfCheetah-v5", "mbbl/CartPole", f"{__name__}:made_of_dicts"])
def test_wrapped_environments_pass_gymnasiums_own_check(name, recwarn):
    env = metrpo.get_task(name).make_env()
    check_env(env, skip_render_check=True)
    env.close()
    # Observations are unbounded on purpose: what an environment shows may be anything.
    assert [w for w in recwarn if "observation space" not in str(w.message)] == []
