"""Puts the tables of results into the pages: `python benchmarks/fill_tables.py`, after `metrpo reproduce`.

Between `<!-- NAME -->` and `<!-- end -->` of docs/reproduction.md goes `results/laptop/figures/NAME.md`. Elsewhere
the table under `<!-- runs: PATTERN ... -->` is what `summarise.py` makes of these folders of results/; those beside
published returns (`mbbl_table.py`, `long_table.py`), that of `drops.py` and the README's are made anew too.
"""

from __future__ import annotations

import re

import drops
import headline
import long_table
import mbbl_table
from summarise import ROOT, table

from metrpo.report.tables import markdown_row

PAGE, FIGURES = ROOT.parent / "docs" / "reproduction.md", ROOT / "laptop" / "figures"
PAGES = sorted((ROOT.parent / "docs").glob("*.md"))


def with_figures(page: str) -> str:
    """The page with every figure's table as it is on disk."""

    def figure(found: re.Match[str]) -> str:
        return f"{found[1]}\n{(FIGURES / f'{found[2]}.md').read_text().strip()}\n{found[3]}"

    return re.sub(r"(<!-- ([\w-]+) -->)\n.*?(<!-- end -->)", figure, page, flags=re.DOTALL)


def with_runs(page: str) -> str:
    """The page with its tables of runs made anew."""

    def runs(found: re.Match[str]) -> str:
        return found[1] + table([path for pattern in found[2].split() for path in ROOT.glob(pattern)])

    return re.sub(r"(<!-- runs: (.+) -->\n\n)(\|.*\n)+", runs, page)


def with_published(page: str) -> str:
    """The page with the tables beside published returns (MBBL, long episodes of Gymnasium) and of drops made anew."""
    for name, made in (("mbbl", mbbl_table.table), ("long", long_table.table), ("drops", drops.table)):
        page = re.sub(rf"(<!-- {name} -->\n).*?(<!-- end -->)", rf"\1{made()}\2", page, flags=re.DOTALL)
    return page


def with_headline(page: str) -> str:
    """The page with the table of `headline.py` made anew."""
    head = re.escape(f"{markdown_row(headline.HEADER)}\n")
    return re.sub(rf"{head}(\|.*\n)+", lambda _: headline.table(), page)


if __name__ == "__main__":
    README = ROOT.parent / "README.md"
    README.write_text(with_headline(README.read_text()))
    PAGE.write_text(with_figures(PAGE.read_text()))
    for path in PAGES:
        path.write_text(with_published(with_runs(path.read_text())))
