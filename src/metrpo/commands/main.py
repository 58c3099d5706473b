"""The command line: `metrpo train`, `metrpo evaluate` and the other commands of `metrpo.commands.options`.

Whatever imports JAX or MuJoCo is imported where it is used: help must come at once, and JAX reads its environment
variables when imported.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from metrpo.commands.options import (
    Bench,
    Collect,
    Doctor,
    Evaluate,
    Export,
    Improve,
    Init,
    Plot,
    Render,
    Report,
    Reproduce,
    Run,
    Sweep,
    Tasks,
    Train,
    Tune,
    Watch,
    parse,
)
from metrpo.config import Config
from metrpo.console.encoding import print_anywhere
from metrpo.console.interrupt import Interruptible, Stopped, stop
from metrpo.console.progress import Progress, mute_broken_output
from metrpo.counting import counted
from metrpo.errors import EpisodeError, MetrpoError, RunDirectoryError
from metrpo.run.machine import settle_libraries

_log = logging.getLogger("metrpo")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code: 0, 2 after a wrong input, 130 after Ctrl-C, 143 after SIGTERM."""
    arguments = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    _occupy_standard_files()
    print_anywhere()
    settle_libraries()
    logging.basicConfig(format="metrpo: %(message)s", level=logging.WARNING)
    if arguments == ["--version"]:
        return _version()
    try:
        command = parse(arguments)
        return _COMMANDS[type(command)](command)
    except MetrpoError as error:
        _say(f"metrpo: {error}")
        _say_how_to_go_on(error, arguments)
        return 2
    except KeyboardInterrupt:
        return 130
    except Stopped as stopped:
        _say_how_to_go_on(stopped, arguments)
        return 128 + stopped.number
    except BrokenPipeError:  # `metrpo train --help | head`
        return 1
    except SystemExit as end:  # tyro has printed help (0) or what was wrong (2)
        return end.code if isinstance(end.code, int) else 2
    finally:
        mute_broken_output()  # the interpreter flushes once more


def _train(command: Train) -> int:
    from metrpo.console.progress import default_progress
    from metrpo.training import train

    config, run_dir = _run(command)

    def complete(progress: Interruptible) -> str | None:
        return f"{run_dir} is complete: nothing is lost. {_AGAIN}" if _is_complete(run_dir, config) else None

    by_episode = config.method == "model-based"
    with _attended(run_dir, default_progress(), keeps_episodes=by_episode, complete=complete) as progress:
        train(config, run_dir, progress)
        progress.close()
        try:
            _report(run_dir, command.video)
        except OSError as error:  # nobody reads on; the run is complete
            _log.warning("cannot say more (%s: %s); %s is complete", type(error).__name__, error, run_dir)
    return 0


@contextmanager
def _attended(
    run_dir: Path,
    shown: Progress,
    keeps_episodes: bool = True,
    complete: Callable[[Interruptible], str | None] = lambda progress: None,
) -> Iterator[Interruptible]:
    """What reports on a run in this block; whoever or whatever stops the run there is told how to go on.

    `complete` says what is true where a signal came too late to stop anything; else None.
    """
    with Interruptible(shown, keeps_episodes) as progress:
        try:
            yield progress
        except (Stopped, KeyboardInterrupt, MetrpoError) as error:
            # What else goes wrong (a file that is missing, a policy that diverged) would do so again.
            may_go_on = isinstance(error, KeyboardInterrupt | EpisodeError | RunDirectoryError)
            if isinstance(error, Stopped | KeyboardInterrupt) and (note := complete(progress)):
                error.add_note(note)
            elif isinstance(error, Stopped) or (progress.began and may_go_on):
                error.add_note(f"{run_dir} keeps every finished iteration and real episode. The same command goes on.")
            raise
        finally:
            progress.close()


_AGAIN = "The same command would only make what is missing of its record, such as the video."


def _is_complete(run_dir: Path, config: Config) -> bool:
    """Whether all iterations that were asked for are on disk."""
    from metrpo.run.find import is_finished, read

    with suppress(MetrpoError):
        return is_finished(dataclasses.replace(read(run_dir), config=config))
    return False


