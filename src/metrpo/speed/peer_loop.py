"""The loop of a peer process: one JSON line in, one out. Imports nothing but the standard library.

The worker scripts run in an environment where metrpo is not installed, and find this file beside them.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping

Repetition = Callable[[], float]
"""Does the work once and returns the seconds that it took."""


def serve(work: Mapping[str, Callable[[], Repetition]]) -> None:
    """Answers requests {"work": name, "repeat": n} with {"seconds": [n]} or {"error": text} until stdin closes.

    `work` builds what a name needs; it is called at the name's first request, followed by one unmeasured repetition.
    """
    # What a library prints must not come between the answers: file descriptor 1 becomes stderr.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    built: dict[str, Repetition] = {}
    with answers:
        for line in sys.stdin:
            try:
                answer: dict[str, object] = {"seconds": _measure(work, built, **json.loads(line))}
            except Exception as error:  # the caller shall hear of any
                answer = {"error": f"{type(error).__name__}: {error}"}
            print(json.dumps(answer), file=answers, flush=True)


def _measure(
    available: Mapping[str, Callable[[], Repetition]], built: dict[str, Repetition], work: str, repeat: int
) -> list[float]:
    if work not in available:
        raise ValueError(f"expected one of {', '.join(available)}, got {work}")
    if work not in built:
        repetition = available[work]()
        repetition()
        built[work] = repetition
    return [built[work]() for _ in range(repeat)]


def timed(function: Callable[[], object], times: int = 1) -> float:
    """Seconds of wall-clock per call, over `times` calls."""
    start = time.perf_counter()
    for _ in range(times):
        function()
    return (time.perf_counter() - start) / times
