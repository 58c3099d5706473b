"""A policy for machines without metrpo: one Python file that needs NumPy alone, an ONNX graph, or a copy of its arrays.

Whatever a policy's info says is data: in the Python file it stands in literals only, escaped to ASCII.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import textwrap
from collections.abc import Callable
from dataclasses import asdict
from keyword import iskeyword
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.run.files import atomic_write, metrpo_version
from metrpo.run.policy_file import FILE, LoadedPolicy, load_policy
from metrpo.untrusted import opened

_Writer = Callable[[LoadedPolicy, Path], bytes | str]
_IMPORTED = ("base64", "hashlib", "numpy")
"""By the exported file: one of these names would be that file itself."""
_OPSET = 13
"""Of 2020: nearly every runtime in use reads it."""


def export(run_dir: Path, out: Path | None = None) -> Path:
    """Writes a run's policy to `out` (.py, .onnx or .npz; default: `policy.py` in the run directory) and returns it.

    All three map observations [B, S] to actions [B, A] in [-1, 1], as `load_policy` does; the .py also [S] to [A].

    Raises `MetrpoError` for another ending, a name that Python cannot import, a .py file in the way that is not ours,
    or when the onnx package is missing, `RunDirectoryError` when there is no policy, it is damaged, or `out` cannot be
    written.
    """
    source = run_dir if run_dir.suffix == ".npz" else run_dir / FILE
    out = source.with_name("policy.py") if out is None else out
    if out.suffix not in _WRITERS:
        raise MetrpoError(f"{out}: expected a name that ends in {', '.join(_WRITERS)}; got {out.suffix or 'no ending'}")
    if out.suffix == ".py":
        _require_importable(out)
    policy = load_policy(run_dir)
    if out.suffix == ".py" and out.is_file() and not _is_ours(out):
        raise MetrpoError(f"{out} exists and is no exported policy: choose another name, or remove it first")
    atomic_write(out, _WRITERS[out.suffix](policy, source))
    return out


def _require_importable(out: Path) -> None:
    """Raises `MetrpoError` for a file that no `import` can name, or that stands in the way of what it imports."""
    name = out.stem
    if name.isidentifier() and not iskeyword(name) and name not in _IMPORTED:
        return
    better = re.sub(r"\W+", "_", name).strip("_").lstrip("0123456789_")
    better = better if better.isidentifier() and better != name else f"{better or 'my'}_policy"
    raise MetrpoError(f"{out}: expected a name that Python can import, such as {better}.py, got {out.name}")


def _is_ours(path: Path) -> bool:
    start = _SOURCE[:40].encode()
    with opened(path, RunDirectoryError) as file:
        return file.read(len(start)) == start


def _info(policy: LoadedPolicy, source: Path) -> dict[str, Any]:
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    info = {**asdict(policy.info), "metrpo": metrpo_version(), "policy_sha256": digest}
    # NaN and infinity are JSON to Python, but neither Python literals nor JSON to anybody else.
    return dict(json.loads(json.dumps(info), parse_constant=lambda _: None))


def _python(policy: LoadedPolicy, source: Path) -> str:
    sizes = [*(len(weights) for weights, _ in policy.layers), len(policy.layers[-1][1])]
    weights = b"".join(array.astype("<f4").tobytes() for layer in policy.layers for array in layer)
    example = np.random.default_rng(0).standard_normal(sizes[0]).round(3)
    info = _info(policy, source)
    fields = {
        **{name: _inside_docstring(info[name]) for name in ("task", "metrpo", "iteration", "real_steps")},
        "policy_sha256": info["policy_sha256"],
        "observation_size": sizes[0],
        "action_size": sizes[-1],
        "sizes": sizes,
        "task_literal": ascii(info["task"]),
        "info_literal": "{\n" + "".join(f"    {name!a}: {value!a},\n" for name, value in info.items()) + "}",
        "sha256": hashlib.sha256(weights).hexdigest(),
        "weights": "\n".join(textwrap.wrap(base64.b64encode(weights).decode(), 100)),
        "example": _numbers(example),
        "action": _numbers(policy(example)),
    }
    return Template(_SOURCE).substitute(fields)


def _inside_docstring(value: Any) -> str:
    # ascii() leaves whole escapes and printable characters, of which only double quotes could end the docstring.
    return ascii(str(value))[1:-1].replace('"', '\\"')


def _numbers(array: np.ndarray) -> str:
    return textwrap.fill(str([float(f"{x:.9g}") for x in array.tolist()]), 100, break_on_hyphens=False)


def _onnx(policy: LoadedPolicy, source: Path) -> bytes:
    try:
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise MetrpoError("no package onnx: pip install 'metrpo[export]', or choose a .py or .npz") from error
    constants = {"low": np.asarray(-1.0), "high": np.asarray(1.0)}
    nodes, value = [], "observation"
    for i, (weights, bias) in enumerate(policy.layers):
        constants |= {f"w{i}": weights, f"b{i}": bias}
        nodes.append(helper.make_node("Gemm", [value, f"w{i}", f"b{i}"], [f"sum{i}"]))
        nodes.append(helper.make_node("Tanh", [f"sum{i}"], [value := f"hidden{i}"]))
    nodes[-1] = helper.make_node("Clip", [f"sum{len(policy.layers) - 1}", "low", "high"], ["action"])

    def end(name: str, size: int, text: str) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size], doc_string=text)

    observation = end("observation", len(policy.layers[0][0]), "What the task's environment shows.")
    action = end("action", len(policy.layers[-1][1]), "What the task's environment takes, in [-1, 1]; without noise.")
    tensors = [numpy_helper.from_array(array.astype(np.float32), name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "policy", [observation], [action], tensors, doc_string="A tanh network, clipped.")
    info = {name: _utf8(value) for name, value in _info(policy, source).items()}
    text = f"A policy for {info['task']}: observation [batch, S] to action [batch, A], float32."
    origin = {"producer_name": "metrpo", "producer_version": info["metrpo"], "doc_string": text}
    model = helper.make_model_gen_version(graph, opset_imports=[helper.make_opsetid("", _OPSET)], **origin)
    helper.set_model_props(model, info)
    return bytes(model.SerializeToString())


def _utf8(value: Any) -> str:
    # Strings as they are, all else as JSON; a lone surrogate, which JSON may hold, is no UTF-8.
    text = value if isinstance(value, str) else json.dumps(value)
    return text.encode("utf-8", "backslashreplace").decode()


_WRITERS: dict[str, _Writer] = {".py": _python, ".onnx": _onnx, ".npz": lambda _, source: source.read_bytes()}

_SOURCE = '''\
"""A trained control policy in one file: observations in, actions out. It needs NumPy and nothing else.

    from policy import act  # or whatever this file is called
    action = act(observation)  # [S] -> [A] or [B, S] -> [B, A], float32, each action in [-1, 1]

