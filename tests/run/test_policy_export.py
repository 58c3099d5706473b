"""An exported policy acts as the trained one in every form, and nothing is exported that cannot act."""

import re

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from exported import READERS, A, S, needs_onnx, python, rename, saved
from helpers import random_policy
from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.policy import gaussian
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.world.interface import Interface


@pytest.mark.parametrize("hidden", [(), (8,), (32, 32), (100, 50, 25)])
@pytest.mark.parametrize("ending", READERS)
def test_every_form_is_the_clipped_mean_of_the_trained_policy(ending, hidden, tmp_path):
    needs_onnx(ending)
    policy = saved(tmp_path, hidden)
    act = READERS[ending](export(tmp_path, tmp_path / f"exported{ending}"))
    rng = np.random.default_rng(0)
    # With one huge number in each, float32 sums do not cancel, so that every order of summation gives the same.
    huge = rng.standard_normal((2 * S, S)) + 1e6 * np.concatenate([np.eye(S), -np.eye(S)])
    batches = [rng.standard_normal((1000, S)), huge, rng.standard_normal((1, S)), np.zeros((1, S)), np.zeros((0, S))]
    ends = np.cumsum([len(observations) for observations in batches[:-1]])
    together = jnp.asarray(np.concatenate(batches), jnp.float32)
    expected = np.clip(gaussian.mean(policy, together), -1, 1)
    for observations, wanted in zip(batches, np.split(expected, ends), strict=True):
        actions = act(observations)
        assert (actions.dtype, actions.shape) == (np.float32, (len(observations), A))
        np.testing.assert_allclose(actions, wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("ending", READERS)
def test_actions_are_clipped(ending, tmp_path):
    needs_onnx(ending)
    saved(tmp_path, scale=50.0)
    act = READERS[ending](export(tmp_path, tmp_path / f"exported{ending}"))
    actions = act(np.random.default_rng(0).standard_normal((50, S)))
    assert (actions.min(), actions.max()) == (-1, 1)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
def test_an_observation_that_is_not_finite_gets_no_action(tmp_path, value):
    saved(tmp_path)
    for act in (python(export(tmp_path)).act, load_policy(tmp_path)):
        for shape, at in (((S,), [3]), ((4, S), [2, 3])):
            observation = np.zeros(shape)
            observation[tuple(at)] = value
            with pytest.raises(ValueError, match="expected finite numbers, got .* at " + re.escape(str(at))):
                act(observation)


TO_ENV = {".py": lambda path: python(path).to_env, ".npz": lambda path: load_policy(path).to_env}


@pytest.mark.parametrize("ending", TO_ENV)
@pytest.mark.parametrize(
    ("low", "high", "dtype"),
    [((-2.0, -0.5, 1.0), (2.0, 3.0, 5.0), np.float32), ((-2.7, 0.1, -1e9), (2.4, 0.3, 1e9), np.float64)],
)
def test_actions_in_real_units_are_those_of_the_wrapper(ending, low, high, dtype, tmp_path):
    saved(tmp_path, interface=Interface(((S, "all"),), low, high))
    to_env = TO_ENV[ending](export(tmp_path, tmp_path / f"exported{ending}"))
    actions = np.array([[-1, -1, -1], [1, 1, 1], [0, 0, 0], [0.25, -0.5, 2], [-7, 0.999, 1]], np.float32)
    found = to_env(actions)
    box = gymnasium.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    assert found.dtype == dtype
    assert all(box.contains(row) for row in found)
    np.testing.assert_array_equal(found[:2], [box.low, box.high])
    np.testing.assert_allclose(found[2], (np.array(low) + high) / 2, rtol=1e-6)
    np.testing.assert_allclose(found[3], np.array(low) + np.array([0.625, 0.25, 1]) * (np.array(high) - low), rtol=1e-6)
    np.testing.assert_array_equal(to_env(actions[3]), found[3])
    for shape in [(), (A + 1,), (2, 2, A)]:
        with pytest.raises(ValueError, match=r"action: expected shape \[3\] or \[B, 3\]"):
            to_env(np.zeros(shape))


@pytest.mark.parametrize("ending", TO_ENV)
def test_a_policy_of_old_acts_and_says_that_it_knows_no_range(ending, ordinary, tmp_path):
    arrays, meta = read_arrays(ordinary.with_name("policy.npz"))
    old = {k: v for k, v in meta["policy"].items() if k not in ("observation", "action_low", "action_high")}
    write_arrays(tmp_path / "policy.npz", arrays, {"policy": old})
    path = export(tmp_path, tmp_path / f"exported{ending}")
    observation = np.linspace(-1, 1, S)
    np.testing.assert_array_equal(READERS[ending](path)(observation), load_policy(ordinary.parent)(observation))
    with pytest.raises(ValueError, match="does not say its environment's range of actions"):
        TO_ENV[ending](path)(np.zeros(A))
    if ending == ".py":
        assert "not known: scale the actions yourself" in python(path).__doc__


def test_a_known_tasks_old_policy_is_exported_with_its_range(tmp_path):
    save_policy(
        tmp_path, random_policy(0, 3, 1), "Pendulum-v1", Learned(1, 1000, 1.0)
    )  # without its interface, as before
    assert python(export(tmp_path)).control(np.zeros(3)).shape == (1,)
    save_policy(tmp_path, random_policy(0, 3, 1), f"{tmp_path}/evil.py:make", Learned(1, 1000, 1.0))
    (tmp_path / "evil.py").write_text("raise SystemExit(9)")
    assert python(export(tmp_path)).ACTION_LOW is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("observation", [[S - 1, "too few"]]),
        ("observation", [[S, 3]]),
        ("observation", [S]),
        ("observation", "all"),
        ("action_low", [0.0] * (A - 1)),
        ("action_low", [float("nan")] * A),
        ("action_high", [10**400] * A),
        ("action_high", [True] * A),
    ],
)
def test_a_layout_or_range_that_cannot_be_is_refused(name, value, ordinary, tmp_path):
    rename(ordinary.with_name("policy.npz"), tmp_path, **{name: value})
    with pytest.raises(RunDirectoryError, match=rf"policy\.npz: {name}: expected .* got"):
        load_policy(tmp_path)


