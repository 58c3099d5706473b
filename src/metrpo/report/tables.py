"""One table in the formats that people paste: Markdown, CSV, LaTeX (booktabs) and HTML."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Callable, Mapping, Sequence

from metrpo.errors import ConfigError

Rows = Sequence[Sequence[str]]
_TEX = {sign: f"\\{sign}" for sign in "&%$#_{}"} | {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"|": r"\textbar{}", "<": r"\textless{}", ">": r"\textgreater{}"},
}
_MARKDOWN = {"|": "\\|", "<": "&lt;"}


def written(kind: str, header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    """The table as text of a kind of `KINDS`, notes below it. Raises `ConfigError` for another kind."""
    if kind not in KINDS:
        raise ConfigError(f"out: expected a file name that ends in {', '.join('.' + k for k in KINDS)}, got .{kind}")
    return KINDS[kind](header, rows, notes)


def markdown(header: Sequence[str], rows: Rows, notes: Sequence[str] = ()) -> str:
    """A table for READMEs."""
    lines = [markdown_row(row) for row in (header, ["---"] * len(header), *rows)]
    return "\n".join([*lines, *(["", *notes] if notes else []), ""])


def markdown_row(cells: Sequence[str]) -> str:
    """A line of it."""
    return f"| {' | '.join(_escaped(cell, _MARKDOWN) for cell in cells)} |"


def _escaped(cell: str, signs: Mapping[str, str]) -> str:
    return "".join(signs.get(sign, sign) for sign in cell)


def html_table(header: Sequence[str], rows: Rows) -> str:
    """A table of cells that are HTML; the first cell of a row is its head."""
    head = "".join(f'<th scope="col">{cell}</th>' for cell in header)
    lines = [f'<tr><th scope="row">{row[0]}</th>{"".join(f"<td>{cell}</td>" for cell in row[1:])}</tr>' for row in rows]
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{chr(10).join(lines)}\n</tbody>\n</table>"


def _csv(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *rows])
    return out.getvalue()


def _latex(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join(_escaped(cell, _TEX) for cell in cells) + r" \\"

    columns = "ll" + "r" * (len(header) - 2)
    begin = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", line(header), r"\midrule"]
    comments = [f"% {note}" for note in notes]
    return "\n".join([*comments, *begin, *map(line, rows), r"\bottomrule", r"\end{tabular}", ""])


def _html(header: Sequence[str], rows: Rows, notes: Sequence[str]) -> str:
    head, *body = ([html.escape(cell) for cell in row] for row in (header, *rows))
    below = "\n".join(f"<p>{html.escape(note)}</p>" for note in notes)
    return f"{html_table(head, body)}\n{below}\n"


KINDS: dict[str, Callable[[Sequence[str], Rows, Sequence[str]], str]] = {
    "md": markdown,
    "csv": _csv,
    "tex": _latex,
    "html": _html,
}
"""Ending of a file -> what writes it."""
