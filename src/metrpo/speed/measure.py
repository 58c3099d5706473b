"""What `metrpo bench` measures: our work and the peers' in turns, and whole iterations; as records and as text."""

from __future__ import annotations

import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from metrpo import training
from metrpo.launch.status import Tell
from metrpo.run.directory import RunDirectory
from metrpo.run.machine import cores, device_names
from metrpo.speed import ours, peers

UNTIL_IMAGINED = sys.executable, "-m", "metrpo.commands.until_imagined"
"""The command of a process that ends with its first imagined steps."""
TURN = 1.0
"""Seconds for which one piece of work is repeated in a round; what takes longer is done once."""


@dataclass(frozen=True)
class Timing:
    """One piece of work, timed."""

    name: str
    who: str
    """metrpo or a peer."""
    seconds: float
    """Median."""
    all_seconds: list[float]
    per_second: float | None = None
    """Samples or steps per second."""
    gigaflops: float | None = None
    """Of its matrix products, per second."""
    share: float | None = None
    """Of the rate that bounds it."""
    ratio: float | None = None
    """For a peer: its seconds over ours, median of the ratios within each round."""


@dataclass(frozen=True)
class Iterations:
    """Whole outer iterations of a small run, in this process."""

    seconds: list[float]
    """Of each."""
    outside: list[float]
    """Share of each spent outside its stages (collect, fit, improve, validate, evaluate)."""
    compilations: list[int]
    """In each."""
    start_to_imagined: float | None
    """Seconds from the start of `metrpo train` to its first imagined steps, with the compile cache warm."""


