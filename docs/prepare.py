"""Prepares the documentation for the site generator: `python docs/prepare.py` writes `build/docs` (see `make docs`).

The pages are read on a code host as they are, with links from `docs/` into the whole tree. A site holds `docs/` alone,
so here every such link is checked and given a place in the site. And three comments are filled in:

    <!-- from README.md: The loop -->     a section of a file of the tree (without a name: all of it)
    <!-- commands -->                     every command's --help, from the parser itself
    <!-- settings -->                     a table for each group of settings, from their definitions

Nothing here knows the generator: it finds plain Markdown, and whatever is wrong has been said before, with its line.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import io
import itertools
import os
import re
import shutil
import sys
import textwrap
import typing
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
ELSEWHERE = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
"""Pages whose text lives outside of docs/, and where the site shows them."""
IMAGES = {".png", ".svg", ".gif", ".jpg"}
WIDTH = 80
"""Of the commands' help, in characters: what fits beside the navigation."""
_FENCE = re.compile(r"^( *)(```+).*?^\1\2 *$\n?", re.DOTALL | re.MULTILINE)
_CODE_OR_LINK = re.compile(r"(`+)(?!`)(?:(?!\n\n).)*?\1(?!`)|\[((?:`[^`]*`|[^\[\]`])*)\]\(([^()\s]+)\)", re.DOTALL)
_PICTURE = re.compile(r"!\[[^\]]*\]\(([^)\s]+\.(?:png|svg))\)")
_INCLUDE = re.compile(r"^<!-- from ([\w./-]+)(?:: (.+?))? -->$", re.MULTILINE)


class Links(NamedTuple):
    """What the links of all pages lead to."""

    problems: list[str]
    external: set[str]
    images: set[Path]
    """Outside of docs/; the site needs a copy."""


def pages() -> list[Path]:
    """Every page of the site, and the files that some take their text from."""
    return [*sorted(DOCS.glob("*.md")), *(ROOT / name for name in ELSEWHERE)]


def rendered(page: Path, links: Links, repository: str = "") -> str:
    """The page's text with links as the site has them; what is wrong with them goes to `links`.

    Links to files that are no pages lead to `repository`; without one, their text stays and the link goes.
    """
    text, parts, done = page.read_text(), [], 0
    for fence in [*_FENCE.finditer(text), None]:
        end = len(text) if fence is None else fence.start()

        def link(found: re.Match[str], start: int = done) -> str:
            if found[3] is None:
                return found[0]
            where = f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, start + found.start()) + 1}"
            target = _target(page, found[3], where, links, repository)
            return found[2] if target is None else f"[{found[2]}]({target})"

        parts += [_CODE_OR_LINK.sub(link, text[done:end]), "" if fence is None else fence[0]]
        done = end if fence is None else fence.end()
    return "".join(parts)


def _target(page: Path, raw: str, where: str, links: Links, repository: str) -> str | None:
    """Where the link leads in the site; None when the file has no place there."""
    if urlsplit(raw).scheme:
        if urlsplit(raw).scheme != "https" or "." not in urlsplit(raw).netloc:
            links.problems.append(f"{where}: expected https://HOST/..., got {raw}")
        links.external.add(raw)
        return raw
    path, hash_sign, anchor = raw.partition("#")
    file = (page.parent / path).resolve() if path else page
    if not file.exists() or not file.is_relative_to(ROOT):
        links.problems.append(f"{where}: expected a file of the tree, got {raw}")
        return raw
    if anchor and anchor not in anchors(file):
        links.problems.append(f"{where}: {file.name} has no heading #{anchor}")
    name = str(file.relative_to(ROOT))
    if not path:
        return raw
    if file.is_relative_to(DOCS):
        return f"{file.relative_to(DOCS)}{hash_sign}{anchor}"
    if name in ELSEWHERE:
        return f"{ELSEWHERE[name]}{hash_sign}{anchor}"
    if file.suffix in IMAGES:
        links.images.add(file)
        return f"tree/{name}"
    return f"{repository}/{'tree' if file.is_dir() else 'blob'}/main/{name}" if repository else None