def _say_how_to_go_on(error: BaseException, arguments: Sequence[str]) -> None:
    for note in getattr(error, "__notes__", ()):
        command = f"\n\n  {shlex.join(['metrpo', *arguments])}\n" if "same command" in note else ""
        _say(f"metrpo: stopped; {note}{command}")


def _occupy_standard_files() -> None:
    # Started with stdout or stderr closed, the next file opened would take its place, and a library's warnings.
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(handle, True)
    os.close(handle)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - as long as the process


def _say(text: str) -> None:
    with suppress(OSError):  # stderr may be gone, which is no reason to end otherwise
        print(text, file=sys.stderr)


def _run(command: Run) -> tuple[Config, Path]:
    """The settings, and where the run lives."""
    from metrpo.commands.default_dir import default_run_dir

    config = Config(**{f.name: getattr(command, f.name) for f in dataclasses.fields(Config)})
    return config, command.run_dir or default_run_dir(config)


def _init(command: Init) -> int:
    from metrpo.external import begin
    from metrpo.run.policy_file import FILE
    from metrpo.world.registry import get_task

    config, run_dir = _run(command)
    begin(config, run_dir)
    collect = f"metrpo collect {shlex.quote(str(run_dir))}"
    how = collect if get_task(config.task).playable else f"metrpo.append_episode, or {collect} --data FILE"
    print(f"{run_dir / FILE} is the untrained policy; add episodes ({how}), then")
    print(f"metrpo improve {shlex.quote(str(run_dir))}")
    return 0


def _collect(command: Collect) -> int:
    from metrpo.run import machine

    machine.prepare(None, deterministic=False)
    from metrpo.console.progress import SILENT, default_progress
    from metrpo.external import collect

    with _attended(command.dir, SILENT if command.json else default_progress()) as progress:
        waiting = collect(command.dir, command.steps, command.data, progress, command.task)
    episodes, steps = len(waiting), sum(len(e.rewards) for e in waiting)
    mean = sum(float(e.rewards.sum()) for e in waiting) / max(episodes, 1)
    if command.json:
        print(json.dumps({"episodes": episodes, "steps": steps, "return": mean}))
        return 0
    wait = f"{counted(episodes, 'episode')} of {counted(steps, 'step')} {'waits' if episodes == 1 else 'wait'}"
    print(f"{wait}, mean return {mean:.1f}; next: metrpo improve {command.dir}")
    return 0


def _improve(command: Improve) -> int:
    from metrpo.run import machine
    from metrpo.run.directory import stored_config

    machine.prepare(None, stored_config(command.dir).deterministic)
    from metrpo.console.progress import SILENT, default_progress
    from metrpo.external import improve
    from metrpo.run.policy_file import FILE

    def complete(progress: Interruptible) -> str | None:
        done = f"{command.dir} has learned from the episodes that waited: nothing is lost, and nothing is left to do."
        return done if progress.ended else None

    with _attended(command.dir, SILENT if command.json else default_progress(), complete=complete) as progress:
        row = improve(command.dir, progress, command.task)
    print(_json(row) if command.json else f"  policy   {command.dir / FILE}")
    return 0


def _report(run_dir: Path, video: bool) -> None:
    """Says what the run has earned and where its files lie; a machine that cannot make a video costs the video only."""
    from metrpo.console.progress import outcome
    from metrpo.evaluation import render
    from metrpo.run.metrics import read_metrics
    from metrpo.run.video import VideoError

    last = read_metrics(run_dir / "metrics.csv")[-1]
    print(outcome(last, run_dir))
    files = {"curve": "curve.png", "metrics": "metrics.csv", "policy": "policy.npz"}
    for what, name in files.items():
        print(f"  {what:<8} {run_dir / name}", flush=True)
    if not video:
        return
    print(f"  {'video':<8} ", end="", flush=True)  # it takes a while
    try:
        print(_video_of(run_dir) or render(run_dir))
    except Exception as error:  # the run is complete without it
        print(f"none: {error}" if isinstance(error, VideoError) else f"none ({type(error).__name__}: {error})")


def _video_of(run_dir: Path) -> Path | None:
    """The run's video, if there is one of its policy as it is now."""
    from metrpo.run.policy_file import FILE

    video = run_dir / "video.mp4"
    with suppress(OSError):
        return video if video.stat().st_mtime_ns >= (run_dir / FILE).stat().st_mtime_ns else None
    return None


