"""An exported Python file acts as the trained policy wherever it runs, and runs nothing but its own few lines."""

import ast
import dataclasses
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from exported import HOSTILE, A, S, python, rename, saved
from helpers import random_policy
from metrpo.errors import RunDirectoryError
from metrpo.run.loaded_policy import PolicyInfo
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.world.interface import Interface
from metrpo.world.registry import get_task, tasks


def test_python_takes_single_observations_and_names_its_shapes(tmp_path):
    saved(tmp_path)
    act = python(export(tmp_path)).act
    observations = np.random.default_rng(0).standard_normal((5, S))
    singles = [act(list(observation)) for observation in observations]
    assert {(one.dtype, one.shape) for one in singles} == {(np.dtype(np.float32), (A,))}
    np.testing.assert_allclose(singles, act(observations), rtol=0, atol=1e-6)
    for shape in [(), (S + 1,), (4, S + 1), (2, 3, S), (S, 1)]:
        with pytest.raises(ValueError, match=r"expected shape \[11\] or \[B, 11\], got " + re.escape(str(list(shape)))):
            act(np.zeros(shape))


def test_python_describes_itself(tmp_path):
    saved(tmp_path)
    path = export(tmp_path)
    assert path == tmp_path / "policy.py"
    module = python(path)
    assert (module.OBSERVATION_SIZE, module.ACTION_SIZE, module.TASK) == (S, A, "Swimmer")
    beside = json.loads((tmp_path / "policy.json").read_text())
    plain = {"hidden": [8], "env_kwargs": [], "imports": []}
    origin = {"metrpo": beside["metrpo"], "policy_sha256": beside["sha256"]}
    assert {**dataclasses.asdict(load_policy(tmp_path).info), **plain, **origin} == module.INFO
    for fact in ("from policy import act", "S = 11, A = 3", "environment: Swimmer.", *origin.values(), "iteration 3 "):
        assert fact in module.__doc__
    assert str(tmp_path) not in path.read_text()


def test_a_walkers_exported_policy_plays_the_plain_environment(tmp_path):
    """From what its file says alone: which number to put in front, and in which units to act."""
    task = get_task("HalfCheetah-v5")
    policy = random_policy(0, 18, 6)
    save_policy(tmp_path, policy, task.name, Learned(1, 1000, 1.0), task.interface)
    module = python(export(tmp_path))
    assert [size for size, _ in module.OBSERVATION] == [1, 17]
    assert "global x, added by metrpo" in module.__doc__
    plain, ours = gymnasium.make("HalfCheetah-v5"), task.make_env()
    shown, state = plain.reset(seed=3)[0], ours.reset(seed=3)[0]
    for _ in range(5):
        observation = np.concatenate([[plain.unwrapped.data.qpos[0]], shown])
        np.testing.assert_array_equal(observation, state)
        shown = plain.step(module.control(observation))[0]
        state = ours.step(load_policy(tmp_path)(state))[0]
    plain.close()
    ours.close()


def test_the_pendulums_torque_is_that_of_the_environment(tmp_path):
    task = get_task("Pendulum-v1")
    save_policy(tmp_path, random_policy(0, 3, 1), task.name, Learned(1, 1000, 1.0), task.interface)
    module = python(export(tmp_path))
    assert (module.ACTION_LOW, module.ACTION_HIGH) == ([-2.0], [2.0])
    assert module.OBSERVATION == [[3, "the observation of Pendulum-v1"]]
    beside = json.loads((tmp_path / "policy.json").read_text())
    assert (beside["action_low"], beside["action_high"]) == ([-2.0], [2.0])
    assert beside["observation"] == module.OBSERVATION
    state = np.array([0.5, -0.5, 1.0])
    np.testing.assert_allclose(module.control(state), 2 * module.act(state), rtol=1e-6)
    assert module.control(np.zeros((4, 3))).shape == (4, 1)


@pytest.mark.parametrize("text", HOSTILE)
def test_no_description_of_an_observation_becomes_code(text, tmp_path):
    saved(tmp_path, interface=Interface(((S, text),), (-1.0,) * A, (1.0,) * A))
    module = python(path := export(tmp_path))
    assert path.read_bytes().isascii()
    assert [[S, json.loads(json.dumps(text))]] == module.OBSERVATION
    assert f"[0:{S}]  {module.OBSERVATION[0][1]}\n" in module.__doc__


def test_python_is_short_plain_and_the_same_every_time(tmp_path):
    saved(tmp_path, (100, 50, 25))
    source = export(tmp_path).read_bytes()
    assert source.isascii()
    assert max(map(len, source.splitlines())) <= 120
    tree = ast.parse(source, feature_version=(3, 8))
    imports = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert imports == ["base64", "hashlib", "numpy"]
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert names.isdisjoint({"exec", "eval", "compile", "open", "__import__", "getattr", "globals"})
    assert export(tmp_path, tmp_path / "again.py").read_bytes() == source


