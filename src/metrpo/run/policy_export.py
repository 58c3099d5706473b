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
from dataclasses import asdict, replace
from keyword import iskeyword
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.history import History
from metrpo.limits import Limits
from metrpo.policy_zoo import is_name, located
from metrpo.run.files import atomic_write, metrpo_version
from metrpo.run.policy_file import FILE, LoadedPolicy, load_policy, with_interface
from metrpo.safe_load import opened

_Writer = Callable[[LoadedPolicy, Path], bytes | str]
_IMPORTED = ("base64", "hashlib", "numpy")
"""By the exported file: one of these names would be that file itself."""
_OPSET = 13
"""Of 2020: nearly every runtime in use reads it."""


def export(run_dir: Path, out: Path | None = None) -> Path:
    """Writes a run's policy to `out` (.py, .onnx or .npz; default: `policy.py` in the run directory) and returns it.

    All three map observations [B, O] to actions [B, A] in [-1, 1], as `load_policy` does; the .py also [O] to [A], and
    its `control` to the environment's own range. They say how observations are laid out, and that range. A history the
    .py and the .npz keep by themselves; an .onnx, which cannot, takes whole states [B, S] and says their layout.

    Raises `MetrpoError` for another ending, a name that Python cannot import, a .py file in the way that is not ours,
    or when the onnx package is missing, `RunDirectoryError` when there is no policy, it is damaged, or `out` cannot be
    written.
    """
    if out is None and is_name(run_dir):
        raise MetrpoError(f"{run_dir}: expected --out, because this is no run directory; add --out policy.py")
    run_dir = located(run_dir)
    source = run_dir if run_dir.suffix == ".npz" else run_dir / FILE
    out = source.with_name("policy.py") if out is None else out
    if out.suffix not in _WRITERS:
        raise MetrpoError(f"{out}: expected a name that ends in {', '.join(_WRITERS)}; got {out.suffix or 'no ending'}")
    if out.suffix == ".py":
        _require_importable(out)
    policy = _completed(load_policy(run_dir))
    if out.suffix == ".py" and out.is_file() and not _is_ours(out):
        raise MetrpoError(f"{out} exists and is no exported policy; choose another name, or remove it first")
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


def _completed(policy: LoadedPolicy) -> LoadedPolicy:
    """A policy from before its file said what its environment shows and takes, with that of a task of ours."""
    if policy.info.observation is not None:
        return policy
    from metrpo.world.registry import get_task, tasks
    from metrpo.world.tasks.gymnasium_formulas import KNOWN

    name = policy.info.task
    if name not in KNOWN and name not in tasks():  # to ask a file of somebody's would run it
        return policy
    return replace(policy, info=with_interface(policy.info, get_task(name).interface))


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
    info, origin, layout = _info(policy, source), policy.origin, policy.info.layout
    examples = np.random.default_rng(0).standard_normal((layout.length, layout.observation_size)).round(3)
    examples = examples if origin is None else examples + layout.newest(origin)
    policy.reset()
    expected = [policy(example) for example in examples]
    policy.reset()
    fields = {
        "dtype": "float32" if origin is None else "float64",
        "relative": "" if origin is None else _RELATIVE,
        "origin": "" if origin is None else f"_ORIGIN = np.array({origin.tolist()})\n",
        **{name: _inside_docstring(info[name]) for name in ("task", "metrpo", "iteration", "real_steps")},
        "policy_sha256": info["policy_sha256"],
        "observation_size": layout.observation_size,
        "history": "" if layout.length == 1 else _history(layout),
        "remember": "" if layout.length == 1 else _REMEMBER,
        "begin": "" if layout.length == 1 else _BEGIN,
        "carried": "" if layout.length == 1 else f"_CARRIED = {list(layout.carried)}\n",
        "action_size": sizes[-1],
        "sizes": sizes,
        "task_literal": ascii(info["task"]),
        "info_literal": "{\n" + "".join(f"    {name!a}: {_literal(value)},\n" for name, value in info.items()) + "}",
        "layout": _layout(info["observation"]),
        "range": _range(info),
        "limits": _limits(info),
        "sha256": hashlib.sha256(weights).hexdigest(),
        "weights": "\n".join(textwrap.wrap(base64.b64encode(weights).decode(), 100)),
        "examples": _rows(examples, 17),
        "actions": _rows(expected),
    }
    return Template(_SOURCE).substitute(fields)


