"""What a stopped command says: what is kept, and that the same command resumes."""

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


def say_how_to_resume(error: BaseException, arguments: Sequence[str]) -> None:
    """Prints the notes of what stopped the command `arguments`, and the command to type where it resumes."""
    for note in getattr(error, "__notes__", ()):
        command = f"\n\n  {shlex.join(['metrpo', *arguments])}\n" if "same command" in note else ""
        say(f"metrpo: stopped; {note}{command}")


def _keeps(folder: Path, what: str) -> str:
    return f"{folder} keeps {what}. The same command resumes."


@contextmanager
def attended_run(
    run_dir: Path,
    shown: Progress,
    keeps_episodes: bool = True,
    complete: Callable[[Interruptible], str | None] = lambda progress: None,
) -> Iterator[Interruptible]:
    """Reports on a run in this block. What stops the run there gets a note that says how to resume.

    `complete` returns the note for a signal that came too late to stop anything; else None.
    """
    with Interruptible(shown, keeps_episodes) as progress:
        try:
            yield progress
        except (Stopped, KeyboardInterrupt, MetrpoError) as error:
            # Other errors (a missing file, a policy that diverged) would come again.
            may_resume = isinstance(error, KeyboardInterrupt | EpisodeError | RunDirectoryError)
            if isinstance(error, Stopped | KeyboardInterrupt) and (note := complete(progress)):
                error.add_note(note)
            elif isinstance(error, Stopped) or (progress.began and may_resume):
                error.add_note(_keeps(run_dir, "every finished iteration and real episode"))
            raise
        finally:
            progress.close()


@contextmanager
def attended_runs(folder: Path) -> Iterator[None]:
    """Many runs under `folder` in this block. What stops them there gets a note that says how to resume."""
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except (KeyboardInterrupt, Stopped) as error:
        error.add_note(_keeps(folder, "every finished iteration"))
        raise
