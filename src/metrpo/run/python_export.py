"""A policy as one Python file that needs NumPy alone.

Whatever a policy's info says is data: in the file it stands in literals only, escaped to ASCII.
"""

from __future__ import annotations

import base64
import hashlib
import textwrap
from string import Template
from typing import Any

import numpy as np

from metrpo.history import History
from metrpo.run.loaded_policy import LoadedPolicy
from metrpo.run.python_template import BEGIN, RELATIVE, REMEMBER, SOURCE


def python_source(policy: LoadedPolicy, info: dict[str, Any]) -> str:
    """The text of the file; `info` is what it says of the policy."""
    sizes = [*(len(weights) for weights, _ in policy.layers), len(policy.layers[-1][1])]
    weights = b"".join(array.astype("<f4").tobytes() for layer in policy.layers for array in layer)
    origin, layout = policy.origin, policy.info.layout
    examples = np.random.default_rng(0).standard_normal((layout.length, layout.observation_size)).round(3)
    examples = examples if origin is None else examples + layout.newest(origin)
    policy.reset()
    expected = [policy(example) for example in examples]
    policy.reset()
    fields = {
        "dtype": "float32" if origin is None else "float64",
        "relative": "" if origin is None else RELATIVE,
        "origin": "" if origin is None else f"_ORIGIN = np.array({origin.tolist()})\n",
        **{name: _inside_docstring(info[name]) for name in ("task", "metrpo", "iteration", "real_steps")},
        "policy_sha256": info["policy_sha256"],
        "observation_size": layout.observation_size,
        "history": "" if layout.length == 1 else _history(layout),
        "remember": "" if layout.length == 1 else REMEMBER,
        "begin": "" if layout.length == 1 else BEGIN,
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
    return Template(SOURCE).substitute(fields)


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
