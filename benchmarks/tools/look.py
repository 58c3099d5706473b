"""Looks at every page of the built site at the width of a desk and of a phone: `make docs`, then

    python benchmarks/tools/look.py [--out build/looks] [PAGE.html...]

Takes a screenshot of each page at both widths and prints what does not fit: pages wider than the window, code and
tables that scroll sideways, figures shown at less than half of their size on a desk, broken pictures, dead links within
the site. The exit code is 1 for pages wider than the window, code or tables that scroll on a desk, broken pictures and
dead links.
Needs Chromium (Debian, Ubuntu: `apt install chromium`); it runs without a network.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))  # the tests' browser

from browser import Browser, chromium  # noqa: E402

DESK, PHONE = 1280, 390
_FOUND = """
(() => {
  const wide = (kind, boxes, text) => [...boxes].filter(e => e.scrollWidth > e.clientWidth + 1)
    .map(e => [kind, e.scrollWidth - e.clientWidth, text(e).trim().replace(/\\s+/g, " ").slice(0, 60)]);
  const longest = e => e.textContent.split("\\n").reduce((a, b) => a.length < b.length ? b : a);
  const pictures = [...document.querySelectorAll("article img")];
  return {
    found: [
      ...wide("code", document.querySelectorAll("pre > code"), longest),
      ...wide("table", document.querySelectorAll(".md-typeset__scrollwrap"), e => e.querySelector("tr").innerText),
      ...pictures.filter(i => i.complete && !i.naturalWidth).map(i => ["broken picture", 0, i.src]),
      ...pictures.filter(i => innerWidth > 640 && i.clientWidth < i.naturalWidth / 2)
        .map(i => ["small figure", i.clientWidth, i.src]),
    ],
    links: [...document.querySelectorAll("a[href]")].map(a => a.href),
    ids: [...document.querySelectorAll("[id]")].map(e => e.id),
  };
})()
"""


def main() -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", type=Path, nargs="*", help="default: all of site/")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "looks", help="folder of the screenshots")
    given = parser.parse_args()
    program = chromium()
    pages = [page.resolve() for page in given.pages] or sorted(
        (ROOT / "site").glob("[!4]*.html")
    )  # 404.html is for a server
    if program is None or not pages:
        parser.error(f"expected Chromium and a built site (make docs), found {program} and {len(pages)} pages")
    if missing := [str(page) for page in pages if not page.is_file()]:
        parser.error(f"expected pages such as site/index.html, found no {', '.join(missing)}")
    given.out.mkdir(parents=True, exist_ok=True)
    wrong, answers = 0, dict[Path, dict[str, Any]]()
    with Browser(program) as browser:
        for page, width in itertools.product(pages, (DESK, PHONE)):
            seen = browser.look(page, width, question=_FOUND)
            (given.out / f"{page.stem}-{width}.png").write_bytes(seen.shot)
            answers[page] = seen.answer
            rows = [["page", seen.width - width, ""]] if seen.width > width else []
            rows += seen.answer["found"]
            for kind, pixels, text in rows:
                print(f"{page.name:<24} {width:>5}  {kind:<15} {pixels:>5}  {text}")
                wrong += kind in ("page", "broken picture") or (kind in ("code", "table") and width == DESK)
    dead = [f"{page.name}: {link}" for page in pages for link in answers[page]["links"] if _dead(link, answers)]
    print(*(f"dead link in {link}" for link in dead), sep="\n", end="\n" if dead else "")
    print(f"{len(pages)} pages, {wrong + len(dead)} faults; screenshots in {given.out}")
    return 1 if wrong or dead else 0


def _dead(link: str, answers: dict[Path, dict[str, Any]]) -> bool:
    """Whether it leads to a file that is not there, or to a place that a page that was looked at does not have."""
    parts = urlsplit(link)
    if parts.scheme != "file":
        return False
    file = Path(unquote(parts.path))
    ids = answers[file]["ids"] if file in answers else [unquote(parts.fragment)]
    return not file.is_file() or bool(parts.fragment and unquote(parts.fragment) not in ids)


if __name__ == "__main__":
    sys.exit(main())
