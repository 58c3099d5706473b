"""Experiment trackers as callbacks, one file each; none is needed, and none is imported before it is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Literal

from metrpo.callbacks import Callback
from metrpo.errors import ConfigError

TrackerName = Literal["wandb", "mlflow", "trackio", "tensorboard"]
"""The rows of `TRACKERS`."""
TRACKERS: dict[TrackerName, tuple[str, str]] = {
    "wandb": ("wandb", "Wandb"),
    "mlflow": ("mlflow", "MLflow"),
    "trackio": ("trackio", "Trackio"),
    "tensorboard": ("tensorboardX", "TensorBoard"),
}
"""Name -> the package that it needs, and its class in the module of that name."""


def trackers(names: Sequence[TrackerName]) -> list[Callback]:
    """The callbacks of some trackers, each once.

    Raises `ConfigError` for an unknown one, and where its package is missing.
    """
    found: list[Callback] = []
    for name in dict.fromkeys(names):
        if name not in TRACKERS:
            raise ConfigError(f"track: expected some of {', '.join(TRACKERS)}, got {name!r}")
        package, made = TRACKERS[name]
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ConfigError(f"track: no package {package}: pip install 'metrpo[{name}]'") from error
        found.append(getattr(importlib.import_module(f"metrpo.trackers.{name}"), made)())
    return found