def _evaluate(command: Evaluate) -> int:
    from metrpo.evaluation import evaluate

    result = evaluate(command.dir, command.task, command.episodes, command.seed).summary()
    text = "{task}: return {mean:.2f} ± {std:.2f} (min {min:.2f}, max {max:.2f}) over {over}, seed {seed}"
    over = counted(result["episodes"], "episode")
    print(json.dumps(result) if command.json else text.format(**result, over=over))
    return 0


def _render(command: Render) -> int:
    from metrpo.evaluation import render

    print(render(command.dir, command.out, command.seed, command.task))
    return 0


def _export(command: Export) -> int:
    from metrpo.run.export import export

    print(export(command.dir, command.out))
    return 0


def _tasks(command: Tasks) -> int:
    from metrpo.world.registry import tasks
    from metrpo.world.tasks.gymnasium_formulas import KNOWN

    columns = ("name", "env_id", "state_size", "action_size", "horizon", "description")
    rows = [{column: getattr(task, column) for column in columns} for task in tasks().values()]
    if command.json:
        print(json.dumps(rows))
        return 0
    print(f"{'task':<17} {'states':>6} {'actions':>7} {'steps':>5}  description")
    for row in rows:
        print("{name:<17} {state_size:>6} {action_size:>7} {horizon:>5}  {description}".format(**row))
    print(f"\nalso with their formulas: {', '.join(KNOWN)}")
    print("and with a learned reward: any other Gymnasium id, module:name, path/to/file.py:name")
    return 0


def _doctor(command: Doctor) -> int:
    from metrpo.run import machine

    machine.set_variables(None, deterministic=False)  # what is wrong with them is what it looks for
    from metrpo.run.installation import diagnose

    found = diagnose()
    print(json.dumps(dataclasses.asdict(found)) if command.json else found.text())
    return 1 if found.problems else 0


def _bench(command: Bench) -> int:
    from metrpo.run import machine

    machine.prepare(None, deterministic=False)
    from metrpo.speed.measure import bench

    def tell(text: str) -> None:
        print(f"metrpo bench: {text}", file=sys.stderr, flush=True)

    report = bench(command.peers, command.rounds, command.iterations, tell)
    print(json.dumps(report.record(), indent=2) if command.json else report.text())
    return 0


def _reproduce(command: Reproduce) -> int:
    from metrpo.launch.dispatch import dispatch
    from metrpo.paper.figures import FIGURES, runs_of
    from metrpo.paper.publish import publish

    def tell(text: str) -> None:
        print(text, file=sys.stderr if command.json else sys.stdout, flush=True)

    runs = runs_of(command.figure, command.scale, command.tasks, command.seeds)
    out = command.out or Path("runs") / f"reproduce-{command.scale}"
    names = list(FIGURES) if command.figure == "all" else [command.figure]
    signal.signal(signal.SIGTERM, stop)
    failed = []
    try:
        if command.run:
            failed = dispatch(runs, out, command.means, tell)
    except (KeyboardInterrupt, Stopped):
        _say(f"metrpo: stopped; {out} keeps every finished iteration. The same command goes on.")
        raise
    numbers = publish(names, command.scale, command.tasks, runs, out, tell)
    if command.json:
        print(json.dumps(numbers))
    if failed:
        print(
            f"metrpo: {len(failed)} of {counted(len(runs), 'run')} failed; the same command tries again",
            file=sys.stderr,
        )
    return 1 if failed else 0


def _json(numbers: Mapping[str, float | None]) -> str:
    """As JSON, which knows no NaN."""
    return json.dumps({name: None if value is None or math.isnan(value) else value for name, value in numbers.items()})