def anchors(page: Path) -> set[str]:
    """The names that the page's headings have in links."""
    if page.suffix != ".md":
        return set()
    headings = re.findall(r"^#+ +(.+?)\s*$", _FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def section(text: str, name: str | None) -> str | None:
    """What stands between the heading `name` and the next one; all of `text` without a name; None: not there."""
    if name is None:
        return text
    outside = _FENCE.sub(lambda fence: re.sub(r"\S", "x", fence[0]), text)  # where no comment looks like a heading
    found = re.search(rf"^#+ {re.escape(name)}$\n", outside, re.MULTILINE)
    if found is None:
        return None
    end = re.compile(r"^#+ ", re.MULTILINE).search(outside, found.end())
    return text[found.end() : end.start() if end else None].strip() + "\n"


def with_includes(page: Path, text: str, links: Links, repository: str = "") -> str:
    """The text with other files' sections in the place of the comments that ask for them."""

    def include(found: re.Match[str]) -> str:
        file = ROOT / found[1]
        part = section(rendered(file, links, repository), found[2]) if file.is_file() else None
        if part is None:
            links.problems.append(f"{page.relative_to(ROOT)}: expected a section of the tree's files, got {found[0]}")
        return part or ""

    return _INCLUDE.sub(include, text)


def with_full_size(text: str) -> str:
    """The text with figures that lead to themselves, for in a column, or on a phone, some are small."""
    return _PICTURE.sub(r"[\g<0>](\1)", text)


def check() -> Links:
    """All links of all pages, followed: those to other hosts are looked at and not asked for."""
    links = Links([], set(), set())
    for page in pages():
        with_includes(page, rendered(page, links), links)
    return links._replace(problems=list(dict.fromkeys(links.problems)))  # what is included is met more than once


def commands() -> str:
    """All commands in short, and a section for each: what --help-all prints, without its boxes, sentences folded."""
    from metrpo.commands.command_table import NAMES
    from metrpo.commands.help import overview
    from metrpo.commands.parse import parse

    sections = (_command(name, _help(parse, name)) for name in NAMES)
    return "\n".join([f"```text\n{overview()}\n```\n", *sections])


def _help(parse: typing.Callable[[list[str]], object], name: str) -> str:
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # it draws other boxes where it may not write these
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(WIDTH)
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            parse([name, "--help-all"])
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    printed.seek(0)
    text = re.sub(r"^╭─ (.*?) ─*╮$", r"\1:", printed.read(), flags=re.MULTILINE)
    text = re.sub(r"^╰─*╯$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^│(.*?) *│$", r" \1", text, flags=re.MULTILINE).strip()
    return "\n".join(
        textwrap.fill(line, WIDTH, break_on_hyphens=False) if line[:1].strip() else line for line in text.splitlines()
    )


def _command(name: str, text: str) -> str:
    """The options of a long help are folded in."""
    text, colon, options = text.partition("\npositional arguments:") if text.count("\n") > 100 else (text, "", "")
    shown = f"## metrpo {name}\n\n```text\n{text.strip()}\n```\n"
    if not options:
        return shown
    folded = "\n".join(f"    {line}".rstrip() for line in f"```text{colon}{options}\n```".splitlines())
    return f'{shown}\n??? note "Every option"\n\n{folded}\n'


def settings() -> str:
    """A table for each group of settings: what each one is, and its value in the presets.

    A preset's cell is empty where it has the default. What presets set for single tasks stands in a last table.
    """
    from metrpo import config, presets
    from metrpo.report.tables import markdown

    chosen = {"fast": presets.FAST_ALL, "long-horizon": presets.FAST_ALL | presets.LONG_HORIZON_ALL}
    groups = [field for field in dataclasses.fields(config.Config) if field.default_factory is not dataclasses.MISSING]
    tables = [_settings_table("The run", "", config.Config, chosen)]
    tables += [_settings_table(f"`{group.name}`", f"{group.name}.", group.default_factory, chosen) for group in groups]
    own = (("paper", presets.PAPER), ("fast", presets.FAST))
    rows = [
        (task, name, ", ".join(f"`{setting}` {_shown(value)}" for setting, value in row.items()))
        for name, table in own
        for task, row in table.items()
    ]
    tables.append("## Single tasks\n\n" + markdown(("task", "preset", "has"), rows))
    return "\n".join(tables)


def _settings_table(title: str, prefix: str, group: type, presets: dict[str, dict[str, object]]) -> str:
    from metrpo.report.tables import markdown

    rows, texts = [], _field_texts(group)
    for field in dataclasses.fields(group):
        if field.default_factory is dataclasses.MISSING:
            name, default = prefix + field.name, field.default
            shown = "required" if default is dataclasses.MISSING else _shown(default)
            values = [preset.get(name, default) for preset in presets.values()]
            cells = ("" if value == default else _shown(value) for value in values)
            rows.append((f"`{name}`", shown, *cells, texts[field.name]))
    table = markdown(("setting", "default", *presets, "what it is"), rows)
    return f'## {title}\n\n{group.__doc__}\n\n<div class="settings" markdown>\n\n{table}\n</div>\n'  # see site.css


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return "-".join(map(str, value)) or "none"
    if isinstance(value, float) and len(str(value)) > 8:  # 1/3
        return f"{value:.4f}"
    return "none" if value is None else {"True": "yes", "False": "no"}.get(str(value), str(value))


def _field_texts(group: type) -> dict[str, str]:
    """What stands below each field in the source, on one line."""
    body = ast.parse(textwrap.dedent(inspect.getsource(group))).body[0].body
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def main() -> int:
    """Writes build/docs, or says what is wrong with the pages and returns 1."""
    found = re.search(r"^  repository: *(\S+)", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    repository = found[1].rstrip("/") if found else ""
    out, links = ROOT / "build" / "docs", Links([], set(), set())
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(DOCS, out, ignore=shutil.ignore_patterns("*.md", "*.py", "__pycache__"))
    for page in sorted(DOCS.glob("*.md")):
        text = with_includes(page, rendered(page, links, repository), links, repository)
        for made in (commands, settings):
            text = re.sub(rf"^<!-- {made.__name__} -->$", lambda _, made=made: made(), text, flags=re.MULTILINE)
        (out / page.name).write_text(with_full_size(text))
    for image in links.images:
        copy = out / "tree" / image.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(image, copy)
    links.problems.extend(check().problems)
    print("\n".join(dict.fromkeys(links.problems)), file=sys.stderr, end="\n" if links.problems else "")
    print("Links to other hosts, not followed:", *sorted(links.external), sep="\n  ")
    return 1 if links.problems else 0


if __name__ == "__main__":
    sys.exit(main())
