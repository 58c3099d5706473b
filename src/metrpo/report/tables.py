"""One table in the formats that people paste: Markdown, CSV, LaTeX (booktabs) and HTML."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Callable, Sequence

from metrpo.errors import ConfigError

Rows = Sequence[Sequence[str]]
_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {
    sign: f"\\{sign}" for sign in "&%$#_{}"
}


def written(kind: str, header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    """The table as text of a kind of `KINDS`, notes below it. Raises `ConfigError` for another kind."""
    if kind not in KINDS:
        raise ConfigError(f"out: expected a file name that ends in {', '.join('.' + k for k in KINDS)}, got .{kind}")
    return KINDS[kind](header, rows, notes)


def markdown(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    """A table for READMEs."""
    cells = [[cell.replace("|", "\\|") for cell in row] for row in (header, ["---"] * len(header), *rows)]
    return "\n".join([*(f"| {' | '.join(row)} |" for row in cells), "", *notes, ""])


def _csv(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *rows])
    return out.getvalue()


def _latex(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join("".join(_TEX.get(sign, sign) for sign in cell) for cell in cells) + r" \\"

    columns = "ll" + "r" * (len(header) - 2)
    begin = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", line(header), r"\midrule"]
    comments = [f"% {note}" for note in notes]
    return "\n".join([*comments, *begin, *map(line, rows), r"\bottomrule", r"\end{tabular}", ""])


def _html(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "\n".join(line(row, "td") for row in rows)
    below = "\n".join(f"<p>{html.escape(note)}</p>" for note in notes)
    return f"<table>\n<thead>{line(header, 'th')}</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n{below}\n"


KINDS: dict[str, Callable[[Sequence[str], Rows, Sequence[str]], str]] = {
    "md": markdown,
    "csv": _csv,
    "tex": _latex,
    "html": _html,
}
"""Ending of a file -> what writes it."""
