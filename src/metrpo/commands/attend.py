"""How a command ends that is stopped: it says what is kept, and that the same command goes on."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from metrpo.console.interrupt import Interruptible, Stopped, stop
from metrpo.console.progress import Progress
from metrpo.errors import EpisodeError, MetrpoError, RunDirectoryError


def say(text: str) -> None:
    """Prints a line to stderr."""
    with suppress(OSError):  # stderr may be gone, which is no reason to end otherwise
        print(text, file=sys.stderr)


def say_how_to_go_on(error: BaseException, arguments: Sequence[str]) -> None:
    """Prints the notes of what has stopped the command `arguments`, and the command where it goes on."""
    for note in getattr(error, "__notes__", ()):
        command = f"\n\n  {shlex.join(['metrpo', *arguments])}\n" if "same command" in note else ""
        say(f"metrpo: stopped; {note}{command}")


def _keeps(folder: Path, what: str) -> str:
    return f"{folder} keeps {what}. The same command goes on."


@contextmanager
def attended_run(
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
                error.add_note(_keeps(run_dir, "every finished iteration and real episode"))
            raise
        finally:
            progress.close()


@contextmanager
def attended_runs(folder: Path) -> Iterator[None]:
    """Many runs under `folder` in this block: whoever or whatever stops them there is told how to go on."""
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except (KeyboardInterrupt, Stopped) as error:
        error.add_note(_keeps(folder, "every finished iteration"))
        raise
