"""A saved policy, and exported ones as a program would use them."""

import importlib
import runpy
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from metrpo.policy import gaussian
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.policy_file import Learned, load_policy, save_policy

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
"""Texts that no file may take for code."""


def module_of(path):
    """An exported .py, imported by its name from its folder."""
    sys.path.insert(0, str(path.parent))
    try:
        return importlib.import_module(path.stem)
    finally:
        sys.path.remove(str(path.parent))
        del sys.modules[path.stem]


def act_and_reset(path):
    """How a .npz or a .py acts, and begins an episode."""
    if path.suffix == ".npz":
        policy = load_policy(path)
        return policy, policy.reset
    module = module_of(path)
    return module.act, module.reset


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


def rename(source, directory, **fields):
    arrays, meta = read_arrays(source)
    write_arrays(directory / "policy.npz", arrays, {"policy": meta["policy"] | fields})


READERS = {".py": lambda path: python(path).act, ".onnx": onnx, ".npz": load_policy}