def _literal(value: Any) -> str:
    """A value as Python writes it, a list over several lines."""
    if not isinstance(value, list) or not value:
        return ascii(value)
    if isinstance(value[0], list):
        return "[\n" + "".join(f"        {part!a},\n" for part in value) + "    ]"
    return textwrap.fill(str(value), 100, subsequent_indent=" " * 8, break_on_hyphens=False)


def _layout(parts: list[tuple[int, str]] | None) -> str:
    """The parts of an observation, a line each, for a docstring."""
    if parts is None:
        return "    not known: the policy says nothing of them"
    lines, start = [], 0
    for size, text in parts:
        lines.append(f"    [{start}:{start + size}]  {_inside_docstring(text)}")
        start += size
    return "\n".join(lines)


def _range(info: dict[str, Any]) -> str:
    if info["action_low"] is None or info["action_high"] is None:
        return "    not known: scale the actions yourself"
    low, high = _literal(info["action_low"]), _literal(info["action_high"])
    return f"    ACTION_LOW   {low}\n    ACTION_HIGH  {high}"


def _limits(info: dict[str, Any]) -> str:
    largest = f"actions within plus and minus {info['max_action']:g}"
    change = info["max_change"]
    return f"{largest}{'' if change is None else f', that change by at most {change:g} a step (see reset)'}."


def _inside_docstring(value: Any) -> str:
    # ascii() leaves whole escapes and printable characters, of which only double quotes could end the docstring.
    return ascii(str(value))[1:-1].replace('"', '\\"')


def _history(layout: History) -> str:
    """What a state holds, for a docstring."""
    return f"""\

It sees the last {layout.length} observations and the {layout.length - 1} actions between them, which it remembers:
call it once a step, and reset() before each episode. Where another action than its own is executed, call
limited(action) with that.
"""


def _rows(rows: Any, digits: int = 9) -> str:
    return "[\n" + "".join(f"    {_numbers(row, digits)},\n" for row in rows) + "]"


def _numbers(array: np.ndarray, digits: int = 9) -> str:
    return textwrap.fill(str([float(f"{x:.{digits}g}") for x in array.tolist()]), 100, break_on_hyphens=False)