@dataclass(frozen=True)
class BenchReport:
    """What was measured, and where."""

    machine: dict[str, Any]
    timings: list[Timing]
    iterations: Iterations | None = None

    @staticmethod
    def of(record: dict[str, Any]) -> BenchReport:
        """The report that `record` was taken of."""
        iterations = record["iterations"] and Iterations(**record["iterations"])
        return BenchReport(record["machine"], [Timing(**timing) for timing in record["timings"]], iterations)

    def record(self) -> dict[str, Any]:
        """For a script to read."""
        return asdict(self)

    def text(self) -> str:
        """For people."""
        lines = [f"{name}: {value}" for name, value in self.machine.items()]
        heading = ("work", "who", "median", "min", "max", "per second", "GFLOP/s", "share", "ratio")
        rows = [heading] + [_row(t) for t in self.timings]
        widths = [max(len(row[i]) for row in rows) for i in range(len(heading))]
        lines += [
            "",
            *(
                "  ".join(c.ljust(w) if i < 2 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
                for row in rows
            ),
        ]
        if self.iterations is not None:
            i = self.iterations
            lines += ["", f"outer iterations ({ours.TASK}, fast): " + ", ".join(f"{s:.1f} s" for s in i.seconds)]
            lines += ["  outside the stages: " + ", ".join(f"{100 * share:.1f} %" for share in i.outside)]
            lines += ["  compilations: " + ", ".join(map(str, i.compilations))]
            if i.start_to_imagined is not None:
                lines += [f"  from start to the first imagined steps, compile cache warm: {i.start_to_imagined:.1f} s"]
        return "\n".join(line.rstrip() for line in lines)


def _row(t: Timing) -> tuple[str, ...]:
    def number(value: float | None, form: str, scale: float = 1.0) -> str:
        return "" if value is None else format(scale * value, form)

    times = (f"{1e3 * s:.1f} ms" for s in (t.seconds, min(t.all_seconds), max(t.all_seconds)))
    return (
        t.name,
        t.who,
        *times,
        number(t.per_second, ",.0f"),
        number(t.gigaflops, ".0f"),
        number(t.share, ".0f", 100) + (" %" if t.share else ""),
        number(t.ratio, ".2f"),
    )


def bench(with_peers: bool, rounds: int, whole_iterations: bool, tell: Tell = lambda text: None) -> BenchReport:
    """Times every piece of work once a round, ours and the peers' in turns, so that all see the same machine.

    Raises `MetrpoError` when the peers' environment cannot be made or a peer fails.
    """
    with ExitStack() as stack:
        runs: dict[tuple[str, str], Callable[[], float]] = {}
        works: dict[str, ours.Work] = {}
        workers = {}
        if with_peers:
            if not peers.is_installed():
                tell("installing the peers, once")
            workers = {name: stack.enter_context(peers.PeerWorker(name)) for name in peers.PEERS}
        available = ours.works()
        for name, make in available.items():
            tell(f"preparing {name}")
            works[name] = make()
            runs[name, "metrpo"] = works[name].run
            for peer, worker in workers.items():
                for theirs in peers.WORK[peer]:
                    if counterpart(theirs, available) == name:
                        runs[theirs, peer] = partial(_measure, worker, theirs)
        seconds: dict[tuple[str, str], list[float]] = {key: [] for key in runs}
        for number in range(rounds):
            tell(f"round {number + 1} of {rounds}")
            for key, run in runs.items():
                seconds[key].append(_turn(run))
    timings = [_timing(name, who, values, works, seconds) for (name, who), values in seconds.items()]
    iterations = _iterations(tell) if whole_iterations else None
    return BenchReport(_machine(), timings, iterations)


def _turn(run: Callable[[], float]) -> float:
    """Seconds of one piece of work, the median of as many repetitions as `TURN` has room for.

    The first is not counted where there is room for more: it finds the caches full of another's work.
    """
    start = time.perf_counter()
    first = run()
    seconds: list[float] = []
    while time.perf_counter() - start < TURN:
        seconds.append(run())
    return statistics.median(seconds or [first])


def _measure(worker: peers.PeerWorker, work: str) -> float:
    return worker.measure(work, 1)[0]


def counterpart(theirs: str, works: Mapping[str, object]) -> str:
    """Our name for a peer's work: the same, or without the variant behind the last hyphen (fit-1024-basic)."""
    return theirs if theirs in works else theirs.rsplit("-", 1)[0]


def _timing(
    name: str, who: str, values: list[float], works: dict[str, ours.Work], seconds: dict[tuple[str, str], list[float]]
) -> Timing:
    median = statistics.median(values)
    if who != "metrpo":
        same = seconds[counterpart(name, works), "metrpo"]
        ratios = [theirs / mine for theirs, mine in zip(values, same, strict=True)]
        return Timing(name, who, median, values, ratio=statistics.median(ratios))
    work = works[name]
    rate = work.operations / median / 1e9 if work.operations else None
    share = None
    if work.operations and work.bound:
        bound = works[work.bound].operations
        assert bound is not None
        # Round by round, for the machine's speed drifts.
        share = statistics.median(
            (work.operations / mine) / (bound / theirs)
            for mine, theirs in zip(values, seconds[work.bound, "metrpo"], strict=True)
        )
    return Timing(name, who, median, values, work.units / median if work.units else None, rate, share)


def _machine() -> dict[str, Any]:
    return {
        "processor": _processor(),
        "cores": cores(),
        "devices": ", ".join(device_names()),
        "python": platform.python_version(),
        "jax": version("jax"),
    }


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _iterations(tell: Tell) -> Iterations:
    """A run of three iterations, with everything that `metrpo train` writes but the video."""
    config = ours.small_iteration()
    jax.clear_caches()
    seconds, outside, counts = [], [], []
    with tempfile.TemporaryDirectory() as scratch, RunDirectory(Path(scratch) / "run", config) as run:
        state = training.init(config)
        while not training.finished(config, state):
            tell(f"outer iteration {state.iteration + 1} of {config.iterations}")
            start = time.perf_counter()
            with compilations() as seen:
                state, row = training.step(config, state)
                run.save(state, row)
            seconds.append(time.perf_counter() - start)
            stages = sum(float(value or 0) for name, value in row.items() if name.startswith("seconds_"))
            outside.append(1 - stages / seconds[-1])
            counts.append(len(seen))
    tell("starting a process")
    return Iterations(seconds, outside, counts, _start_to_imagined())


@contextmanager
def compilations() -> Iterator[list[float]]:
    """A list that grows by the seconds of every compilation inside the block."""
    seen: list[float] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seen
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def _start_to_imagined() -> float | None:
    """Seconds of a second process: the first one fills the compile cache. They hold collecting and the first fit."""
    seconds = None
    for _ in range(2):
        with tempfile.TemporaryDirectory() as scratch:
            start = time.perf_counter()
            arguments = [ours.TASK, "--run-dir", str(Path(scratch) / "run")]
            done = subprocess.run([*UNTIL_IMAGINED, *arguments], capture_output=True, text=True)
            seconds = time.perf_counter() - start if "imagined" in done.stdout else None
    return seconds
