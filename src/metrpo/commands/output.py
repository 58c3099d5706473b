"""What several commands print in the same way."""

from __future__ import annotations

import json
import logging
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from metrpo.counting import counted

_log = logging.getLogger("metrpo")


def printer(stdout_is_json: bool = False) -> Callable[[str], None]:
    """A function that prints a line at once: to stderr where stdout is for JSON."""
    return lambda text: print(text, file=sys.stderr if stdout_is_json else sys.stdout, flush=True)


def as_json(numbers: Mapping[str, float | None]) -> str:
    """As JSON, with null for NaN."""
    return json.dumps({name: None if value is None or math.isnan(value) else value for name, value in numbers.items()})


def exit_code(failed: int, total: int, noun: str, advice: str) -> int:
    """1 if some of `total` runs or trials failed, else 0. Failures are reported on stderr, with `advice`."""
    if failed:
        print(f"metrpo: {failed} of {counted(total, noun)} failed; {advice}", file=sys.stderr)
    return 1 if failed else 0


def warn_of_skipped(skipped: Sequence[Mapping[str, Any]]) -> None:
    """Warns of each folder that is skipped (path), and says why."""
    for one in skipped:
        _log.warning("skipped %s: %s", one["path"], one["why"])
