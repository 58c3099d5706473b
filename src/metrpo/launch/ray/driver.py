"""Many runs on a Ray cluster: one task each, which Ray places, and starts again where its machine is lost.

Ray does the scheduling. This module adds resuming: a task that is started again waits until no process holds its run
directory, and resumes from the last checkpoint. So does the next command after a kill. Finished runs stay finished.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from metrpo.console.interrupt import stop
from metrpo.console.result_lines import duration
from metrpo.counting import counted
from metrpo.errors import MetrpoError
from metrpo.launch.backend import Means
from metrpo.launch.ray import sync, worker
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import Tell, has_spent, log_of, tail, tell_failure, tell_success, words

RETRIES = 20
"""How often a run is started again because its machine or worker was lost. A run that ends with an error is not: the
error would come again."""
_POLL = 0.5
"""Seconds between two looks at the tasks."""
_REPORT = 60.0
"""Seconds between two progress reports."""


def run_on_ray(runs: list[RunSpec], out: Path, means: Means, tell: Tell) -> list[RunSpec]:
    """Runs all on a Ray cluster and returns those that failed (see `reproduce`).

    Its machines share `out`, or each works in a folder of its own and sends `out` what changes (`means.storage`).
    Raises `MetrpoError` when Ray is not installed or its cluster cannot be reached.
    """
    environment = worker.forwarded(os.environ)
    ray = _import_ray()
    with _connected(ray, means.address), _heard() as heard:
        _tell_resources(ray, means, tell)
        task = ray.remote(
            num_cpus=means.cpus or 1,
            num_gpus=means.gpus,
            max_retries=RETRIES,
            retry_exceptions=False,
            scheduling_strategy="SPREAD",
        )(worker.attend if means.storage == "shared" else sync.attend_for)
        store = None if means.storage == "shared" else sync.start_store(ray, out.absolute())
        waiting, failed, reported = list(runs), list[RunSpec](), time.monotonic()
        under_way: dict[Any, RunSpec] = {}
        while (waiting or under_way) and not heard:
            while waiting and len(under_way) < (means.jobs or len(runs)):
                run = waiting.pop(0)
                order = _order(run, out.absolute(), means, environment)
                under_way[task.remote(order, run.name, store) if store else task.remote(order)] = run
            time.sleep(_POLL)
            for ref in _ended(ray, list(under_way)):
                run = under_way.pop(ref)
                ended = len(runs) - len(waiting) - len(under_way)
                if _finish(ray, ref, run, out, f"{ended}/{len(runs)}", tell):
                    failed.append(run)
            if time.monotonic() - reported > _REPORT:
                reported = time.monotonic()
                left = counted(len(waiting) + len(under_way), "run")
                tell(f"  {left} to go; {_resources(ray)}; for each: metrpo watch {out}")
        if heard:
            _stop(ray, list(under_way), heard, tell)
    return failed


def _import_ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Under `uv run` Ray would pack the working directory, runs included, and send it to every machine.
    os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise MetrpoError(f"backend: ray needs Ray ({error}): pip install 'metrpo[ray]', or use local") from None


@contextlib.contextmanager
def _connected(ray: Any, address: str | None) -> Iterator[None]:
    handler = signal.getsignal(signal.SIGTERM)
    try:
        if address and ":" in address:  # Ray itself would try for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=10).close()
        ray.init(address=address, log_to_driver=False, logging_level="warning")
        signal.signal(signal.SIGTERM, handler)  # Ray has put its own there
    except (OSError, RuntimeError, ValueError) as error:
        raise MetrpoError(
            f"cannot reach the Ray cluster {address or os.environ.get('RAY_ADDRESS', '')} "
            f"({str(error).splitlines()[0]}); start one with: ray start --head; if one is there and says "
            "InvalidAuthToken, export RAY_AUTH_MODE=token"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


@contextlib.contextmanager
def _heard() -> Iterator[list[int]]:
    """A list of the signals that ask to stop, as they come. (An exception in a handler would be lost in Ray's code.)"""
    heard: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        # A shell makes background commands ignore Ctrl-C: leave that as it is.
        if handler is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: heard.append(number))
    try:
        yield heard
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _order(run: RunSpec, out: Path, means: Means, environment: dict[str, str]) -> worker.Order:
    directory, cpus = out / run.name, means.cpus or 1
    log, folder = str(log_of(run, out)), str(Path.cwd())
    return worker.Order(tuple(words(run, directory)), str(directory), log, folder, environment, cpus, means.gpus)


def _ended(ray: Any, refs: list[Any]) -> list[Any]:
    return ray.wait(refs, num_returns=len(refs), timeout=0)[0] if refs else []


def _finish(ray: Any, ref: Any, run: RunSpec, out: Path, count: str, tell: Tell) -> bool:
    """Reports how a run ended; returns whether it failed."""
    try:
        ended: worker.Ended = ray.get(ref)
    except ray.exceptions.RayTaskError as error:  # its machine could not even begin
        tell_failure(run, count, f"({type(error.cause).__name__}): {error.cause}", [], tell)
        return True
    except ray.exceptions.RayError as error:
        why = f"because its machine or worker was lost, after {RETRIES} retries ({type(error).__name__}):"
        tell_failure(run, count, why, str(error).splitlines()[-5:], tell)
        return True
    if ended.code == 0 and has_spent(run, ended.rows):
        tell_success(run, count, ended.rows, ended.seconds, tell)
        return False
    log = log_of(run, out)
    why = f"after {duration(ended.seconds)} (exit code {ended.code}); the end of {log}:"
    tell_failure(run, count, why, tail(log), tell)
    return True


def _stop(ray: Any, refs: list[Any], heard: list[int], tell: Tell) -> None:
    """Stops the runs and raises `Stopped`: each finishes its iteration; after a second signal, they are killed."""
    tell("stopping the runs at the end of an iteration; press again to stop at once")
    for ref in refs:
        ray.cancel(ref, recursive=False)  # files on their way to the store must arrive
    while refs and len(heard) == 1:
        time.sleep(_POLL)
        ended = _ended(ray, refs)
        refs = [ref for ref in refs if ref not in ended]
    for ref in refs:
        ray.cancel(ref, force=True)
    stop(heard[0])


def _tell_resources(ray: Any, means: Means, tell: Tell) -> None:
    cpus, gpus = means.cpus or 1, means.gpus
    at_a_time = f"at most {means.jobs}" if means.jobs else "as many as fit"
    tell(f"{at_a_time} at a time on the Ray cluster, {cpus} CPU and {gpus:g} GPU for each; {_resources(ray)}")
    there = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(node.get("CPU", 0) >= cpus and node.get("GPU", 0) >= gpus for node in there):
        tell(f"no machine of the cluster has {cpus} CPU and {gpus:g} GPU; the runs wait until one joins")


def _resources(ray: Any) -> str:
    total, free = ray.cluster_resources(), ray.available_resources()
    used = [
        f"{total[kind] - free.get(kind, 0):g} of {total[kind]:g} {kind}s" for kind in ("CPU", "GPU") if kind in total
    ]
    return f"{sum(node['Alive'] for node in ray.nodes())} machines, {' and '.join(used) or 'no CPUs'} in use"
