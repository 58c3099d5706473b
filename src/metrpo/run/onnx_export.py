"""A policy as an ONNX graph (extra `export`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from metrpo.errors import MetrpoError
from metrpo.run.loaded_policy import LoadedPolicy

_OPSET = 13
"""Of 2020: nearly every runtime in use reads it."""
_FLOAT, _DOUBLE = 1, 11
"""Types of numbers, as ONNX counts them (`onnx.TensorProto`)."""


class _Node(NamedTuple):
    """An operation of the graph."""

    operator: str
    inputs: list[str]
    output: str
    attributes: Mapping[str, Any] = MappingProxyType({})


def onnx_model(policy: LoadedPolicy, info: dict[str, Any]) -> bytes:
    """The file's content, with `info` as its metadata; raises `MetrpoError` when the onnx package is missing."""
    try:
        from onnx import helper, numpy_helper
    except ImportError as error:
        raise MetrpoError("no package onnx: pip install 'metrpo[export]', or choose a .py or .npz") from error

    def end(name: str, kind: int, size: int, text: str) -> Any:
        return helper.make_tensor_value_info(name, kind, ["batch", size], doc_string=text)

    entry, action_size = _entry(policy), policy.info.action_size
    kind = _FLOAT if policy.origin is None else _DOUBLE
    inputs = [end(entry, kind, policy.info.layout.state_size, _parts(policy))]
    if policy.info.max_change is not None:
        text = "The action of the step before; 0 in an episode's first."
        inputs.append(end("previous_action", _FLOAT, action_size, text))
    units = "In [-1, 1], without noise; the environment's range: the metadata's action_low and action_high."
    graph = helper.make_graph(
        [helper.make_node(node.operator, node.inputs, [node.output], **node.attributes) for node in _nodes(policy)],
        "policy",
        inputs,
        [end("action", _FLOAT, action_size, units)],
        [numpy_helper.from_array(array, name) for name, array in _constants(policy).items()],
        doc_string="A tanh network, clipped.",
    )
    said = {name: _utf8(value) for name, value in info.items()}
    text = f"A policy for {said['task']}: {entry} [batch, S] to action [batch, A], float32."
    if policy.origin is not None:
        text += f" The {entry} is float64: float32 could not hold it."
    producer = {"producer_name": "metrpo", "producer_version": said["metrpo"], "doc_string": text}
    model = helper.make_model_gen_version(graph, opset_imports=[helper.make_opsetid("", _OPSET)], **producer)
    helper.set_model_props(model, said)
    return bytes(model.SerializeToString())


def _entry(policy: LoadedPolicy) -> str:
    """The name of what the graph takes."""
    return "observation" if policy.info.history == 1 else "state"


def _parts(policy: LoadedPolicy) -> str:
    """What the graph takes, in words."""
    if policy.info.history == 1:
        return "Its parts in order: the metadata's observation."
    held = ", ".join(f"{text} ({size})" for size, text in policy.info.layout.parts)
    first = "At an episode's start older observations repeat the first, and actions are 0."
    return f"In order: {held}. Of an observation: the metadata's observation. {first}"


def _constants(policy: LoadedPolicy) -> dict[str, np.ndarray]:
    """The arrays that the operations name."""
    limit, change = policy.info.max_action, policy.info.max_change
    constants = {"low": np.asarray(-limit), "high": np.asarray(limit)}
    for i, (weights, bias) in enumerate(policy.layers):
        constants |= {f"w{i}": weights, f"b{i}": bias}
    if change is not None:
        constants["most"] = np.asarray(change)
    constants = {name: array.astype(np.float32) for name, array in constants.items()}
    return constants if policy.origin is None else constants | {"origin": policy.origin}


def _nodes(policy: LoadedPolicy) -> list[_Node]:
    """From the observation to the action: what it is counted from, the network, the limits."""
    last, value = len(policy.layers) - 1, _entry(policy)
    nodes = []
    if policy.origin is not None:
        nodes = [_Node("Sub", [value, "origin"], "exact"), _Node("Cast", ["exact"], "relative", {"to": _FLOAT})]
        value = "relative"
    for i in range(last + 1):
        nodes.append(_Node("Gemm", [value, f"w{i}", f"b{i}"], f"sum{i}"))
        if i < last:
            value = f"hidden{i}"
            nodes.append(_Node("Tanh", [f"sum{i}"], value))
    clipped = [f"sum{last}", "low", "high"]
    if policy.info.max_change is None:
        return [*nodes, _Node("Clip", clipped, "action")]
    return [
        *nodes,
        _Node("Clip", clipped, "wanted"),
        _Node("Sub", ["previous_action", "most"], "least"),
        _Node("Add", ["previous_action", "most"], "largest"),
        _Node("Max", ["wanted", "least"], "raised"),
        _Node("Min", ["raised", "largest"], "action"),
    ]


def _utf8(value: Any) -> str:
    # Strings as they are, all else as JSON; a lone surrogate, which JSON may hold, is no UTF-8.
    text = value if isinstance(value, str) else json.dumps(value)
    return text.encode("utf-8", "backslashreplace").decode()
