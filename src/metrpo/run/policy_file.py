"""The learned policy as a file, and its use without JAX: NumPy in, NumPy out."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from metrpo.errors import RunDirectoryError
from metrpo.run.files import FORMAT, atomic_write, metrpo_version, read_arrays, write_arrays

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

        Raises `ValueError` when the observation has another shape.
        """
        hidden = np.asarray(observation, dtype=np.float32)
        size = self.info.observation_size
        if hidden.ndim not in (1, 2) or hidden.shape[-1] != size:
            raise ValueError(f"observation: expected shape [{size}] or [B, {size}], got {list(hidden.shape)}")
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

    Raises `RunDirectoryError` when there is none, or it is damaged or of another version.
    """
    path = Path(directory)
    path = path if path.suffix == ".npz" else path / FILE
    if not path.exists():
        raise RunDirectoryError(
            f"{directory} holds no policy: expected {path}; train one with: metrpo train TASK --run-dir {directory}"
        )
    arrays, meta = read_arrays(path)
    stored = meta.get("policy", {})
    missing = [f.name for f in fields(PolicyInfo) if f.name not in stored]
    if missing:
        raise RunDirectoryError(f"{path} is no policy: it lacks {', '.join(missing)}")
    info = PolicyInfo(**{**stored, "hidden": tuple(stored["hidden"])})
    return LoadedPolicy(info, tuple((arrays[f"w{i}"], arrays[f"b{i}"]) for i in range(len(info.hidden) + 1)))
