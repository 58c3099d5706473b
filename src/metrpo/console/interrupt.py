"""Ctrl-C and SIGTERM while a run goes on: the first lets it finish its step, the second breaks it off.

Neither loses anything that is on disk (see `metrpo.run.directory`); the first saves what has been computed as well.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from types import FrameType
from typing import Any, Self

from metrpo.console.progress import Measured, Progress, TolerantProgress

PATIENCE = 5.0
"""Seconds that an episode has to end in when a signal asks to stop."""


class Stopped(BaseException):
    """A signal has stopped the work."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


_PROCESS = os.getpid()
"""The process that the command runs in."""


def stop(number: int, frame: FrameType | None = None) -> None:
    """A signal handler that stops at once, by raising `Stopped`, in the process of the command only."""
    if not _inherited(number, _PROCESS):
        raise Stopped(number)


def _inherited(number: int, process: int) -> bool:
    """Whether this is not `process`, which installed the handler, but a fork of it: there the signal ends it as usual.

    An environment that runs in children of ours ends them so, and waits for them.
    """
    if os.getpid() == process:
        return False
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    os.kill(os.getpid(), number)
    return True


class Interruptible(TolerantProgress):
    """Progress that the loop reports to within a `with` block, and that ends the loop by `Stopped` once asked to.

    An iteration that has begun is finished and saved first. While real episodes are played, of which each is saved as
    it ends (`keeps_episodes`), only the episode is, if it ends within `PATIENCE` seconds: a longer one is given up, and
    the same command plays it anew. Before and after, and when asked once more, it ends at once.
    """

    def __init__(self, shown: Progress, keeps_episodes: bool = True) -> None:
        super().__init__(shown)
        self._keeps_episodes = keeps_episodes
        self._asked: int | None = None
        self._asked_at = 0.0
        self._stage: str | None = None
        """What would be lost by stopping now; None: nothing."""
        self._before: dict[int, Any] = {}
        self._process = os.getpid()
        self.began = False
        """Whether an iteration has begun."""
        self.ended = False
        """Whether the last one that began is saved."""

    def __enter__(self) -> Self:
        self._process = os.getpid()
        for number in (signal.SIGINT, signal.SIGTERM):
            # A shell lets what it starts in the background ignore Ctrl-C: it stays so.
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if _inherited(number, self._process):
            return
        if self._stage is None or self._asked is not None:
            raise Stopped(number)
        self._asked, self._asked_at = number, time.monotonic()
        step = "episode" if self._collecting() else "iteration"
        text = f"\nmetrpo: stopping after this {step}; once more stops at once, and loses this {step} only\n"
        with contextlib.suppress(OSError):
            os.write(2, text.encode())  # print may be what the signal has interrupted

    def begin(self, iteration: int, of: int | None) -> None:
        """From the first stage on something is under way."""
        self.began, self.ended = True, False
        super().begin(iteration, of)

    def stage(self, name: str, total: int | None = None) -> None:
        """Between collecting and learning nothing is that is not on disk."""
        if self._collecting():
            self._stop_if_asked()
        self._stage = name
        super().stage(name, total)

    def update(self, done: int, note: str = "") -> None:
        """An episode is saved when it is reported."""
        super().update(done, note)
        if self._collecting():
            self._stop_if_asked()

    def played(self) -> None:
        """An episode that takes too long is given up: nobody waits for hours."""
        if self._asked is not None and self._collecting() and time.monotonic() - self._asked_at > PATIENCE:
            self._stop_if_asked()

    def end(self, row: Measured, seconds_left: float | None = None) -> None:
        """The iteration is saved."""
        super().end(row, seconds_left)
        self._stage, self.ended = None, True
        self._stop_if_asked()

    def close(self) -> None:
        """Nothing is under way any more."""
        super().close()
        self._stage = None

    def _collecting(self) -> bool:
        return self._keeps_episodes and self._stage == "collect"

    def _stop_if_asked(self) -> None:
        if self._asked is not None:
            self._stage = None
            raise Stopped(self._asked)