S = $observation_size, A = $action_size; the observations and actions are those of the task's environment: $task.
Written by metrpo $metrpo from a policy.npz with SHA-256
$policy_sha256,
trained for $iteration iterations on $real_steps real steps. Run this file to check it.
"""

import base64
import hashlib

import numpy as np

OBSERVATION_SIZE = $observation_size
ACTION_SIZE = $action_size
TASK = $task_literal
INFO = $info_literal


def act(observation):
    """The action, in [-1, 1], float32: [S] -> [A] or [B, S] -> [B, A]; ValueError for other shapes, NaN or infinity."""
    with np.errstate(over="ignore"):
        hidden = np.asarray(observation, dtype=np.float32)
    if hidden.ndim not in (1, 2) or hidden.shape[-1] != OBSERVATION_SIZE:
        size = OBSERVATION_SIZE
        raise ValueError(f"observation: expected shape [{size}] or [B, {size}], got {list(hidden.shape)}")
    if not np.isfinite(hidden).all():
        at = np.argwhere(~np.isfinite(hidden))[0]
        raise ValueError(f"observation: expected finite numbers, got {hidden[tuple(at)]} at {at.tolist()}")
    for weights, bias in _LAYERS[:-1]:
        hidden = np.tanh(hidden @ weights + bias)
    weights, bias = _LAYERS[-1]
    return np.clip(hidden @ weights + bias, -1.0, 1.0)


def _layers(text):
    """float32 weights [in, out] and bias [out] of every layer; they lie one after the other in base64."""
    try:
        content = base64.b64decode(text)
    except ValueError:  # not even base64
        content = b""
    found = hashlib.sha256(content).hexdigest()
    if found != _SHA256:
        raise ImportError(f"the embedded weights are damaged: expected SHA-256 {_SHA256}, got {found}")
    rest = np.frombuffer(content, dtype="<f4").astype(np.float32)
    layers = []
    for inputs, outputs in zip(_SIZES[:-1], _SIZES[1:]):
        weights, bias, rest = np.split(rest, [inputs * outputs, (inputs + 1) * outputs])
        layers.append((weights.reshape(inputs, outputs), bias))
    return layers


_SIZES = $sizes
_SHA256 = "$sha256"
_LAYERS = _layers("""
$weights
""")
_EXAMPLE = $example
_EXAMPLE_ACTION = $action

if __name__ == "__main__":
    _found = act(_EXAMPLE)
    if not np.allclose(_found, _EXAMPLE_ACTION, rtol=0, atol=1e-4):
        raise SystemExit(f"{TASK!a}: expected the action {_EXAMPLE_ACTION}, got {_found.tolist()}")
    print(f"ok: {TASK!a}, observations of {OBSERVATION_SIZE} numbers, actions of {ACTION_SIZE}")
'''
