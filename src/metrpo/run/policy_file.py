"""The learned policy as a file, and its use without JAX: NumPy in, NumPy out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from metrpo.errors import RunDirectoryError
from metrpo.run.files import FORMAT, atomic_write, inside, metrpo_version, read_arrays, write_arrays
from metrpo.untrusted import brief

FILE = "policy.npz"


@dataclass(frozen=True)
class PolicyInfo:
    """What a policy is for and where it comes from."""

    task: str
    """Name of the task it was trained on."""
    observation_size: int
    """S"""
    action_size: int
    """A"""
    hidden: tuple[int, ...]
    """Sizes of the hidden layers."""
    iteration: int
    """Outer iterations of training."""
    real_steps: int
    """Real steps it has learnt from."""
    return_real: float | None
    """Mean real return of the deterministic policy at that time."""
    activation: str = "tanh"
    """Of the hidden layers; the output layer is linear, clipped to [-1, 1]."""


class Weights(Protocol):
    """A Gaussian policy's parameters (`metrpo.policy.gaussian.Policy`)."""

    @property
    def layers(self) -> tuple[tuple[Any, Any], ...]:
        """Weights [in, out] and bias [out] of every layer."""

    @property
    def log_std(self) -> Any:
        """[A]"""


@dataclass(frozen=True)
class LoadedPolicy:
    """A deterministic policy: call it with observations, get actions."""

    info: PolicyInfo
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Weights [in, out] and bias [out] of every layer."""

    def __call__(self, observation: Any) -> np.ndarray:
        """The action, in [-1, 1], float32: [S] -> [A] or [B, S] -> [B, A].

        Raises `ValueError` when the observation has another shape, or is not finite in float32.
        """
        with np.errstate(over="ignore"):
            hidden = np.asarray(observation, dtype=np.float32)
        size = self.info.observation_size
        if hidden.ndim not in (1, 2) or hidden.shape[-1] != size:
            raise ValueError(f"observation: expected shape [{size}] or [B, {size}], got {list(hidden.shape)}")
        if not np.isfinite(hidden).all():
            at = np.argwhere(~np.isfinite(hidden))[0]
            raise ValueError(f"observation: expected finite numbers, got {hidden[tuple(at)]} at {at.tolist()}")
        for weights, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weights + bias)
        weights, bias = self.layers[-1]
        return np.clip(hidden @ weights + bias, -1.0, 1.0)


def save_policy(
    directory: Path, policy: Weights, task: str, iteration: int, real_steps: int, return_real: float | None
) -> None:
    """Writes `policy.npz` (weights and info) and `policy.json` (the info for people and other programs).

    Raises `RunDirectoryError` when they cannot be written.
    """
    layers = [(np.asarray(w), np.asarray(b)) for w, b in policy.layers]
    hidden = tuple(len(b) for _, b in layers[:-1])
    info = PolicyInfo(task, layers[0][0].shape[0], layers[-1][0].shape[1], hidden, iteration, real_steps, return_real)
    arrays = {f"{kind}{i}": array for i, layer in enumerate(layers) for kind, array in zip("wb", layer, strict=True)}
    write_arrays(directory / FILE, arrays | {"log_std": np.asarray(policy.log_std)}, {"policy": asdict(info)})
    digest = hashlib.sha256((directory / FILE).read_bytes()).hexdigest()
    beside = {"format": FORMAT, "metrpo": metrpo_version(), **asdict(info), "file": FILE, "sha256": digest}
    atomic_write(directory / "policy.json", json.dumps(beside, indent=2) + "\n")


def load_policy(directory: str | Path) -> LoadedPolicy:
    """The policy of a run directory (or of a `policy.npz` itself); needs NumPy only.

    Raises `RunDirectoryError` when there is none, or it is damaged, of another version or cannot act: other arrays than
    its sizes say, or weights that are not finite.
    """
    path = Path(directory)
    path = path if path.suffix == ".npz" else path / FILE
    if not path.exists():
        raise RunDirectoryError(f"{directory} holds no policy: {_where_else(path)}")
    arrays, meta = read_arrays(path)
    info = _info(meta.get("policy", {}), path)
    return LoadedPolicy(info, _layers(info, arrays, path))


def _where_else(path: Path) -> str:
    """What to do where `path` is missing."""
    if path.name != FILE:
        return f"expected the file {path}, got none; give a run directory, or a policy.npz"
    folder = path.parent
    if run := inside(folder, FILE):
        return f"expected one run's directory, got a folder of runs; name one of them, such as {run}"
    if (folder / "config.json").exists():
        return f"expected {path}, got a run whose first iteration is not finished; go on with the command that began it"
    return f"expected {path}; train one with: metrpo train TASK --run-dir {folder}"


def _info(stored: Any, path: Path) -> PolicyInfo:
    names = [f.name for f in fields(PolicyInfo)]
    missing = [name for name in names if not (isinstance(stored, dict) and name in stored)]
    if missing:
        raise RunDirectoryError(f"{path} is no policy: it lacks {', '.join(missing)}")
    if unknown := [name for name in stored if name not in names]:
        raise RunDirectoryError(f"{path}: expected what this version knows of a policy, got {brief(unknown)}")
    sizes = stored["hidden"]
    for name, sound, expected in (
        ("task", isinstance(stored["task"], str), "a name"),
        ("observation_size", _is_size(stored["observation_size"]), "a whole number above 0"),
        ("action_size", _is_size(stored["action_size"]), "a whole number above 0"),
        ("hidden", isinstance(sizes, list) and all(map(_is_size, sizes)), "a list of whole numbers above 0"),
        ("activation", stored["activation"] == "tanh", "'tanh'"),
        # These say where it comes from and mean nothing to its use.
        *(
            (n, isinstance(stored[n], int | float | str | None), "a number")
            for n in ("iteration", "real_steps", "return_real")
        ),
    ):
        if not sound:
            raise RunDirectoryError(f"{path}: {name}: expected {expected}, got {brief(stored[name])}")
    return PolicyInfo(**{**stored, "hidden": tuple(sizes)})


def _is_size(value: Any) -> bool:
    return type(value) is int and 0 < value < 2**31


def _layers(
    info: PolicyInfo, arrays: Mapping[str, np.ndarray], path: Path
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    sizes = (info.observation_size, *info.hidden, info.action_size)
    expected: dict[str, tuple[int, ...]] = {"log_std": (info.action_size,)}
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        expected |= {f"w{i}": (inputs, outputs), f"b{i}": (outputs,)}
    wrong = [f"{name} is missing" for name in expected if name not in arrays]
    wrong += [f"got {brief(name)} besides" for name in arrays if name not in expected]
    wrong += [
        f"got {name} of {list(arrays[name].shape)} instead of {list(shape)}"
        for name, shape in expected.items()
        if name in arrays and arrays[name].shape != shape
    ]
    if wrong:
        raise RunDirectoryError(f"{path}: expected weights and biases of shapes that fit its sizes; {wrong[0]}")
    for name, array in arrays.items():
        if array.dtype != np.float32:
            raise RunDirectoryError(f"{path}: {name}: expected float32, got {array.dtype}")
        if not np.isfinite(array).all():
            raise RunDirectoryError(
                f"{path}: expected finite weights, got infinite or NaN in {name}; take an earlier one"
            )
    return tuple((arrays[f"w{i}"], arrays[f"b{i}"]) for i in range(len(sizes) - 1))
