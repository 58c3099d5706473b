"""An exported policy acts as the trained one, wherever it runs, and runs nothing but its own few lines."""

import ast
import dataclasses
import json
import re
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from helpers import random_policy
from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.policy import gaussian
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, PolicyInfo, load_policy, save_policy
from metrpo.world.interface import Interface
from metrpo.world.registry import get_task

S, A = 11, 3
HOSTILE = [
    '"""\nimport os\nos.abort()\n"""',
    "'''\nraise SystemExit(3)\n'''",
    '\\"""\nimport os\n',
    "\\",
    '"',
    "$weights ${sha256} $$ {0} {TASK} %s",
    "../../etc/passwd",
    "dm_control/walker-walk:v0",
    "\r\n\x00\x1b[2J\u2028 # coding: rot13",
    "\ud800 \udcff ü 机器人 🦿",
    "",
]


def saved(directory, hidden=(8,), scale=1.0, task="Swimmer", interface=None):
    policy = gaussian.init(jax.random.key(1), S, A, hidden, 1.0)
    policy = policy._replace(layers=tuple((scale * w, b + 0.1) for w, b in policy.layers))
    save_policy(directory, policy, task, Learned(3, 900, 12.5), interface)
    return policy


def python(path):
    return SimpleNamespace(**runpy.run_path(str(path), run_name="policy"))


def onnx(path):
    runtime = pytest.importorskip("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return lambda observations: session.run(["action"], {"observation": observations.astype(np.float32)})[0]


def needs_onnx(ending):
    if ending == ".onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")


READERS = {".py": lambda path: python(path).act, ".onnx": onnx, ".npz": load_policy}


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


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
def test_an_observation_that_is_not_finite_gets_no_action(tmp_path, value):
    saved(tmp_path)
    for act in (python(export(tmp_path)).act, load_policy(tmp_path)):
        for shape, at in (((S,), [3]), ((4, S), [2, 3])):
            observation = np.zeros(shape)
            observation[tuple(at)] = value
            with pytest.raises(ValueError, match="expected finite numbers, got .* at " + re.escape(str(at))):
                act(observation)


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


def test_onnx_says_the_layout_and_the_range_too(tmp_path):
    onnx_package = pytest.importorskip("onnx")
    saved(tmp_path, interface=Interface(((1, "height"), (S - 1, "the rest")), (-2.0,) * A, (3.0,) * A))
    model = onnx_package.load(str(export(tmp_path, tmp_path / "p.onnx")))
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(said["observation"]) == [[1, "height"], [S - 1, "the rest"]]
    assert (json.loads(said["action_low"]), json.loads(said["action_high"])) == ([-2.0] * A, [3.0] * A)


@pytest.mark.parametrize("text", HOSTILE)
def test_no_description_of_an_observation_becomes_code(text, tmp_path):
    saved(tmp_path, interface=Interface(((S, text),), (-1.0,) * A, (1.0,) * A))
    module = python(path := export(tmp_path))
    assert path.read_bytes().isascii()
    assert [[S, json.loads(json.dumps(text))]] == module.OBSERVATION
    assert f"[0:{S}]  {module.OBSERVATION[0][1]}\n" in module.__doc__


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


def rename(source, directory, **fields):
    arrays, meta = read_arrays(source)
    write_arrays(directory / "policy.npz", arrays, {"policy": meta["policy"] | fields})


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


def test_onnx_is_valid_and_describes_itself(tmp_path):
    package = pytest.importorskip("onnx")
    saved(tmp_path, (32, 32))
    model = package.load(export(tmp_path, tmp_path / "policy.onnx"))
    package.checker.check_model(model, full_check=True)
    ends = [(*model.graph.input, "observation", S), (*model.graph.output, "action", A)]
    for end, name, size in ends:
        batch, numbers = end.type.tensor_type.shape.dim
        assert (end.name, batch.dim_param, numbers.dim_value) == (name, "batch", size)
        assert end.type.tensor_type.elem_type == package.TensorProto.FLOAT
        assert end.doc_string
    beside = json.loads((tmp_path / "policy.json").read_text())
    facts = {entry.key: entry.value for entry in model.metadata_props}
    expected = {"task": "Swimmer", "observation_size": "11", "action_size": "3", "hidden": "[32, 32]"}
    assert expected.items() | {("metrpo", beside["metrpo"]), ("policy_sha256", beside["sha256"])} <= facts.items()
    assert (model.producer_name, model.producer_version) == ("metrpo", beside["metrpo"])
    assert "Swimmer" in model.doc_string
    assert model.opset_import[0].version == 13


@pytest.mark.parametrize("name", HOSTILE)
def test_onnx_holds_any_name(name, tmp_path):
    package = pytest.importorskip("onnx")
    saved(tmp_path, task=name)
    path = export(tmp_path, tmp_path / "policy.onnx")
    package.checker.check_model(package.load(path))
    onnx(path)(np.zeros((1, S)))


def test_onnx_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    saved(tmp_path)
    with pytest.raises(MetrpoError, match=r"no package onnx: pip install 'metrpo\[export\]'"):
        export(tmp_path, tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()


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
        ("numpy", "numpy_policy"),
        ("007", "my_policy"),
    ],
)
def test_an_unimportable_name_is_refused_with_a_better_one(name, better, tmp_path):
    saved(tmp_path)
    with pytest.raises(MetrpoError, match=rf"can import, such as {better}\.py, got {name}\.py"):
        export(tmp_path, tmp_path / f"{name}.py")
    assert not (tmp_path / f"{name}.py").exists()
    assert export(tmp_path, tmp_path / f"{name}.npz").exists(), "only Python imports"


def test_somebody_elses_script_is_not_overwritten(tmp_path):
    saved(tmp_path)
    mine = tmp_path / "train.py"
    mine.write_text("print('mine')\n")
    with pytest.raises(MetrpoError, match="exists and is no exported policy"):
        export(tmp_path, mine)
    assert mine.read_text() == "print('mine')\n"
    assert export(tmp_path, tmp_path / "policy.py") == export(tmp_path), "an older export is"