def _onnx(policy: LoadedPolicy, source: Path) -> bytes:
    try:
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise MetrpoError("no package onnx: pip install 'metrpo[export]', or choose a .py or .npz") from error
    limits = Limits.of(policy.info)
    constants = {"low": np.asarray(-limits.max_action), "high": np.asarray(limits.max_action)}
    entry = "observation" if policy.info.history == 1 else "state"
    nodes, value, kind = [], entry, TensorProto.FLOAT
    if policy.origin is not None:
        kind, value = TensorProto.DOUBLE, "relative"
        nodes += [
            helper.make_node("Sub", [entry, "origin"], ["exact"]),
            helper.make_node("Cast", ["exact"], [value], to=TensorProto.FLOAT),
        ]
    for i, (weights, bias) in enumerate(policy.layers):
        constants |= {f"w{i}": weights, f"b{i}": bias}
        nodes.append(helper.make_node("Gemm", [value, f"w{i}", f"b{i}"], [f"sum{i}"]))
        nodes.append(helper.make_node("Tanh", [f"sum{i}"], [value := f"hidden{i}"]))
    nodes[-1] = helper.make_node("Clip", [f"sum{len(policy.layers) - 1}", "low", "high"], ["action"])
    if limits.max_change is not None:
        constants["most"] = np.asarray(limits.max_change)
        nodes[-1].output[0] = "wanted"
        nodes += [
            helper.make_node("Sub", ["previous_action", "most"], ["least"]),
            helper.make_node("Add", ["previous_action", "most"], ["largest"]),
            helper.make_node("Max", ["wanted", "least"], ["raised"]),
            helper.make_node("Min", ["raised", "largest"], ["action"]),
        ]

    def end(name: str, kind: int, size: int, text: str) -> Any:
        return helper.make_tensor_value_info(name, kind, ["batch", size], doc_string=text)

    parts = "Its parts in order: the metadata's observation."
    if entry == "state":
        held = ", ".join(f"{text} ({size})" for size, text in policy.info.layout.parts)
        first = "At an episode's start older observations repeat the first, and actions are 0."
        parts = f"In order: {held}. Of an observation: the metadata's observation. {first}"
    observation = end(entry, kind, len(policy.layers[0][0]), parts)
    units = "In [-1, 1], without noise; the environment's range: the metadata's action_low and action_high."
    action = end("action", TensorProto.FLOAT, len(policy.layers[-1][1]), units)
    tensors = [numpy_helper.from_array(array.astype(np.float32), name) for name, array in constants.items()]
    if policy.origin is not None:
        tensors.append(numpy_helper.from_array(policy.origin, "origin"))
    inputs = [observation]
    if limits.max_change is not None:
        text = "The action of the step before; 0 in an episode's first."
        inputs.append(end("previous_action", TensorProto.FLOAT, len(policy.layers[-1][1]), text))
    graph = helper.make_graph(nodes, "policy", inputs, [action], tensors, doc_string="A tanh network, clipped.")
    info = {name: _utf8(value) for name, value in _info(policy, source).items()}
    text = f"A policy for {info['task']}: {entry} [batch, S] to action [batch, A], float32."
    if policy.origin is not None:
        text += f" The {entry} is float64: float32 could not hold it."
    origin = {"producer_name": "metrpo", "producer_version": info["metrpo"], "doc_string": text}
    model = helper.make_model_gen_version(graph, opset_imports=[helper.make_opsetid("", _OPSET)], **origin)
    helper.set_model_props(model, info)
    return bytes(model.SerializeToString())


def _utf8(value: Any) -> str:
    # Strings as they are, all else as JSON; a lone surrogate, which JSON may hold, is no UTF-8.
    text = value if isinstance(value, str) else json.dumps(value)
    return text.encode("utf-8", "backslashreplace").decode()


_WRITERS: dict[str, _Writer] = {".py": _python, ".onnx": _onnx, ".npz": lambda _, source: source.read_bytes()}

_RELATIVE = """\
    with np.errstate(over="ignore"):
        hidden = (hidden - _ORIGIN).astype(np.float32)
"""
"""In the exported file, where observations have an origin."""
_BEGIN = """\
    if "state" not in _last:
        none = np.zeros((*hidden.shape[:-1], (HISTORY - 1) * ACTION_SIZE), hidden.dtype)
        hidden = np.concatenate([hidden] * HISTORY + [none], axis=-1)
    else:
        if _last["state"].shape[:-1] != hidden.shape[:-1] or _last["action"].shape[:-1] != hidden.shape[:-1]:
            raise ValueError("observation: expected as many as in the step before: call reset() first")
        before = np.concatenate([_last["state"], _last["action"].astype(hidden.dtype)], axis=-1)
        hidden = np.concatenate([hidden, before[..., _CARRIED]], axis=-1)
    state = hidden
"""
_REMEMBER = """\
    _last["state"] = state
"""
"""In the exported file, where its policy has a history: the state that is seen, and what of it is kept."""

