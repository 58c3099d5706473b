"""The checkpoints of a run: which ones there are, and the newest one that is intact and the run's own."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
import numpy as np

from metrpo import config as configs
from metrpo.config import Config
from metrpo.errors import ConfigError, RunDirectoryError
from metrpo.run.checkpoint import load_state
from metrpo.run.files import DamagedFile, writing
from metrpo.run.lock import require_same
from metrpo.run.metrics import checked
from metrpo.run.policy_file import Weights

_log = logging.getLogger("metrpo")


class Saved(Protocol):
    """A training state, as a run directory sees it: a pytree with these fields."""

    @property
    def iteration(self) -> int:
        """Outer iterations finished."""

    @property
    def real_steps(self) -> int:
        """Real steps collected."""

    @property
    def policy(self) -> Weights:
        """The accepted policy."""


State = TypeVar("State", bound=Saved)


def checkpoints(run_dir: Path) -> list[Path]:
    """The files of the run's checkpoints, the newest last."""
    names = (run_dir / "checkpoints").glob("iteration-*.npz")
    return sorted((n for n in names if re.fullmatch(r"iteration-[0-9]{5,18}", n.stem)), key=iteration_of)


def file_of(run_dir: Path, iteration: int) -> Path:
    """Where the checkpoint of an iteration stands."""
    return run_dir / "checkpoints" / f"iteration-{iteration:05d}.npz"


def iteration_of(checkpoint: Path) -> int:
    """The iteration of a checkpoint, by its name."""
    return int(checkpoint.stem.removeprefix("iteration-"))


def load_newest(run_dir: Path, template: State, config: Config) -> tuple[State, dict[str, Any]]:
    """State and record of the newest intact checkpoint; damaged ones are set aside, with a warning.

    Raises `RunDirectoryError` when none is sound, or it is of another structure, version or settings than `config`.
    """
    damaged: list[tuple[Path, DamagedFile]] = []
    for path in reversed(checkpoints(run_dir)):
        try:
            state, meta = load_state(path, template)
            require_consistent(path, state, meta)
        except DamagedFile as error:
            damaged.append((path, error))
            continue
        require_same(config_of(path, meta), config, f"{path}, unlike config.json,", run_dir)
        for old, why in damaged:
            _log.warning("%s; resuming from %s, the damaged file is kept as %s.damaged", why, path.name, old.name)
            with writing(aside := old.with_name(f"{old.name}.damaged")):
                old.rename(aside)
        return state, meta
    what = " and ".join(str(why) for _, why in damaged)
    raise DamagedFile(
        f"{what}. Nothing was changed. There is no earlier checkpoint: put the file back, or start anew in another "
        "directory (--run-dir)"
    )


def config_of(path: Path, meta: Mapping[str, Any]) -> Config:
    """The settings in a checkpoint's record; raises `RunDirectoryError` when they are no settings of this version."""
    text = meta.get("config")
    try:
        return configs.from_json(text if isinstance(text, str) else "")
    except ConfigError as error:
        raise RunDirectoryError(f"{path} does not fit this version: {error}; choose another directory") from None


def require_consistent(path: Path, state: Saved, meta: Mapping[str, Any]) -> None:
    """Checks that a checkpoint's name, state and record agree, for people rename and copy files by hand.

    Raises `DamagedFile` when it is another iteration's, `RunDirectoryError` when no run can have written it.
    """
    if state.iteration != iteration_of(path):
        raise DamagedFile(
            f"{path} is damaged (renamed): expected iteration {iteration_of(path)}, got {state.iteration}"
        )
    episodes = meta.get("episodes", 0)
    try:
        checked(meta.get("rows"), state.iteration)
        if type(episodes) is not int or episodes < 0 or state.real_steps < 0:
            raise ValueError("expected counts of episodes and real steps")
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
            raise ValueError("expected finite numbers, got some that are infinite or NaN")
    except ValueError as error:
        raise RunDirectoryError(f"{path} holds no state to resume from: {error}; choose another directory") from None
