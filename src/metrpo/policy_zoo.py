"""Trained policies that come with the package, each with its card: `zoo:Snake` stands wherever a run directory may.

They lie in `zoo_policies/`, as a run leaves its policy; `benchmarks/tools/fill_zoo.py` chooses them among the runs in
`results/`. Needs the standard library only.
"""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import Any

from metrpo.errors import RunDirectoryError
from metrpo.hub import downloaded, is_on_hub

FOLDER = Path(__file__).with_name("zoo_policies")
_PREFIX, CARD = "zoo:", "card.json"


def names() -> list[str]:
    """The policies there are, in the order of the alphabet."""
    return sorted((path.parent.name for path in FOLDER.glob(f"*/{CARD}")), key=str.lower)


def is_in_zoo(place: str | Path) -> bool:
    """Whether a place is meant that begins with "zoo:"."""
    return str(place).startswith(_PREFIX)


def is_name(place: str | Path) -> bool:
    """Whether a place is a policy's name, `zoo:NAME` or `hub:OWNER/NAME`, so that nothing may be written beside it."""
    return is_in_zoo(place) or is_on_hub(place)


def located(place: str | Path) -> Path:
    """The folder of `zoo:NAME` (case does not matter, "/" is "-"), or to which `hub:OWNER/NAME` has been downloaded; of
    any other place the place itself.

    Raises `RunDirectoryError` when there is no such policy, `MetrpoError` for one on the hub without the extra.
    """
    if is_on_hub(place):
        return downloaded(place)
    if not is_in_zoo(place):
        return Path(place)
    asked = str(place).removeprefix(_PREFIX)
    wanted = asked.replace("/", "-").replace("\\", "-").lower()
    known = {name.lower(): name for name in names()}
    if wanted in known:
        return FOLDER / known[wanted]
    near = [known[name] for name in difflib.get_close_matches(wanted, known, 2)]
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    raise RunDirectoryError(f"zoo:{asked}: {hint}metrpo zoo lists the {len(known)} policies that there are")


def card(name: str) -> dict[str, Any]:
    """What is known of a policy: task, return, real steps, where it comes from, its learning curve.

    Raises `RunDirectoryError` as `located`.
    """
    found: dict[str, Any] = json.loads((located(f"{_PREFIX}{name}") / CARD).read_text("utf-8"))
    return {"name": name, **found}