_SOURCE = '''\
"""A trained control policy in one file: observations in, actions out. It needs NumPy and nothing else.

    from policy import act, control, reset  # or whatever this file is called
    action = act(observation)  # [S] -> [A] or [B, S] -> [B, A], float32, each action in [-1, 1]
    action = control(observation)  # the same in the environment's own units, within its bounds

S = $observation_size, A = $action_size; made in the task's environment: $task.
Its observations, which may hold more than the plain environment shows:
$layout
Its own range of actions, for which -1 and 1 stand:
$range
Its limits: $limits
$history
Written by metrpo $metrpo from a policy.npz with SHA-256
$policy_sha256,
as iteration $iteration left it, after $real_steps real steps. Run this file to check it.
"""

import base64
import hashlib

import numpy as np

OBSERVATION_SIZE = $observation_size
ACTION_SIZE = $action_size
TASK = $task_literal
INFO = $info_literal
OBSERVATION = INFO["observation"]
ACTION_LOW = INFO["action_low"]
ACTION_HIGH = INFO["action_high"]
MAX_ACTION = INFO["max_action"]
MAX_CHANGE = INFO["max_change"]
HISTORY = INFO["history"]
_last = {}


def reset():
    """Begins an episode: MAX_CHANGE counts from 0, the middle of the range of actions; no history is left."""
    _last.clear()


def act(observation):
    """The action, in [-1, 1], float32: [S] -> [A] or [B, S] -> [B, A]; ValueError for other shapes, NaN or infinity.

    Within the limits: call it once a step, and reset() before each episode, where there is a MAX_CHANGE or a HISTORY.
    """
    with np.errstate(over="ignore"):
        hidden = np.asarray(observation, dtype=np.$dtype)
    if hidden.ndim not in (1, 2) or hidden.shape[-1] != OBSERVATION_SIZE:
        size = OBSERVATION_SIZE
        raise ValueError(f"observation: expected shape [{size}] or [B, {size}], got {list(hidden.shape)}")
$begin$relative    if not np.isfinite(hidden).all():
        at = np.argwhere(~np.isfinite(hidden))[0]
        raise ValueError(f"observation: expected finite numbers, got {hidden[tuple(at)]} at {at.tolist()}")
    for weights, bias in _LAYERS[:-1]:
        hidden = np.tanh(hidden @ weights + bias)
    weights, bias = _LAYERS[-1]
$remember    return limited(np.clip(hidden @ weights + bias, -1.0, 1.0))


def limited(action):
    """An action, such as one of your own, within MAX_ACTION and MAX_CHANGE; it is the last one from then on."""
    action = np.clip(np.asarray(action, dtype=np.float32), -MAX_ACTION, MAX_ACTION)
    if MAX_CHANGE is None:
        if HISTORY > 1:
            _last["action"] = action
        return action
    before = _last.get("action", np.zeros_like(action))
    if before.shape != action.shape:
        raise ValueError(f"action: expected shape {list(before.shape)} as in the step before: call reset() first")
    _last["action"] = np.clip(action, before - MAX_CHANGE, before + MAX_CHANGE).astype(np.float32)
    return _last["action"]


def to_env(action):
    """An action of `act` in the environment's own units: -1 is ACTION_LOW, 1 is ACTION_HIGH, and none is beyond."""
    if ACTION_LOW is None or ACTION_HIGH is None:
        raise ValueError("this policy does not say its environment's range of actions: scale them yourself")
    low, high = np.array(ACTION_LOW, dtype=np.float64), np.array(ACTION_HIGH, dtype=np.float64)
    part = 0.5 * (np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) + 1.0)
    if part.ndim not in (1, 2) or part.shape[-1] != ACTION_SIZE:
        raise ValueError(f"action: expected shape [{ACTION_SIZE}] or [B, {ACTION_SIZE}], got {list(part.shape)}")
    scaled = np.clip((1.0 - part) * low + part * high, low, high)
    exact = np.array_equal(low, np.float32(low)) and np.array_equal(high, np.float32(high))
    return scaled.astype(np.float32 if exact else np.float64)


def control(observation):
    """The action in the environment's own units: `to_env(act(observation))`."""
    return to_env(act(observation))


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


${origin}${carried}_SIZES = $sizes
_SHA256 = "$sha256"
_LAYERS = _layers("""
$weights
""")
_EXAMPLES = $examples
_EXAMPLE_ACTIONS = $actions

if __name__ == "__main__":
    for _attempt in ("", " after a reset()"):
        reset()
        _found = np.array([act(_observation) for _observation in _EXAMPLES])
        if not np.allclose(_found, _EXAMPLE_ACTIONS, rtol=0, atol=1e-4):
            raise SystemExit(f"{TASK!a}: expected the actions {_EXAMPLE_ACTIONS}, got {_found.tolist()}{_attempt}")
    print(f"ok: {TASK!a}, observations of {OBSERVATION_SIZE} numbers, actions of {ACTION_SIZE}")
'''
