"""`metrpo train` learns a task, or resumes a run."""

from __future__ import annotations

import dataclasses
import logging
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from metrpo.commands.attend import attended_run
from metrpo.commands.options import RunOptions, Switch, warn_of_unread
from metrpo.config import Config
from metrpo.console.interrupt import Interruptible
from metrpo.errors import MetrpoError
from metrpo.trackers import TrackerName, trackers

_log = logging.getLogger("metrpo")
_AGAIN = "The same command would only write the files that are missing, such as the video."


@dataclass(frozen=True)
class Train(RunOptions):
    """Learn a task, or resume a run: the same command does both.

    For example:
        metrpo train Swimmer
        metrpo train HalfCheetah --seed 1 --real-steps 60000 --run-dir runs/cheetah
        metrpo train Pendulum-v1 --ensemble.members 10 --trpo.max-kl 0.02

    Defaults depend on the task. Those below are Swimmer's, unless you name another: metrpo train HalfCheetah-v5 --help.
    metrpo train --help-all lists every setting.
    """

    track: tuple[TrackerName, ...] = ()
    """Log to these trackers too (each is an extra: pip install 'metrpo[wandb]'); training survives one that fails."""
    video: Annotated[Switch, arg(help="Do not record the final policy as a video.")] = True


def run(command: Train) -> int:
    """Returns the exit code."""
    from metrpo.console.progress import default_progress
    from metrpo.training import train

    config, run_dir = command.config, command.directory
    warn_of_unread(config)

    def complete(progress: Interruptible) -> str | None:
        return f"{run_dir} is complete: nothing is lost. {_AGAIN}" if _is_complete(run_dir, config) else None

    by_episode = config.method == "model-based"
    with attended_run(run_dir, default_progress(), keeps_episodes=by_episode, complete=complete) as progress:
        train(config, run_dir, progress, trackers(command.track))
        progress.close()
        try:
            say_outcome(run_dir, command.video)
        except OSError as error:  # nobody reads on; the run is complete
            _log.warning("cannot print the outcome (%s: %s); %s is complete", type(error).__name__, error, run_dir)
    return 0


def _is_complete(run_dir: Path, config: Config) -> bool:
    """Whether all iterations that were asked for are on disk."""
    from metrpo.run.find import is_finished, read

    with suppress(MetrpoError):
        return is_finished(dataclasses.replace(read(run_dir), config=config))
    return False


def say_outcome(run_dir: Path, video: bool) -> None:
    """Prints the run's return and its files. Where no video can be made, prints why."""
    from metrpo.console.result_lines import outcome
    from metrpo.evaluation import render
    from metrpo.run.metrics import read_metrics
    from metrpo.run.video import VideoError

    last = read_metrics(run_dir / "metrics.csv")[-1]
    print(outcome(last, run_dir))
    files = {"curve": "curve.png", "metrics": "metrics.csv", "policy": "policy.npz"}
    for what, name in files.items():
        print(f"  {what:<8} {run_dir / name}", flush=True)
    if better := _better_before(run_dir, last["iteration"]):
        print(f"  {'best':<8} {better}", flush=True)
    if not video:
        return
    print(f"  {'video':<8} ", end="", flush=True)  # it takes a while
    try:
        print(_video_of(run_dir) or render(run_dir))
    except Exception as error:  # the run is complete without it
        said = f": {error}" if isinstance(error, VideoError) else f" ({type(error).__name__}: {error})"
        print(f"none{said}; --no-video makes none")


def _better_before(run_dir: Path, iteration: int | float | None) -> str | None:
    """The policy whose evaluation earned most, and how much; None where it is that of the last `iteration`."""
    from metrpo.console.result_lines import rounded
    from metrpo.run.files import BEST
    from metrpo.run.policy_file import FILE, load_policy

    file = run_dir / BEST / FILE
    if not file.exists():  # an older run, or a task that nobody can evaluate
        return None
    try:
        best = load_policy(file).info
    except MetrpoError as error:
        _log.warning("%s", error)
        return None
    if best.iteration == iteration:
        return None
    return f"{file} (return {rounded(best.return_real)} after {best.real_steps:,} real steps)"


def _video_of(run_dir: Path) -> Path | None:
    """The run's video if it shows the present policy. (The policy's file is written anew at every start.)"""
    video = run_dir / "video.mp4"
    with suppress(OSError):
        learned = max((path.stat().st_mtime_ns for path in (run_dir / "checkpoints").iterdir()), default=math.inf)
        return video if video.stat().st_mtime_ns >= learned else None
    return None