def _sweep(command: Sweep) -> int:
    from metrpo.commands.sweep_typed import as_typed
    from metrpo.launch.dispatch import dispatch
    from metrpo.launch.grid import from_file

    runs = (as_typed(command) if command.spec is None else from_file(command.spec)).runs()
    print(f"{command.out}: {counted(len(runs), 'run')}", flush=True)
    if command.dry_run:
        for run in runs:
            print(f"{run.name}:  metrpo train {shlex.join(run.arguments)}")
        return 0
    signal.signal(signal.SIGTERM, stop)
    try:
        failed = dispatch(runs, command.out, command.means, lambda text: print(text, flush=True))
    except (KeyboardInterrupt, Stopped):
        _say(f"metrpo: stopped; {command.out} keeps every finished iteration. The same command goes on.")
        raise
    if failed:
        print(
            f"metrpo: {len(failed)} of {counted(len(runs), 'run')} failed; the same command tries again",
            file=sys.stderr,
        )
    return 1 if failed else 0


def _tune(command: Tune) -> int:
    from metrpo.commands.tune_typed import as_typed
    from metrpo.run.files import folder_name
    from metrpo.run.machine import cores
    from metrpo.tune.picture import draw
    from metrpo.tune.results import PICTURE, describe
    from metrpo.tune.search import from_file
    from metrpo.tune.trials import tune

    def tell(text: str) -> None:
        print(text, file=sys.stderr if command.json else sys.stdout, flush=True)

    search = as_typed(command) if command.spec is None else from_file(command.spec)
    out = command.out or Path("runs") / f"tune-{folder_name(search.task)}"
    tell(describe(search, out))
    if command.dry_run:
        return 0
    signal.signal(signal.SIGTERM, stop)
    try:
        found = tune(search, out, command.jobs or max(1, cores() // len(search.seeds)), tell)
    except (KeyboardInterrupt, Stopped):
        _say(f"metrpo: stopped; {out} keeps every finished iteration. The same command goes on.")
        raise
    picture = out / PICTURE if draw(found, out / PICTURE) else None
    if command.json:
        print(json.dumps({**found.record(), "out": str(out), "picture": picture and str(picture)}))
    else:
        found.print()
        print(picture or f"{out}: nothing to draw yet")
    if found.failed:
        logs = f"the ends of their logs stand in {out}"
        print(f"metrpo: {len(found.failed)} of {counted(len(found.records), 'trial')} failed; {logs}", file=sys.stderr)
    return 1 if found.failed else 0


def _report_page(command: Report) -> int:
    from metrpo.report.page import page, record
    from metrpo.run.files import atomic_write
    from metrpo.run.find import find

    found = find(command.dirs)
    atomic_write(command.out, page(found, command.out.parent))
    said = record(found)
    if command.json:
        print(json.dumps({"report": str(command.out), **said}))
        return 0
    for run in said["runs"]:
        for concern in run["warnings"]:
            if concern["level"] == "warning":
                print(f"{run['path']}: {concern['text']}")
    _tell_skipped(said["skipped"])
    print(command.out)
    return 0


def _plot(command: Plot) -> int:
    from metrpo.plots.learning_curves import plot
    from metrpo.run.find import find

    found = find(command.dirs)
    _tell_skipped([{"path": path, "why": why} for path, why in found.skipped])
    print(plot(found.runs, command.out, command.x, command.y))
    return 0


def _tell_skipped(skipped: Sequence[Mapping[str, Any]]) -> None:
    for one in skipped:
        _log.warning("left out %s: %s", one["path"], one["why"])


def _watch(command: Watch) -> int:
    from metrpo.console.watch import standings_of, watch
    from metrpo.run.find import find

    if command.json:
        found = find(command.dirs)
        runs = [dataclasses.asdict(run) for run in standings_of(found.runs)]
        skipped = [{"path": str(path), "why": why} for path, why in found.skipped]
        print(json.dumps({"runs": runs, "skipped": skipped}))
        return 0
    with suppress(KeyboardInterrupt):  # how to end it
        watch(command.dirs, command.every, command.once)
    return 0


def _version() -> int:
    from metrpo.run.files import metrpo_version

    print(f"metrpo {metrpo_version()}")
    return 0


_COMMANDS: dict[type, Callable[[Any], int]] = {
    Train: _train,
    Init: _init,
    Collect: _collect,
    Improve: _improve,
    Evaluate: _evaluate,
    Render: _render,
    Export: _export,
    Tasks: _tasks,
    Doctor: _doctor,
    Bench: _bench,
    Reproduce: _reproduce,
    Sweep: _sweep,
    Tune: _tune,
    Report: _report_page,
    Plot: _plot,
    Watch: _watch,
}
