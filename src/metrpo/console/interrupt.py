"""Ctrl-C and SIGTERM during a run: the first one lets it finish its step, the second stops it at once.

Neither loses anything on disk (see `metrpo.run.directory`); the first also saves what has been computed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from types import FrameType
from typing import Any, Self

from metrpo.console.progress import Progress, TolerantProgress
from metrpo.console.result_lines import Measured

PATIENCE = 5.0
"""Seconds that an episode has to end after a signal."""


class Stopped(BaseException):
    """A signal stopped the work."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


_PROCESS = os.getpid()
"""The process that the command runs in."""


def stop(number: int, frame: FrameType | None = None) -> None:
    """A signal handler that raises `Stopped` at once, only in the process of the command."""
    if not _inherited(number, _PROCESS):
        raise Stopped(number)


def _inherited(number: int, process: int) -> bool:
    """Whether this is a fork of `process`, which installed the handler. The signal ends a fork as usual.

    An environment with child processes ends them by signals, and waits for them.
    """
    if os.getpid() == process:
        return False
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    os.kill(os.getpid(), number)
    return True


class Interruptible(TolerantProgress):
    """Progress for a `with` block that ends the training loop with `Stopped` after a signal.

    The iteration under way is finished and saved first. While real episodes are played, each of which is saved as it
    ends (`keeps_episodes`), only the episode is finished, if it ends within `PATIENCE` seconds. A longer one is
    discarded, and the same command plays it anew. Between iterations, and at a second signal, the loop ends at once.
    """

    def __init__(self, shown: Progress, keeps_episodes: bool = True) -> None:
        super().__init__(shown)
        self._keeps_episodes = keeps_episodes
        self._asked: int | None = None
        self._asked_at = 0.0
        self._stage: str | None = None
        """The stage that stopping now would lose; None: nothing."""
        self._before: dict[int, Any] = {}
        self._process = os.getpid()
        self.began = False
        """Whether an iteration has begun."""
        self.ended = False
        """Whether the last iteration that began is saved."""

    def __enter__(self) -> Self:
        self._process = os.getpid()
        for number in (signal.SIGINT, signal.SIGTERM):
            # A shell makes background commands ignore Ctrl-C: leave that as it is.
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
        text = f"\nmetrpo: stopping after this {step}; press again to stop at once and lose only this {step}\n"
        with contextlib.suppress(OSError):
            os.write(2, text.encode())  # the signal may have interrupted print

    def begin(self, iteration: int, of: int | None) -> None:
        """An iteration begins; from its first stage on, stopping loses work."""
        self.began, self.ended = True, False
        super().begin(iteration, of)

    def stage(self, name: str, total: int | None = None) -> None:
        """A stage begins. Between collecting and learning, everything is on disk: a place to stop."""
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
        """A step is played. An episode that takes too long is discarded, so that nobody waits for hours."""
        if self._asked is not None and self._collecting() and time.monotonic() - self._asked_at > PATIENCE:
            self._stop_if_asked()

    def end(self, row: Measured, seconds_left: float | None = None) -> None:
        """The iteration is saved."""
        super().end(row, seconds_left)
        self._stage, self.ended = None, True
        self._stop_if_asked()

    def close(self) -> None:
        """The run ends; no stage is under way."""
        super().close()
        self._stage = None

    def _collecting(self) -> bool:
        return self._keeps_episodes and self._stage == "collect"

    def _stop_if_asked(self) -> None:
        if self._asked is not None:
            self._stage = None
            raise Stopped(self._asked)
