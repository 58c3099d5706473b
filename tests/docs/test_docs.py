"""The documentation does what it says: links lead somewhere, code runs, commands are commands, nothing is left out.

Code runs in the order of its page, in an empty directory with a committed run in it, and so do the commands that cost
little. `metrpo.preset` gives brief settings meanwhile (`BRIEF`), so that what trains for minutes takes seconds; all
else is as printed. A block that cannot run here says why: `<!-- not run: REASON -->` stands above it.
"""

from __future__ import annotations

import json
import pkgutil
import re
import runpy
import shutil
import sys
import tomllib
from pathlib import Path

import pytest

import metrpo
import probe
from metrpo import config, presets
from metrpo.commands import command_table, main, parse
from metrpo.commands.reproduce import Reproduce
from metrpo.errors import TaskError
from metrpo.run import machine
from pages import PAGES, ROOT, SHELL, Block, blocks, mentioned, typed

BRIEF = probe.BRIEF | {"collect.steps": 400, "collect.max_train": 400, "iterations": 2}
CHEAP = {"evaluate", "export", "plot", "report", "tasks"}
"""Commands that really run, where the run that they are to read is there."""
FITS = 104
"""Characters in a line of code that the site shows at 1280 pixels: 107 as measured, less a scroll bar of 15 pixels."""
NAVIGATION = re.findall(r"([\w-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
prepare = runpy.run_path(str(ROOT / "docs" / "prepare.py"))


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def workshop(tmp_path, monkeypatch):
    """An empty directory, the current one, with runs as the pages call them, and the tree's examples and results."""
    for place, run in (
        ("runs/Swimmer-fast-seed0", "laptop/Swimmer/me-trpo/seed-0"),
        ("runs/sweep/HalfCheetah/me-trpo/seed-0", "diagnostics/HalfCheetah/me-trpo/seed-0"),
    ):
        shutil.copytree(ROOT / "results" / run, tmp_path / place)
    for folder in ("examples", "results"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(machine, "prepare", lambda *_: None)
    loaded = set(sys.modules)
    yield tmp_path
    for module in set(sys.modules) - loaded:
        if str(getattr(sys.modules[module], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[module]


def test_every_link_leads_somewhere():
    assert prepare["check"]().problems == []


def test_every_page_stands_in_the_navigation():
    assert sorted(NAVIGATION) == sorted(page.name for page in PAGES if page.parent.name == "docs")


def test_code_does_not_scroll_sideways():
    """Neither what is written nor what the site adds; `benchmarks/tools/look.py` measures it in a browser."""
    texts = {name(page): page.read_text() for page in PAGES} | {"the commands' help": prepare["commands"]()}
    fence = re.compile(r"^( *)```.*?^\1```", re.DOTALL | re.MULTILINE)
    lines = [(where, line) for where, text in texts.items() for f in fence.finditer(text) for line in f[0].splitlines()]
    assert len(lines) > 500
    assert [f"{where}: {line}" for where, line in lines if len(line) > FITS] == []


@pytest.mark.timeout(600)  # some 20 s of compilation, once, on a quiet machine
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python", *SHELL)], ids=name)
def test_code_runs_and_cheap_commands_too(workshop, monkeypatch, capsys, page):
    full = presets.preset
    monkeypatch.setattr(presets, "preset", lambda *a, **kw: presets.override(full(*a, **kw), BRIEF))
    names = {"__name__": "a page"}
    for block in blocks(page, "python", *SHELL):
        if block.language == "python":
            save(block)
            if not block.not_run:
                # As many empty lines before it as on the page, so that a traceback has the page's lines.
                exec(compile("\n" * (block.line - 1) + block.code, name(page), "exec"), names)
            continue
        for where, words in typed(block):
            if any(word.startswith("hub:") for word in words):
                continue  # lies elsewhere; tests/run/test_hub_upload.py plays the hub
            words = ["2" if words[i - 1] == "--episodes" else word for i, word in enumerate(words)]
            if words[0] in CHEAP and all(Path(word).exists() for word in words if word.startswith("runs")):
                assert main.main(words) == 0, f"{where}: metrpo {' '.join(words)}\n{capsys.readouterr().err}"


def save(block):
    """A block that begins with a file's name is that file."""
    if named := re.match(r"# (\w+\.py)\b", block.code):
        Path(named[1]).write_text(block.code)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_are_understood(workshop, capsys, page):
    for block in blocks(page, "python"):
        save(block)
    commands = [command for block in blocks(page, *SHELL) for command in typed(block)] + mentioned(page)
    problems = [
        f"{where}: {problem}: metrpo {' '.join(words)}" for where, words in commands if (problem := wrong(words))
    ]
    assert not problems, "\n".join(problems) + capsys.readouterr().err


def wrong(words: list[str]) -> str:
    """What the command's own parser has against it; nothing is run."""
    if len(words) == 1 and words[0] in known():  # a command that is spoken of
        return ""
    try:
        command = parse.parse(words)
    except SystemExit as end:
        return "" if end.code in (0, None) else f"the parser ends with {end.code}"
    except TaskError as error:  # Shimmy is not among what the tests need
        return "" if words[1].startswith("dm_control/") and "metrpo[dm-control]" in str(error) else str(error)
    except metrpo.MetrpoError as error:
        return str(error)
    if isinstance(command, Reproduce):
        from metrpo.paper.figures import FIGURES

        return "" if command.figure in {"all", *FIGURES} else f"no figure {command.figure}"
    return ""


def test_commands_are_found():
    """Else nothing would be tried: the README's, in blocks and in sentences."""
    readme = ROOT / "README.md"
    found = [command.words for block in blocks(readme, *SHELL) for command in typed(block)]
    assert ["train", "HalfCheetah", "--seed", "1", "--real-steps", "60000"] in found
    assert len(found) >= 14
    assert ["train", "Swimmer", "--seed", "0"] in [command.words for command in mentioned(readme)]
    two = Block(readme, 7, "sh", "metrpo tasks \\\n  --json\nls && $ metrpo doctor > a  # why\n", "")
    assert typed(two) == [("README.md:7", ["tasks", "--json"]), ("README.md:9", ["doctor"])]
    assert [block.not_run[:10] for block in blocks(ROOT / "docs" / "tutorial.md", "python")] == ["", "tests/docs"]


def known() -> set[str]:
    return set(command_table.NAMES)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["train", "Swimer"], "unknown task"),
        (["train", "Swimmer", "--ensemble.member", "3"], "unknown option"),
        (["train", "Swimmer", "--trpo.max-kl", "-1"], "trpo.max_kl"),
        (["swimm"], "unknown command"),
        (["reproduce", "figure-7"], "no figure figure-7"),
        (["train", "Swimmer", "--seed", "1"], ""),
    ],
)
def test_a_wrong_command_is_seen(workshop, words, problem):
    assert problem in wrong(words)
    assert bool(wrong(words)) == bool(problem)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_data_can_be_read_and_targets_and_scripts_are_there(page):
    for language, read in (("json", json.loads), ("toml", tomllib.loads)):
        for block in blocks(page, language):
            read("\n" * (block.line - 1) + block.code)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    shell = "\n".join(block.code for block in blocks(page, *SHELL))
    inline = "\n".join(re.findall(r"`([^`\n]+)`", page.read_text()))
    assert set(re.findall(r"^make ([a-z-]+)", f"{shell}\n{inline}", re.MULTILINE)) <= targets
    scripts = re.findall(r"^python (\w+/\S+\.py)", f"{shell}\n{inline}", re.MULTILINE)
    assert [script for script in scripts if not (ROOT / script).is_file()] == []


def test_the_reference_is_complete():
    """Every public name, every extra; the commands come from the parser itself."""
    described = re.findall(r"^::: (\S+)$", (ROOT / "docs" / "reference.md").read_text(), re.MULTILINE)
    assert sorted(described) == sorted(f"metrpo.{public}" for public in metrpo.__all__ if public != "Config")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].keys() - {"dev"}
    assert set(re.findall(r"^\| `([a-z0-9-]+)` \|", (ROOT / "docs" / "index.md").read_text(), re.MULTILINE)) == extras
    text = prepare["commands"]()
    assert re.findall(r"^## metrpo (\w+)$", text, re.MULTILINE) == list(command_table.NAMES)
    assert "--ensemble.members INT" in text
    assert not set(text) & set("╭╮╰╯│")


