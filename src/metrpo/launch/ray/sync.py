"""Runs on machines without a common disk: each works in a folder of its own machine, and its files go there and back.

The `Store`, a Ray actor on the driver's machine, has the run directories. A task that begins gets what is there now,
and gives back what has changed: it looks several times a second, and takes a picture while the run is not writing.
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
"""How the names begin of what others rely on, and the file by which a run counts as finished."""
_POLL = 1.0
"""Seconds between two questions whether a run directory is free."""


class Actor:
    """A `Store` that is a Ray actor: each call returns when it is done, and raises what was raised there."""

    def __init__(self, handle: Any) -> None:
        ray = importlib.import_module("ray")

        def call(method: Any) -> Callable[..., Any]:
            def done(*arguments: Any) -> Any:
                try:
                    return ray.get(method.remote(*arguments))
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None

            return done

        self.begin, self.take, self.end = call(handle.begin), call(handle.take), call(handle.end)


Keeper = Store | Actor


def rank(name: str) -> tuple[int, str]:
    """By what files are sorted before they are written: first what others rely on, `LAST` last."""
    place = next((i for i, start in enumerate(FIRST) if name.startswith(start)), len(FIRST))
    return len(FIRST) + 1 if name == LAST else place, name


class Copy:
    """A run's folder on the machine that works in it, and how much of it the keeper has."""

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
        """Gives the keeper what has changed; nothing while the run is writing. Raises what the keeper does."""
        now = marks(self._directory)
        names = sorted((name for name in now if now[name] != self._known.get(name)), key=rank)
        try:
            files = tuple((name, (self._directory / name).read_bytes()) for name in names)
        except FileNotFoundError:
            return
        if marks(self._directory) != now:
            return
        log = self._new_words()
        gone = tuple(sorted(self._known.keys() - now.keys()))
        if files or gone or log:
            self._keeper.take(self._run, self.attempt, Changes(files, gone, log, self._said))
            self._known, self._said = now, self._said + len(log)

    def _new_words(self) -> bytes:
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
    """As `on_node.attend`, in a temporary folder of this machine that begins as the keeper's and is given back to it.

    Raises what the keeper does; the process of the run has ended then.
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
            with contextlib.suppress(Exception):  # what has gone wrong before is what matters
                keeper.end(run, copy.attempt)


def attend_for(order: worker.Order, run: str, handle: Any) -> worker.Ended:
    """`attend` for the store that is the actor `handle`: what a machine of the cluster does for one run."""
    return attend(order, run, Actor(handle))


def start_store(ray: Any, out: Path) -> Any:
    """The store of `out`, as an actor on this machine, which ends with the driver."""
    strategies = importlib.import_module("ray.util.scheduling_strategies")
    here = strategies.NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    # What was sent while the network was away is sent again.
    return ray.remote(num_cpus=0, max_task_retries=-1, scheduling_strategy=here)(Store).remote(str(out))
