"""The learned policy as a file: written by a run, and checked before it is used."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from metrpo.config import Config
from metrpo.errors import RunDirectoryError
from metrpo.history import History
from metrpo.policy_zoo import located
from metrpo.run.files import BEST, FORMAT, atomic_write, inside, metrpo_version, read_arrays, write_arrays
from metrpo.run.loaded_policy import LoadedPolicy, PolicyInfo
from metrpo.safe_load import brief

if TYPE_CHECKING:  # loading a policy imports no environment
    from metrpo.world.interface import Interface

FILE = "policy.npz"
_MOST = 1e300
"""Beyond it the difference of two bounds may overflow."""
_SHOWN = ("observation", "action_low", "action_high")
"""Fields that say what the environment shows and takes."""
_MADE = ("env_kwargs", "imports")
"""Fields that say how the environment is made."""
_LIMITS = ("max_action", "max_change")
"""Fields that say what its actions are held to."""
_SINCE = dict.fromkeys(_SHOWN) | {"env_kwargs": [], "imports": [], "max_action": 1.0, "max_change": None, "history": 1}
"""Fields that older policies lack, and what that means."""


class Learned(NamedTuple):
    """How far a run had come when it had a policy."""

    iteration: int
    """Outer iterations of training."""
    real_steps: int
    """Real steps that it had learned from."""
    return_real: float | None
    """Mean real return of the policy without noise; None: not known."""


class Weights(Protocol):
    """A Gaussian policy's parameters (`metrpo.policy.gaussian.Policy`)."""

    @property
    def layers(self) -> tuple[tuple[Any, Any], ...]:
        """Weights [in, out] and bias [out] of every layer."""

    @property
    def log_std(self) -> Any:
        """[A]"""


def save_policy(
    directory: Path,
    policy: Weights,
    task: str,
    learned: Learned,
    interface: Interface | None = None,
    origin: np.ndarray | None = None,
    settings: Config | None = None,
) -> None:
    """Writes `policy.npz` (weights and info) and `policy.json` (the info for people and other programs).

    `origin` [S], float64, is what its states are counted from; `settings` are the run's.

    Raises `RunDirectoryError` when they cannot be written.
    """
    layers = [(np.asarray(w), np.asarray(b)) for w, b in policy.layers]
    hidden = tuple(len(b) for _, b in layers[:-1])
    history = 1 if settings is None else settings.history
    layout = History.of_state(history, layers[0][0].shape[0], layers[-1][0].shape[1])
    sizes = (layout.observation_size, layout.action_size, hidden)
    info = PolicyInfo(task, *sizes, *learned, history=history)
    info = with_interface(info, interface)
    if settings is not None:
        info = replace(info, **{name: getattr(settings, name) for name in (*_MADE, *_LIMITS)})
    arrays = {f"{kind}{i}": array for i, layer in enumerate(layers) for kind, array in zip("wb", layer, strict=True)}
    arrays["log_std"] = np.asarray(policy.log_std)
    if origin is not None and origin.any():
        arrays["origin"] = origin
    write_arrays(directory / FILE, arrays, {"policy": asdict(info)})
    digest = hashlib.sha256((directory / FILE).read_bytes()).hexdigest()
    beside = {"format": FORMAT, "metrpo": metrpo_version(), **asdict(info), "file": FILE, "sha256": digest}
    atomic_write(directory / "policy.json", json.dumps(beside, indent=2) + "\n")


def with_interface(info: PolicyInfo, interface: Interface | None) -> PolicyInfo:
    """The info with what the environment shows and takes; as it is where that is unknown or of other sizes."""
    if interface is None:
        return info
    sizes = (sum(size for size, _ in interface.observation), len(interface.action_low), len(interface.action_high))
    if sizes != (info.observation_size, info.action_size, info.action_size):  # it would not be read again
        return info
    return replace(info, **{name: getattr(interface, name) for name in _SHOWN})


def load_policy(directory: str | Path) -> LoadedPolicy:
    """The policy of a run directory, of `zoo:NAME`, of `hub:OWNER/NAME` on the Hugging Face hub (extra `hub`), or of a
    `policy.npz` itself; needs NumPy only.

    Raises `RunDirectoryError` when there is none, or it is damaged, of another version, or unusable: its arrays do not
    fit its sizes, or its weights are not finite.
    """
    path = located(directory)
    if path.suffix != ".npz" and path.is_file():
        raise RunDirectoryError(f"{path}: expected a run directory or a policy.npz, got another file")
    path = path if path.suffix == ".npz" else path / FILE
    if not path.exists():
        raise RunDirectoryError(f"{directory} holds no policy: {_where_else(path)}")
    arrays, meta = read_arrays(path)
    info = _info(meta.get("policy", {}), path)
    return LoadedPolicy(info, _layers(info, arrays, path), arrays.get("origin"))


