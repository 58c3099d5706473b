"""Runs on machines without a shared disk: each works in a folder on its own machine, and its files go there and back.

The `Store`, a Ray actor on the driver's machine, has the run directories. A new task receives their files, and sends
back what changes: it looks several times a second, and takes a snapshot while the run is not writing.
"""

from __future__ import annotations

import contextlib
import importlib
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from metrpo.launch.ray import worker
from metrpo.launch.ray.store import Changes, Store, marks, within
from metrpo.run.files import writing
from metrpo.run.lock import DirectoryInUse

FIRST, LAST = ("run.json", "config.json", "episodes/", "checkpoints/"), "metrics.csv"
"""Prefixes of the files that others rely on, and the file that makes a run count as finished."""
_POLL = 1.0
"""Seconds between two checks whether a run directory is free."""


class RayActor:
    """A `Store` as a Ray actor: each call returns when it is finished, and raises what the store raised."""

    def __init__(self, handle: Any) -> None:
        ray = importlib.import_module("ray")

        def call(method: Any) -> Callable[..., Any]:
            def wait_for(*arguments: Any) -> Any:
                try:
                    return ray.get(method.remote(*arguments))
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None

            return wait_for

        self.begin, self.take, self.end = call(handle.begin), call(handle.take), call(handle.end)


Keeper = Store | RayActor


def rank(name: str) -> tuple[int, str]:
    """Sort key of files before writing: first those that others rely on, `LAST` last."""
    place = next((i for i, start in enumerate(FIRST) if name.startswith(start)), len(FIRST))
    return len(FIRST) + 1 if name == LAST else place, name


class Copy:
    """A run's folder on the machine that works in it, and which part of it the keeper has."""

    def __init__(self, keeper: Keeper, run: str, directory: Path, log: Path) -> None:
        self._keeper, self._run, self._directory, self._log = keeper, run, directory, log
        self.attempt, files = _begin(keeper, run)
        with writing(directory):
            for name, content in files.items():
                path = within(directory, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
        self._known, self._said = marks(directory), 0

    def send(self) -> None:
        """Sends the changes to the keeper, but none while the run is writing. Raises what the keeper does."""
        now = marks(self._directory)
        names = sorted((name for name in now if now[name] != self._known.get(name)), key=rank)
        try:
            files = tuple((name, (self._directory / name).read_bytes()) for name in names)
        except FileNotFoundError:
            return
        if marks(self._directory) != now:
            return
        log = self._new_output()
        gone = tuple(sorted(self._known.keys() - now.keys()))
        if files or gone or log:
            self._keeper.take(self._run, self.attempt, Changes(files, gone, log, self._said))
            self._known, self._said = now, self._said + len(log)

    def _new_output(self) -> bytes:
        with open(self._log, "rb") as file:
            file.seek(self._said)
            return file.read()


def _begin(keeper: Keeper, run: str) -> tuple[int, dict[str, bytes]]:
    deadline = time.monotonic() + worker.PATIENCE
    while True:
        try:
            return keeper.begin(run)
        except DirectoryInUse:
            if time.monotonic() > deadline:
                raise
            time.sleep(_POLL)


def attend(order: worker.Order, run: str, keeper: Keeper) -> worker.Ended:
    """As `worker.attend`, in a temporary folder on this machine that starts as the keeper's and is sent back to it.

    Raises what the keeper does; by then the run's process has ended.
    """
    with tempfile.TemporaryDirectory(prefix="metrpo-", ignore_cleanup_errors=True) as temporary:
        directory, log = Path(temporary, run), Path(temporary, f"{run}.log")
        copy = Copy(keeper, run, directory, log)
        words = tuple(str(directory) if word == order.directory else word for word in order.words)
        folder = order.folder if Path(order.folder).is_dir() else temporary
        here = replace(order, words=words, directory=str(directory), log=str(log), folder=folder)
        try:
            return worker.attend(here, copy.send)
        finally:
            with contextlib.suppress(Exception):  # an earlier error matters more
                keeper.end(run, copy.attempt)


def attend_for(order: worker.Order, run: str, handle: Any) -> worker.Ended:
    """`attend` for the store that is the actor `handle`: what a machine of the cluster does for one run."""
    return attend(order, run, RayActor(handle))


def start_store(ray: Any, out: Path) -> Any:
    """The store of `out`, as an actor on this machine, which ends with the driver."""
    strategies = importlib.import_module("ray.util.scheduling_strategies")
    here = strategies.NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    # What was sent while the network was away is sent again.
    return ray.remote(num_cpus=0, max_task_retries=-1, scheduling_strategy=here)(Store).remote(str(out))
