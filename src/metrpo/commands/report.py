"""`metrpo report` writes an HTML page about some runs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.options import Switch, require_directories
from metrpo.commands.output import warn_of_skipped


@dataclass(frozen=True)
class Report:
    """Write one HTML page about runs: health warnings in plain words, learning curves, diagnostics, videos.

    The page works offline, on a phone too. For example:
        metrpo report runs/Swimmer-fast-seed0
        metrpo report runs/sweep --out sweep.html
        metrpo report runs --json
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN_OR_FOLDER...")]
    """Run directories, or folders with runs inside."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("report.html")
    """File to write; missing folders are created."""
    json: Switch = False
    """Write the page and print its contents as JSON."""

    def __post_init__(self) -> None:
        require_directories("report", self.dirs)


def run(command: Report) -> int:
    """Returns the exit code."""
    from metrpo.report.page import page, record
    from metrpo.run.files import atomic_write
    from metrpo.run.find import find

    found = find(command.dirs)
    atomic_write(command.out, page(found, command.out.parent))
    contents = record(found)
    if command.json:
        print(json.dumps({"report": str(command.out), **contents}))
        return 0
    for run in contents["runs"]:
        for concern in run["warnings"]:
            if concern["level"] == "warning":
                print(f"{run['path']}: {concern['text']}")
    warn_of_skipped(contents["skipped"])
    print(command.out)
    return 0