def _where_else(path: Path) -> str:
    """What was expected, what was found, and what to do, where `path` is missing."""
    if path.name != FILE:
        return f"expected the file {path}, got none; give a run directory, or a policy.npz"
    folder = path.parent
    if folder.name == BEST and (folder.parent / "config.json").exists():
        return (
            f"expected {path}, got a run that was never evaluated, or began under an older version and has earned no "
            f"more since; its last policy is in {folder.parent}"
        )
    if (folder / "config.json").exists():
        return f"expected {path}, got a run whose first iteration is not finished; resume it with its own command"
    if run := inside(folder, FILE):
        return f"expected one run's directory, got a folder of runs; name one of them, such as {run}"
    return f"expected {path}; train one with: metrpo train TASK --run-dir {folder}"


def _info(stored: Any, path: Path) -> PolicyInfo:
    names = [f.name for f in fields(PolicyInfo)]
    missing = [name for name in names if name not in _SINCE and not (isinstance(stored, dict) and name in stored)]
    if missing:
        raise RunDirectoryError(f"{path} is no policy: it lacks {', '.join(missing)}")
    if unknown := [name for name in stored if name not in names]:
        raise RunDirectoryError(f"{path}: expected the fields that this version knows, got {brief(unknown)}")
    stored = _SINCE | stored
    for name, sound, expected in _checks(stored):
        if not sound:
            raise RunDirectoryError(f"{path}: {name}: expected {expected}, got {brief(stored[name])}")
    tuples = {name: stored[name] and tuple(stored[name]) for name in ("action_low", "action_high")}
    tuples |= {name: tuple(stored[name]) for name in _MADE}
    parts = stored["observation"]
    tuples |= {"hidden": tuple(stored["hidden"]), "observation": parts and tuple(map(tuple, parts))}
    return PolicyInfo(**{**stored, **tuples})


def _checks(stored: Mapping[str, Any]) -> Sequence[tuple[str, bool, str]]:
    """Each field, whether its value is sound, and what was expected."""
    sizes, parts = stored["hidden"], stored["observation"]
    return (
        ("task", isinstance(stored["task"], str), "a name"),
        ("observation_size", _is_size(stored["observation_size"]), "a whole number above 0"),
        ("action_size", _is_size(stored["action_size"]), "a whole number above 0"),
        ("hidden", isinstance(sizes, list) and all(map(_is_size, sizes)), "a list of whole numbers above 0"),
        ("activation", stored["activation"] == "tanh", "'tanh'"),
        ("observation", _are_parts(parts, stored["observation_size"]), "[numbers, what they are] for all of it"),
        *((n, _are_bounds(stored[n], stored["action_size"]), "a number for each action") for n in _SHOWN[1:]),
        *((n, _are_texts(stored[n]), "a list of texts") for n in _MADE),
        ("max_action", _is_share(stored["max_action"]), "a number above 0 and at most 1"),
        ("max_change", stored["max_change"] is None or _is_positive(stored["max_change"]), "a number above 0"),
        ("history", _is_size(stored["history"]), "a whole number above 0"),
        # These say where it comes from and mean nothing to its use.
        *(
            (n, isinstance(stored[n], int | float | str | None), "a number")
            for n in ("iteration", "real_steps", "return_real")
        ),
    )


def _are_parts(parts: Any, size: int) -> bool:
    if parts is None:
        return True
    pairs = isinstance(parts, list) and all(isinstance(part, list) and len(part) == 2 for part in parts)
    sound = pairs and all(_is_size(number) and isinstance(text, str) for number, text in parts)
    return sound and sum(number for number, _ in parts) == size


def _is_positive(value: Any) -> bool:
    return type(value) in (int, float) and 0 < value <= _MOST


def _is_share(value: Any) -> bool:
    return _is_positive(value) and value <= 1


def _are_texts(texts: Any) -> bool:
    return isinstance(texts, list) and all(isinstance(text, str) for text in texts)


def _are_bounds(bounds: Any, size: int) -> bool:
    if bounds is None:
        return True
    numbers = isinstance(bounds, list) and all(type(b) in (int, float) and abs(b) <= _MOST for b in bounds)
    return numbers and len(bounds) == size


def _is_size(value: Any) -> bool:
    return type(value) is int and 0 < value < 2**31


def _layers(
    info: PolicyInfo, arrays: Mapping[str, np.ndarray], path: Path
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    sizes = (info.layout.state_size, *info.hidden, info.action_size)
    expected: dict[str, tuple[int, ...]] = {"log_std": (info.action_size,)}
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        expected |= {f"w{i}": (inputs, outputs), f"b{i}": (outputs,)}
    if "origin" in arrays:
        expected["origin"] = (info.layout.state_size,)
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
        kind = np.float64 if name == "origin" else np.float32
        if array.dtype != kind:
            raise RunDirectoryError(f"{path}: {name}: expected {np.dtype(kind)}, got {array.dtype}")
        if not np.isfinite(array).all():
            raise RunDirectoryError(
                f"{path}: expected finite weights, got infinite or NaN in {name}; take an earlier one"
            )
    return tuple((arrays[f"w{i}"], arrays[f"b{i}"]) for i in range(len(sizes) - 1))
