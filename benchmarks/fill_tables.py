"""Puts the figures' tables into docs/reproduction.md: `python benchmarks/fill_tables.py`, after `metrpo reproduce`.

Between `<!-- NAME -->` and `<!-- end -->` goes `results/laptop/figures/NAME.md`.
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE, FIGURES = ROOT / "docs" / "reproduction.md", ROOT / "results" / "laptop" / "figures"


def filled(page: str) -> str:
    """The page with every table as it is on disk."""

    def table(found: re.Match[str]) -> str:
        return f"{found[1]}\n{(FIGURES / f'{found[2]}.md').read_text().strip()}\n{found[3]}"

    return re.sub(r"(<!-- ([\w-]+) -->)\n.*?(<!-- end -->)", table, page, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