def test_the_ways_through_the_code_name_what_is_there():
    page = (ROOT / "docs" / "concepts.md").read_text()
    ways = prepare["section"](page, "Three ways through the code")
    names = re.findall(
        r"^ *((?:\w+\.)+\w+)", "\n".join(re.findall(r"```text\n(.*?)```", ways, re.DOTALL)), re.MULTILINE
    )
    assert len(names) > 30
    missing = []
    for name in names:
        try:
            pkgutil.resolve_name(f"metrpo.{name}")
        except (ImportError, AttributeError):
            missing.append(name)
    assert not missing


def test_every_setting_has_a_row_with_its_values_and_its_text():
    text = prepare["settings"]()
    rows = {
        cells[0]: cells[1:]
        for cells in re.findall(r"^\| `([a-z_.]+)` \| (.*?) \| (.*?) \| (.*?) \| (.+) \|$", text, re.M)
    }
    assert rows.keys() == config.flatten(metrpo.preset("Swimmer")).keys()
    labels = re.findall(r'content: "(.+) "', (ROOT / "docs" / "site.css").read_text())
    assert f"| setting | {' | '.join(labels)} | what it is |" in text, "a phone shows the columns' names by site.css"
    assert rows["collect.validation_fraction"][0] == "0.3333"
    assert rows["ensemble.hidden"][:3] == ("1024-1024", "200-200-200", "200-200-200")
    assert rows["fit.max_steps"][:3] == ("none", "4000", "1500")
    assert rows["trpo.max_kl"] == (
        "0.01",
        "",
        "",
        "Trust region: the maximum mean KL divergence from the old to the new policy.",
    )
    assert "| Humanoid | paper | `iterations` 400" in text


