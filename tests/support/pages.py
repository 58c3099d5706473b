"""What the documentation's pages hold that can be tried: blocks of code, and commands in blocks and in lines."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import NamedTuple

from places import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("", "sh", "bash", "console")
PLACEHOLDERS = {"TASK": "Swimmer", "FIGURE": "all", "DIR": "runs/a", "FILE": "log.npz", "N": "0", "B": "0.1"}
"""What stands for anything in a line of text, and something that it can stand for."""
_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1``` *$", re.DOTALL | re.MULTILINE)
_NOT_RUN = re.compile(r"<!-- not run: ([^>]+?) -->\s*\Z")
_INLINE = re.compile(r"`(metrpo [^`]+)`")
_LOGICAL_LINE = re.compile(r"(?:[^\n]*\\\n)*[^\n]+")
"""Up to an end of line that no backslash takes back."""
_COMMAND = re.compile(r"(?:\$ +)?(?:\w+=\S* +)*(?:\S*/)?metrpo +(.*)")


class Block(NamedTuple):
    """One fenced block."""

    page: Path
    line: int
    """Of its first line of code, from 1."""
    language: str
    code: str
    not_run: str
    """Why the tests do not run it: `<!-- not run: REASON -->` stands above it. Empty: they do."""

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


class Command(NamedTuple):
    """What follows `metrpo` in a shell, wherever it stands."""

    where: str
    words: list[str]


def blocks(page: Path, *languages: str) -> list[Block]:
    """The page's blocks in any of `languages`, in order."""
    text = page.read_text()
    found = [
        Block(page, _line(text, fence.start(3)), fence[2], fence[3], _reason(text[: fence.start()]))
        for fence in _FENCE.finditer(text)
    ]
    return [block for block in found if block.language in languages]


def typed(block: Block) -> list[Command]:
    """The `metrpo` commands of a block of shell lines."""
    found = []
    for line in _LOGICAL_LINE.finditer(block.code):
        number = block.line + _line(block.code, line.start()) - 1
        for part in re.split(r"\s(?:&&|\|\|?|>|;)\s", line[0].replace("\\\n", " ").strip()):
            if command := _COMMAND.fullmatch(part):
                found.append(_command(block.page, number, command[1]))
    return found


def mentioned(page: Path) -> list[Command]:
    """The `metrpo` commands that stand in the page's sentences, with something in the place of their placeholders."""
    text = page.read_text()
    prose = _FENCE.sub(lambda fence: re.sub(r"[^\n]", " ", fence[0]), text)
    found = [_command(page, _line(text, m.start()), m[1][len("metrpo ") :]) for m in _INLINE.finditer(prose)]
    return [c._replace(words=[PLACEHOLDERS.get(word, word) for word in c.words]) for c in found if "..." not in c.words]


def _command(page: Path, line: int, text: str) -> Command:
    return Command(f"{page.relative_to(ROOT)}:{line}", shlex.split(text, comments=True))


def _line(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


def _reason(before: str) -> str:
    found = _NOT_RUN.search(before)
    return found[1] if found else ""
