"""The text of an exported Python file, with a $name in each place that differs between policies."""

from __future__ import annotations

SOURCE = '''\
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
    hidden = _as_batch("observation", observation, OBSERVATION_SIZE, np.$dtype)
$begin$relative    _require_finite("observation", hidden)
    for weights, bias in _LAYERS[:-1]:
        hidden = np.tanh(hidden @ weights + bias)
    weights, bias = _LAYERS[-1]
$remember    return limited(np.clip(hidden @ weights + bias, -1.0, 1.0))


def limited(action):
    """An action, such as one of your own, within MAX_ACTION and MAX_CHANGE; it is the last one from then on.

    ValueError for other shapes, NaN or infinity.
    """
    action = _finite_actions(action, np.float32)
    if MAX_CHANGE is not None:
        before = _last.get("action", np.zeros_like(action))
        if before.shape != action.shape:
            raise ValueError(f"action: expected shape {list(before.shape)} as in the step before: call reset() first")
        action = np.clip(action, before - MAX_CHANGE, before + MAX_CHANGE)
    action = np.clip(action, -MAX_ACTION, MAX_ACTION).astype(np.float32)
    if MAX_CHANGE is not None or HISTORY > 1:
        _last["action"] = action.copy()  # the caller may write into theirs
    return action


def to_env(action):
    """An action of `act` in the environment's own units: -1 is ACTION_LOW, 1 is ACTION_HIGH, and none is beyond."""
    if ACTION_LOW is None or ACTION_HIGH is None:
        raise ValueError("this policy does not say its environment's range of actions: scale them yourself")
    low, high = np.array(ACTION_LOW, dtype=np.float64), np.array(ACTION_HIGH, dtype=np.float64)
    part = 0.5 * (np.clip(_finite_actions(action, np.float64), -1.0, 1.0) + 1.0)
    scaled = np.clip((1.0 - part) * low + part * high, low, high)
    exact = np.array_equal(low, np.float32(low)) and np.array_equal(high, np.float32(high))
    return scaled.astype(np.float32 if exact else np.float64)


def control(observation):
    """The action in the environment's own units: `to_env(act(observation))`."""
    return to_env(act(observation))


def _finite_actions(action, kind):
    batch = _as_batch("action", action, ACTION_SIZE, kind)
    _require_finite("action", batch)
    return batch


def _as_batch(name, value, size, kind):
    with np.errstate(over="ignore"):
        batch = np.asarray(value, dtype=kind)
    if batch.ndim not in (1, 2) or batch.shape[-1] != size:
        parts = "; this file begins with its parts" if name == "observation" else ""
        raise ValueError(f"{name}: expected shape [{size}] or [B, {size}], got {list(batch.shape)}{parts}")
    return batch


def _require_finite(name, batch):
    if not np.isfinite(batch).all():
        at = np.argwhere(~np.isfinite(batch))[0]
        raise ValueError(f"{name}: expected finite numbers, got {batch[tuple(at)]} at {at.tolist()}")


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
RELATIVE = """\
    with np.errstate(over="ignore"):
        hidden = (hidden - _ORIGIN).astype(np.float32)
"""
"""In the exported file, where observations have an origin."""
BEGIN = """\
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
REMEMBER = """\
    _last["state"] = state
"""
"""In the exported file, where its policy has a history: the state that is seen, and what of it is kept."""
