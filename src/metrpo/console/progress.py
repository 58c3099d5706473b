"""Progress of a run: a live display on a terminal, plain lines elsewhere, or nothing."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

from metrpo.console.result_lines import Measured, heading, resuming, rounded, summary, time_left

if TYPE_CHECKING:
    from rich import progress as rich_progress
    from rich.console import Console

_log = logging.getLogger("metrpo")


class Progress:
    """The training loop reports to it. This one shows nothing; subclasses override what they show."""

    def say(self, text: str) -> None:
        """One line about the run."""

    def resume(self, where: str, iteration: int, of: int | None, real_steps: int, waiting: int = 0) -> None:
        """A run resumes: `iteration` of `of` comes next, after `real_steps` and `waiting` new ones."""
        self.say(resuming(where, iteration, of, real_steps, waiting))

    def begin(self, iteration: int, of: int | None) -> None:
        """Outer iteration `iteration` (from 1) of `of` (None: unknown) begins."""

    def stage(self, name: str, total: int | None = None) -> None:
        """A stage such as "fit" begins, with at most `total` units of work (None: unknown)."""

    def update(self, done: int, note: str = "") -> None:
        """`done` units of the stage are finished; `note` is a short remark, such as a loss."""

    def played(self) -> None:
        """One more real step has been played, within an episode; a place to stop."""

    def end(self, row: Measured, seconds_left: float | None = None) -> None:
        """The iteration is finished, with the metrics `row`; about `seconds_left` remain for the run."""

    def close(self) -> None:
        """The run ends, finished or not."""


SILENT = Progress()


class PlainProgress(Progress):
    """Lines of text for logs: one as a stage begins, one per finished iteration."""

    def __init__(self, out: TextIO | None = None) -> None:
        self._out = out or sys.stdout
        self._heading, self._began = "", time.monotonic()

    def say(self, text: str) -> None:
        """Prints it."""
        self._print(text)

    def begin(self, iteration: int, of: int | None) -> None:
        """Remembers the iteration; its stages name it."""
        self._heading, self._began = heading(iteration, of), time.monotonic()

    def stage(self, name: str, total: int | None = None) -> None:
        """Prints the stage's name."""
        self._print(f"{self._heading}  {time.monotonic() - self._began:6.1f} s  {name}")

    def end(self, row: Measured, seconds_left: float | None = None) -> None:
        """Prints the iteration's results."""
        self._print(f"{self._heading}  {summary(row)}{time_left(seconds_left)}")

    def _print(self, line: str) -> None:
        print(line, file=self._out, flush=True)


class LiveProgress(Progress):
    """The stage with its bar, last returns and time left, drawn in place; finished iterations stay above as lines."""

    def __init__(self, console: Console | None = None) -> None:
        from rich import progress as rich_progress  # slow to import, and needed on terminals only
        from rich.console import Console

        self._bars = rich_progress.Progress(
            rich_progress.SpinnerColumn(),
            rich_progress.TextColumn("[bold]{task.fields[heading]}"),
            rich_progress.TextColumn("{task.description:<9}"),
            rich_progress.BarColumn(bar_width=24),
            rich_progress.TaskProgressColumn(),
            rich_progress.TimeElapsedColumn(),
            rich_progress.TextColumn("[dim]{task.fields[note]}"),
            console=console or Console(),
            refresh_per_second=5,
        )
        self._heading, self._last = "", ""
        self._task: rich_progress.TaskID | None = None

    def say(self, text: str) -> None:
        """Prints it."""
        self._bars.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def begin(self, iteration: int, of: int | None) -> None:
        """Starts the display with the iteration's number."""
        self._heading = heading(iteration, of)
        self._bars.start()

    def stage(self, name: str, total: int | None = None) -> None:
        """Starts the stage's bar, which replaces the last stage's."""
        self._clear()
        self._task = self._bars.add_task(name, total=total, heading=self._heading, note=self._last)

    def update(self, done: int, note: str = "") -> None:
        """Moves the bar."""
        if self._task is not None:
            self._bars.update(self._task, completed=done, note=note or self._last)

    def end(self, row: Measured, seconds_left: float | None = None) -> None:
        """Leaves a line with the iteration's results above the bar."""
        self._clear()
        self._bars.console.print(f"[bold]{self._heading}[/]  {summary(row)}", highlight=False, soft_wrap=True)
        self._last = f"last return {rounded(row.get('return_real'))}{time_left(seconds_left)}"

    def close(self) -> None:
        """Takes the display down; lines of finished iterations stay."""
        self._clear()
        self._bars.stop()

    def _clear(self) -> None:
        if self._task is not None:
            self._bars.remove_task(self._task)
        self._task = None


class TolerantProgress(Progress):
    """Wraps another progress and falls silent once that fails: a closed pipe must not cost hours of training."""

    def __init__(self, shown: Progress) -> None:
        self._shown = shown

    def say(self, text: str) -> None:
        """Passed on."""
        self._pass_on(lambda shown: shown.say(text))

    def begin(self, iteration: int, of: int | None) -> None:
        """Passed on."""
        self._pass_on(lambda shown: shown.begin(iteration, of))

    def stage(self, name: str, total: int | None = None) -> None:
        """Passed on."""
        self._pass_on(lambda shown: shown.stage(name, total))

    def update(self, done: int, note: str = "") -> None:
        """Passed on."""
        self._pass_on(lambda shown: shown.update(done, note))

    def end(self, row: Measured, seconds_left: float | None = None) -> None:
        """Passed on."""
        self._pass_on(lambda shown: shown.end(row, seconds_left))

    def close(self) -> None:
        """Passed on."""
        self._pass_on(lambda shown: shown.close())

    def _pass_on(self, tell: Callable[[Progress], None]) -> None:
        shown = self._shown
        try:
            tell(shown)
        except Exception as error:
            self._shown = SILENT
            with contextlib.suppress(Exception):
                shown.close()
            _log.warning("progress is not shown any more (%s: %s); training continues", type(error).__name__, error)
            if isinstance(error, OSError):
                _mute(sys.stdout)  # the reader is gone, or the disk is full: later writes would fail too
            mute_broken_output()


def mute_broken_output() -> None:
    """Discards later output where stdout or stderr cannot be written, as in `metrpo train ... | head`."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            _mute(stream)


def _mute(stream: TextIO) -> None:
    with contextlib.suppress(OSError, ValueError):  # not a file, or closed
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def default_progress() -> Progress:
    """A live display on a terminal, plain lines elsewhere."""
    return LiveProgress() if sys.stdout is not None and sys.stdout.isatty() else PlainProgress()


def library_progress() -> Progress:
    """The progress of a program that trains: a live display in a terminal or a notebook, nothing elsewhere."""
    if _is_notebook():
        return TolerantProgress(LiveProgress() if importlib.util.find_spec("ipywidgets") else PlainProgress())
    return TolerantProgress(LiveProgress()) if sys.stdout is not None and sys.stdout.isatty() else SILENT


def _is_notebook() -> bool:
    """Whether this is Jupyter, Colab or the like, rather than IPython on a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ not in ("NoneType", "TerminalInteractiveShell")
