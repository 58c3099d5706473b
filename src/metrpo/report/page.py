"""The report: one HTML page about runs, without network, scripts or other files."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from metrpo.checks.health import examine
from metrpo.console.result_lines import duration
from metrpo.counting import counted
from metrpo.report import charts
from metrpo.report.charts import number
from metrpo.report.group_table import compared, group_section
from metrpo.report.panels import Budget, Seen, task_section
from metrpo.report.style import STYLE
from metrpo.report.tables import html_table
from metrpo.run.find import FoundRuns, Group, SeenRun, group, is_finished, settings

VIDEO_BYTES = 3_000_000
"""Most bytes of all videos inside a page; the others are links. In base64 they take a third more."""


@np.errstate(all="ignore")  # 1e300 in a file is no reason to complain
def page(found: FoundRuns, folder: Path) -> str:
    """The report of runs as HTML; `folder` is where the page will lie, for links to videos.

    Runs without a finished iteration are listed with those that could not be read.
    """
    runs = [run for run in found.runs if run.rows]
    groups = group(runs)
    seen = _seen(groups)
    left = Budget(VIDEO_BYTES)
    tasks = list(dict.fromkeys(s.group.task for s in seen))
    body = [
        f"<header><h1>{escape(', '.join(tasks) or 'No task')}</h1><p>{_summary(seen)}</p></header>",
        group_section(compared(runs), {(s.group.task, s.group.label): s.colour for s in seen}),
        _health(seen, found),
        _table(seen),
    ]
    for task in tasks:
        here = [s for s in seen if s.group.task == task]
        body.append(task_section(task, here, [g for g in groups if g.task == task], folder, left, len(seen) <= 4))
    body.append(_differences(groups))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        # A browser that opens this page makes no requests.
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        'img-src data:; media-src data:"><meta name="color-scheme" content="light dark">'
        f"<title>{escape(', '.join(tasks) or 'metrpo')}: metrpo report</title><style>{STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def record(found: FoundRuns) -> dict[str, Any]:
    """The report for scripts: the groups, the runs with their metrics and warnings, what was skipped, and the settings
    that differ. NaN is None."""
    runs = [run for run in found.runs if run.rows]
    groups = group(runs)
    return {
        "groups": [one.plain() for one in compared(runs)],
        "runs": [
            {
                "path": str(s.run.path),
                "task": s.run.config.task,
                "label": s.group.label,
                "seed": s.run.config.seed,
                "iterations": len(s.run.rows),
                "finished": is_finished(s.run),
                **{name: _plain(s.run.column(name)[-1]) for name in ("real_steps", "return_real", "gap")},
                "return_best": _plain(_best(s.run)),
                "warnings": [{**vars(c), "text": c.text} for c in s.concerns],
            }
            for s in _seen(groups)
        ],
        "skipped": [{"path": str(path), "why": why} for path, why in _skipped(found)],
        "differences": _different(groups),
    }


def _seen(groups: list[Group]) -> list[Seen]:
    seen = []
    for g in groups:
        place = [other for other in groups if other.task == g.task].index(g)
        names = [f"{g.label}, seed {run.config.seed}" for run in g.runs]
        for run, name in zip(g.runs, names, strict=True):
            full = f"{name} ({run.path.name})" if names.count(name) > 1 else name
            dashed = " dashed" * (place // charts.COLOURS % 2)
            colour = f"c{place % charts.COLOURS}{dashed}"
            seen.append(Seen(run, g, full, colour, examine(run.rows, run.config, run.yardsticks)))
    return seen


def _summary(seen: list[Seen]) -> str:
    steps = sum(int(s.run.rows[-1]["real_steps"] or 0) for s in seen)
    unfinished = sum(not is_finished(s.run) for s in seen)
    open_ = f"; {unfinished} not finished" if unfinished else ""
    return f"{counted(len(seen), 'run')}, {counted(steps, 'real step')} in all{open_}."


def _health(seen: list[Seen], found: FoundRuns) -> str:
    warned = [s for s in seen if any(c.level == "warning" for c in s.concerns)]
    noted = [s for s in seen if s.concerns and s not in warned]
    several = len({s.group.task for s in seen}) > 1
    if warned:
        verdict = f'<p class="verdict bad">Warnings in {len(warned)} of {counted(len(seen), "run")}</p>'
    else:
        verdict = f'<p class="verdict good">No warnings in {counted(len(seen), "run")}</p>'
    parts = ['<section id="health"><h2>Health</h2>', verdict, *(_card(s, several) for s in warned)]
    if noted:
        cards = "".join(_card(s, several) for s in noted)
        inside = " open" if not warned and len(noted) <= 2 else ""
        parts.append(f"<details{inside}><summary>Notes on {counted(len(noted), 'more run')}</summary>{cards}</details>")
    if skipped := _skipped(found):
        items = "".join(f"<li><code>{escape(str(path))}</code>: {escape(why)}</li>" for path, why in skipped)
        parts.append(f'<div class="card skipped"><h3>Not in this report</h3><ul>{items}</ul></div>')
    return "".join([*parts, "</section>"])


def _card(s: Seen, with_task: bool) -> str:
    items = "".join(
        f'<li class="{c.level}"><strong>{escape(c.measured)}</strong> since iteration {c.since}. '
        f'<span class="meaning">{escape(_sentence(c.meaning))}</span> '
        f'<span class="help">What to do: {escape(c.help)}.</span></li>'
        for c in s.concerns
    )
    task = f"{escape(s.group.task)}, " if with_task else ""
    return f'<div class="card"><h3>{task}{escape(s.name)}</h3><ul>{items}</ul></div>'


def _table(seen: list[Seen]) -> str:
    heads = ("run", "iteration", "real steps", "return", "best", "gap", "time", "warnings")
    rows, several = [], len({s.group.task for s in seen}) > 1
    for s in seen:
        last, run = s.run.rows[-1], s.run
        warnings = sum(c.level == "warning" for c in s.concerns)
        error = run.column("return_real_std")[-1]
        cells = (
            f"{last['iteration']}{'' if is_finished(run) else ' (not finished)'}",
            f"{last['real_steps']:,}",
            f"{number(run.column('return_real')[-1])}{f' ± {number(error)}' if np.isfinite(error) else ''}",
            number(_best(run)),
            number(run.column("gap")[-1]),
            duration(float(t)) if np.isfinite(t := run.column("wall_seconds")[-1]) else "-",
            f'<span class="bad">{warnings}</span>' if warnings else "0",
        )
        task = f"{escape(s.group.task)}, " if several else ""
        name = f'<i class="swatch {s.colour}"></i>{task}{escape(s.name)}'
        rows.append(
            (f'<span title="{escape(str(run.path), quote=True)}">{name}</span>', *cells),
        )
    return (
        f'<section id="runs"><h2>Runs</h2><div class="scroll">{html_table(heads, rows)}</div>'
        "<p class=small>Real returns of the deterministic policy, "
        "± their standard deviation over episodes. Gap: imagined minus real return.</p></section>"
    )


def _differences(groups: list[Group]) -> str:
    different = _different(groups)
    if len(groups) < 2 or not different:
        text = "All runs have the same settings, apart from the seed." if len(groups) == 1 else ""
        return f"<section><h2>Settings</h2><p>{text}</p></section>" if text else ""
    tasks = len({g.task for g in groups}) > 1
    heads = [f"{g.task}, {g.label}" if tasks else g.label for g in groups]
    rows = [
        [f"<code>{escape(name)}</code>", *(escape(_text(value)) for value in values)]
        for name, values in different.items()
    ]
    table = html_table(["setting", *map(escape, heads)], rows)
    return f'<section><h2>Settings that differ</h2><div class="scroll">{table}</div></section>'


def _different(groups: list[Group]) -> dict[str, list[object]]:
    """Settings in which the groups differ, with each one's value."""
    if not groups:
        return {}
    first = groups[0].runs[0].config
    changed = [settings(first, g.runs[0].config) for g in groups]
    names = list(dict.fromkeys(name for one in changed for name in one))
    usual = {name: values[0] for one in changed for name, values in one.items()}
    return {name: [one[name][1] if name in one else usual[name] for one in changed] for name in names}


def _skipped(found: FoundRuns) -> list[tuple[Path, str]]:
    fresh = [(run.path, "no finished iteration yet") for run in found.runs if not run.rows]
    return [*((s.path, s.why) for s in found.skipped), *fresh]


def _best(run: SeenRun) -> float:
    real = run.column("return_real")
    return float(np.nanmax(real)) if np.isfinite(real).any() else float("nan")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _text(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