def test_python_runs_without_jax_and_metrpo_in_another_directory(tmp_path):
    saved(tmp_path / "run", (32, 32))
    export(tmp_path / "run", tmp_path / "elsewhere" / "swim.py")
    code = (
        "import sys; sys.modules['jax'] = sys.modules['metrpo'] = None; sys.path.insert(0, '.')\n"
        "import swim; print(swim.act([0.5] * 11).tolist(), set(sys.modules) & {'jaxlib', 'scipy', 'onnx', 'pickle'})"
    )
    command = [sys.executable, "-I", "-B", "-W", "error"]
    run = {"cwd": tmp_path / "elsewhere", "capture_output": True, "text": True, "check": True}
    expected = load_policy(tmp_path / "run")(np.full(S, 0.5)).tolist()
    used = subprocess.run([*command, "-c", code], **run).stdout
    np.testing.assert_allclose(json.loads(used[: used.index("]") + 1]), expected, atol=1e-6)
    assert not re.search("jaxlib|scipy|onnx", used)
    checked = subprocess.run([*command, "swim.py"], **run).stdout
    assert checked == "ok: 'Swimmer', observations of 11 numbers, actions of 3\n"


def test_the_self_check_fails_when_the_action_differs(tmp_path):
    saved(tmp_path)
    source = export(tmp_path).read_text()
    (tmp_path / "other.py").write_text(source.replace("np.tanh(", "np.sin("))
    ran = subprocess.run([sys.executable, "-I", tmp_path / "other.py"], capture_output=True, text=True)
    assert ran.returncode == 1
    assert "expected the actions [[" in ran.stderr


@pytest.mark.parametrize("position", [0, 1000, -2])
@pytest.mark.parametrize("byte", ["flipped", "*", "\n", ""])
def test_damaged_weights_are_refused_at_import(position, byte, tmp_path):
    saved(tmp_path, (32, 32))
    source = export(tmp_path).read_text()
    start = source.index('_layers("""\n') + len('_layers("""\n')
    end = source.index('"""', start)
    at = (start if position >= 0 else end) + position
    flipped = chr(ord(source[at]) ^ 1) if source[at].isalpha() else "A"
    damaged = source[:at] + (flipped if byte == "flipped" else byte) + source[at + 1 :]
    (tmp_path / "damaged.py").write_text(damaged)
    with pytest.raises(ImportError, match=r"embedded weights are damaged: expected SHA-256 [0-9a-f]{64}, got"):
        python(tmp_path / "damaged.py")


def skeleton(source):
    """The program without what its literals say."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant):
            node.value = type(node.value).__name__
    return ast.dump(tree)


def listed(names):
    def decorate(test):
        for name in names:
            test = example(name)(test)
        return test

    return decorate


@pytest.fixture(scope="module")
def ordinary(tmp_path_factory):
    directory = tmp_path_factory.mktemp("ordinary")
    saved(directory)
    return export(directory)


@settings(max_examples=60, deadline=None)
@given(st.text(st.characters(exclude_categories=()) | st.sampled_from("'\"\\\n\r{}$#"), max_size=40))
@listed(HOSTILE)
def test_no_name_of_a_task_becomes_code(ordinary, name):
    assume(name not in tasks())  # whose actions it knows
    with tempfile.TemporaryDirectory() as place:
        rename(ordinary.with_name("policy.npz"), Path(place), task=name)
        path = export(Path(place))
        assert sorted(entry.name for entry in Path(place).iterdir()) == ["policy.npz", "policy.py"]
        assert path.read_bytes().isascii()
        assert skeleton(path.read_bytes()) == skeleton(ordinary.read_bytes())
        module = python(path)
        # JSON joins two halves of a character, which Python would keep apart.
        assert module.TASK == module.INFO["task"] == json.loads(json.dumps(name))
        assert f"environment: {module.TASK}.\n" in module.__doc__


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(PolicyInfo)])
def test_no_other_field_becomes_code_either(ordinary, name, tmp_path):
    rename(
        ordinary.with_name("policy.npz"),
        tmp_path,
        **{name: ['0"""\nimport os'] if name == "hidden" else '0"""\nimport os\nos.abort()\n"""'},
    )
    if name not in ("task", "iteration", "real_steps", "return_real"):
        with pytest.raises(RunDirectoryError, match=r"policy\.npz: "):
            export(tmp_path)
    else:
        module = python(export(tmp_path))
        assert "os.abort()" in module.INFO[name]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
def test_a_return_that_is_no_number_is_none(ordinary, value, tmp_path):
    rename(ordinary.with_name("policy.npz"), tmp_path, return_real=value)
    assert python(export(tmp_path)).INFO["return_real"] is None