def test_what_preparing_a_page_does(tmp_path):
    """Links that leave docs/ get a place in the site; one that leads nowhere is named with its line."""
    links = prepare["Links"]([], set(), set())
    page = ROOT / "docs" / "tasks.md"
    lead = lambda target: prepare["_target"](page, target, "tasks.md:3", links, "https://example.org/a")  # noqa: E731
    assert lead("../src/metrpo/commands/main.py") == "https://example.org/a/blob/main/src/metrpo/commands/main.py"
    assert lead("../results") == "https://example.org/a/tree/main/results"
    assert lead("../README.md#results") == "index.md#results"
    assert lead("fast-preset.md#weight-decay") == "fast-preset.md#weight-decay"
    assert lead("../results/laptop/figures/sampling.png") == "tree/results/laptop/figures/sampling.png"
    assert not links.problems
    for target in ("../src/metrpo/clo.py", "fast-preset.md#weight", "../../elsewhere.md", "ftp://example.org"):
        lead(target)
    assert [problem.split(": ")[0] for problem in links.problems] == ["tasks.md:3"] * 4
    assert prepare["with_full_size"]("![a](b/c.png) ![d](e.gif)") == "[![a](b/c.png)](b/c.png) ![d](e.gif)"
    assert prepare["section"]("# A\nx\n```sh\n# B\n```\n## C\ny\n", "A") == "x\n```sh\n# B\n```\n"
    assert prepare["section"]("# A\n", "B") is None
