"""The report's first table: each group of seeds with its mean return, beside the returns without skill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from metrpo.comparison import HEADER, Compared, cells, compare, has_returns, notes
from metrpo.report.tables import html_table
from metrpo.run.find import SeenRun


def compared(runs: Sequence[SeenRun]) -> list[Compared]:
    """The groups of several runs, as `metrpo compare` has them; none for a single run, or where no run has a return."""
    return compare(runs) if len(runs) > 1 and any(map(has_returns, runs)) else []


def group_section(groups: Sequence[Compared], colours: Mapping[tuple[str, str], str]) -> str:
    """The section as HTML; `colours` are the groups' styles, by task and label. Empty for no group."""
    if not groups:
        return ""
    several = len({one.task for one in groups}) > 1
    rows = []
    for one in groups:
        task, label, *numbers = map(escape, cells(one))
        swatch = f'<i class="swatch {colours[one.task, one.label]}"></i>'
        rows.append([f"{swatch}{f'{task}, ' if several else ''}{label}", *numbers])
    table = html_table(["group", *HEADER[2:]], rows)
    return (
        f'<section id="groups"><h2>Groups</h2><div class="scroll">{table}</div>'
        f"<p class=small>{escape(' '.join(notes(groups)))}</p></section>"
    )