@pytest.fixture(scope="module")
def ordinary(tmp_path_factory):
    directory = tmp_path_factory.mktemp("ordinary")
    saved(directory)
    return export(directory)


def test_npz_is_a_copy(tmp_path):
    saved(tmp_path)
    copy = export(tmp_path, tmp_path / "there" / "swim.npz")
    assert copy.read_bytes() == (tmp_path / "policy.npz").read_bytes()
    assert export(copy) == tmp_path / "there" / "policy.py"


@pytest.mark.parametrize(
    ("name", "got"), [("policy.pt", r"\.pt"), ("policy", "no ending"), ("policy.py.txt", r"\.txt")]
)
def test_other_endings_say_what_was_expected(name, got, tmp_path):
    saved(tmp_path)
    with pytest.raises(MetrpoError, match=rf"expected a name that ends in \.py, \.onnx, \.npz; got {got}"):
        export(tmp_path, tmp_path / name)


@pytest.mark.parametrize("ending", [".py", ".npz"])
def test_what_is_no_policy_leaves_the_old_file(ending, tmp_path):
    out = tmp_path / f"out{ending}"
    out.write_text("old")
    with pytest.raises(RunDirectoryError, match="holds no policy"):
        export(tmp_path, out)
    saved(tmp_path)
    content = (tmp_path / "policy.npz").read_bytes()
    (tmp_path / "policy.npz").write_bytes(content[:-100] + b"!" + content[-99:])
    with pytest.raises(RunDirectoryError, match="is damaged"):
        export(tmp_path, out)
    assert out.read_text() == "old"


@pytest.mark.parametrize(
    ("array", "value", "message"),
    [
        ("w0", np.zeros((S, 9), np.float32), "expected weights and biases of shapes .* got .*9"),
        ("b0", np.full(8, np.nan, np.float32), "expected finite weights"),
    ],
)
def test_a_policy_that_cannot_act_is_refused(array, value, message, tmp_path):
    saved(tmp_path)
    arrays, meta = read_arrays(tmp_path / "policy.npz")
    write_arrays(tmp_path / "policy.npz", arrays | {array: value}, {"policy": meta["policy"]})
    with pytest.raises(RunDirectoryError, match=message):
        export(tmp_path)


def test_a_directory_in_the_way_is_named(tmp_path):
    saved(tmp_path)
    (tmp_path / "policy.py").mkdir()
    with pytest.raises(RunDirectoryError, match=r"cannot write .*policy\.py"):
        export(tmp_path)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("name", "better"),
    [
        ("2swim-policy", "swim_policy"),
        ("my-policy", "my_policy"),
        ("class", "class_policy"),
        ("007", "my_policy"),
    ],
)
def test_an_unimportable_name_is_refused_with_a_better_one(name, better, tmp_path):
    saved(tmp_path)
    with pytest.raises(MetrpoError, match=rf"can import, such as {better}\.py, got {name}\.py"):
        export(tmp_path, tmp_path / f"{name}.py")
    assert not (tmp_path / f"{name}.py").exists()
    assert export(tmp_path, tmp_path / f"{name}.npz").exists(), "only Python imports"


@pytest.mark.parametrize("name", ["numpy", "hashlib", "types"])
def test_the_name_of_a_module_that_it_or_a_neighbour_imports_is_refused(name, tmp_path):
    saved(tmp_path)
    expected = rf"expected no module of Python or NumPy, such as {name}_policy\.py, got {name}\.py"
    with pytest.raises(MetrpoError, match=expected):
        export(tmp_path, tmp_path / f"{name}.py")
    assert not (tmp_path / f"{name}.py").exists()


def test_somebody_elses_script_is_not_overwritten(tmp_path):
    saved(tmp_path)
    mine = tmp_path / "train.py"
    mine.write_text("print('mine')\n")
    with pytest.raises(MetrpoError, match="exists and is no exported policy"):
        export(tmp_path, mine)
    assert mine.read_text() == "print('mine')\n"
    assert export(tmp_path, tmp_path / "policy.py") == export(tmp_path), "an older export is"
