"""A saved policy acts as the trained one did, in NumPy alone."""

import dataclasses
import hashlib
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from metrpo.errors import RunDirectoryError
from metrpo.policy import gaussian
from metrpo.run.directory import stored_config
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.world.interface import Interface

S, A, HIDDEN = 5, 2, (8, 6)


@pytest.fixture
def policy():
    return gaussian.init(jax.random.key(0), S, A, HIDDEN, 1.0)


@pytest.fixture
def loaded(policy, tmp_path):
    save_policy(tmp_path, policy, "Swimmer", Learned(3, 900, 12.5))
    return load_policy(tmp_path)


@pytest.mark.parametrize("shape", [(S,), (1, S), (7, S), (0, S)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_clipped_mean_of_the_trained_policy(policy, loaded, shape, dtype):
    observations = 10 * np.random.default_rng(0).standard_normal(shape).astype(dtype)
    actions = loaded(observations)
    expected = np.clip(gaussian.mean(policy, jax.numpy.asarray(observations, np.float32)), -1, 1)
    assert (actions.dtype, actions.shape) == (np.float32, (*shape[:-1], A))
    np.testing.assert_allclose(actions, expected, atol=1e-5)


def test_actions_are_clipped_and_repeatable(policy, tmp_path):
    loud = policy._replace(layers=jax.tree.map(lambda w: 50 * w, policy.layers))
    save_policy(tmp_path, loud, "Swimmer", Learned(1, 1, None))
    observations = np.random.default_rng(0).standard_normal((50, S))
    actions = load_policy(tmp_path)(observations)
    assert np.abs(actions).max() == 1
    np.testing.assert_array_equal(actions, load_policy(tmp_path)(observations))


def test_an_interface_of_other_sizes_is_left_out(policy, tmp_path):
    fitting = Interface(((S, "all"),), (-1.0,) * A, (2.0,) * A)
    save_policy(tmp_path, policy, "Swimmer", Learned(3, 900, 12.5), fitting)
    assert load_policy(tmp_path).info.action_high == (2.0,) * A
    for other in (
        dataclasses.replace(fitting, observation=((S - 1, "x"),)),
        dataclasses.replace(fitting, action_low=()),
    ):
        save_policy(tmp_path, policy, "Swimmer", Learned(3, 900, 12.5), other)
        assert load_policy(tmp_path).info.action_high is None


@pytest.mark.parametrize("shape", [(), (S + 1,), (4, S + 1), (2, 3, S), (S, 1)])
def test_other_shapes_say_what_was_expected(loaded, shape):
    with pytest.raises(ValueError, match=r"expected shape \[5\] or \[B, 5\], got \[") as error:
        loaded(np.zeros(shape))
    assert str(list(shape)) in str(error.value)


def test_another_shape_says_what_an_observation_is_made_of(policy, tmp_path):
    interface = Interface(((1, "global x, added by metrpo"), (S - 1, "as Gymnasium makes it")), (-1.0,) * A, (1.0,) * A)
    save_policy(tmp_path, policy, "Swimmer", Learned(3, 900, 12.5), interface)
    with pytest.raises(ValueError, match=r"\(1: global x, added by metrpo; 4: as Gymnasium makes it\), got \[4\]"):
        load_policy(tmp_path)(np.zeros(S - 1))


def test_the_json_beside_it_describes_it(loaded, tmp_path):
    beside = json.loads((tmp_path / "policy.json").read_text())
    assert beside["sha256"] == hashlib.sha256((tmp_path / "policy.npz").read_bytes()).hexdigest()
    expected = {
        "task": "Swimmer",
        "observation_size": S,
        "action_size": A,
        "hidden": list(HIDDEN),
        "activation": "tanh",
        "iteration": 3,
        "real_steps": 900,
        "return_real": 12.5,
        "format": 1,
    }
    assert expected.items() <= beside.items()
    assert loaded.info.hidden == HIDDEN


def test_the_file_itself_can_be_loaded(loaded, tmp_path):
    np.testing.assert_array_equal(load_policy(tmp_path / "policy.npz")(np.ones(S)), loaded(np.ones(S)))


def test_its_repr_is_a_line_without_weights(loaded):
    assert repr(loaded) == f"LoadedPolicy(info={loaded.info!r})"


def test_no_policy_says_how_to_get_one(tmp_path):
    with pytest.raises(
        RunDirectoryError, match=r"holds no policy: expected .*policy\.npz; train one with: metrpo train"
    ):
        load_policy(tmp_path)


def test_a_damaged_policy_is_refused(loaded, tmp_path):
    path = tmp_path / "policy.npz"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(RunDirectoryError, match=r"policy\.npz is damaged") as error:
        load_policy(tmp_path)
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(RunDirectoryError, match=r"got none: its end is missing") as error:
        load_policy(tmp_path)
    assert "\\x" not in str(error.value), "no raw bytes"


def test_a_folder_of_runs_is_refused_with_the_name_of_one(loaded, tmp_path):
    (tmp_path / "runs").mkdir()
    os.rename(tmp_path / "policy.npz", tmp_path / "runs" / "policy.npz")
    with pytest.raises(RunDirectoryError, match=rf"name one of them, such as {tmp_path}/runs$") as error:
        load_policy(tmp_path)
    assert "metrpo train" not in str(error.value)
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "config.json").write_text("{}")
    with pytest.raises(RunDirectoryError, match="first iteration is not finished") as error:
        load_policy(tmp_path / "begun")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(RunDirectoryError, match=r"expected the file .*mine\.npz, got none"):
        load_policy(tmp_path / "mine.npz")
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/config.json").write_text("{}")
    with pytest.raises(RunDirectoryError, match=rf"got a folder of runs, such as {tmp_path}/a/b"):
        stored_config(tmp_path / "a")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda arrays: arrays.update(extra=np.zeros(1, np.float32)), "got 'extra' besides"),
        (lambda arrays: arrays.pop("b0"), "b0 is missing"),
        (lambda arrays: arrays.update(log_std=np.zeros(7, np.float32)), r"got log_std of \[7\] instead of \[2\]"),
    ],
)
def test_the_array_that_does_not_fit_is_named(loaded, tmp_path, change, said):
    arrays, meta = read_arrays(tmp_path / "policy.npz")
    change(arrays)
    write_arrays(tmp_path / "policy.npz", arrays, {"policy": meta["policy"]})
    with pytest.raises(RunDirectoryError, match=said):
        load_policy(tmp_path)


def test_other_arrays_are_no_policy(tmp_path):
    write_arrays(tmp_path / "policy.npz", {"x": np.zeros(2)}, {})
    with pytest.raises(RunDirectoryError, match="is no policy: it lacks task, observation_size"):
        load_policy(tmp_path)


def test_deployment_needs_neither_jax_nor_mujoco(loaded, tmp_path):
    code = (
        "import sys, numpy, metrpo; metrpo.load_policy(sys.argv[1])(numpy.zeros(5)); "
        "print([m for m in ('jax', 'mujoco', 'gymnasium', 'matplotlib') if m in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert ran.stdout == "[]\n"


def test_a_run_without_a_best_policy_says_why_and_where_its_last_one_is(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(RunDirectoryError, match=rf"got a run that was never evaluated, or .* is in {tmp_path}$"):
        load_policy(tmp_path / "best")
