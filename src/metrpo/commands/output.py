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
    """What prints a line at once: to stderr where stdout is for JSON."""
    return lambda text: print(text, file=sys.stderr if stdout_is_json else sys.stdout, flush=True)


def as_json(numbers: Mapping[str, float | None]) -> str:
    """As JSON, which knows no NaN."""
    return json.dumps({name: None if value is None or math.isnan(value) else value for name, value in numbers.items()})


def exit_code(failed: int, total: int, noun: str, advice: str) -> int:
    """1 where some of `total` runs or trials failed, which is said on stderr with `advice`; else 0."""
    if failed:
        print(f"metrpo: {failed} of {counted(total, noun)} failed; {advice}", file=sys.stderr)
    return 1 if failed else 0


def warn_of_skipped(skipped: Sequence[Mapping[str, Any]]) -> None:
    """Names each folder that is left out (path), and why."""
    for one in skipped:
        _log.warning("left out %s: %s", one["path"], one["why"])
