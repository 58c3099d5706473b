"""The report's section on one task: learning curves, then every run's diagnostics and video."""

from __future__ import annotations

import base64
import os
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from metrpo.checks.finding import Concern
from metrpo.counting import counted
from metrpo.plots.bands import RATIOS, curve, is_far, x_axis
from metrpo.report import charts
from metrpo.report.caption import figure, swatches
from metrpo.report.charts import Axes, Line, bars, chart
from metrpo.report.trust import trust_of
from metrpo.run.find import Group, SeenRun, no_skill
from metrpo.run.metrics import is_clock

_QUANTITIES = (
    ("gap", "Gap", "imagined minus real return; near zero is good", True),
    ("fraction_improved", "Models improved", "share of the models in which the policy improved", True),
    ("updates", "Policy updates", "tried in each iteration", True),
    ("accepted_updates", "Accepted updates", "of those tried", True),
    ("rejected_steps", "Rejected updates", "of those tried, did not move the policy", True),
    ("kl", "KL divergence", "mean over the updates", True),
    ("mean_std", "Standard deviation", "of the policy's actions", True),
    ("saturated", "Saturated actions", "share of the policy's mean actions beyond the limits (critics: 0.99)", True),
    ("critic_loss", "Critics' loss", "in squared units of their scale", True),
    ("value", "Value", "what the critics say on average", False),
    ("entropy", "Entropy", "of the actor, in nats", False),
    ("entropy_weight", "Entropy's weight", "what a nat is worth, in rewards", True),
    ("actor_gradient_norm", "Actor's gradient", "its norm", True),
    ("diverged", "Diverged rollouts", "share of imagined rollouts", True),
    ("error_1", "Model error, one step", "on held-out real steps; 1: no better than predicting no change", False),
    ("error_T", "Model error, an episode", "the same after a whole imagined episode", False),
    ("disagreement_imagined", "Disagreement", "of the models in imagination, in standard deviations", False),
    ("outside", "Outside the data", "share of the imagined states beyond the real ones' range", True),
    ("members_reset", "Models started anew", "in each iteration, after they diverged", True),
    ("failed_episodes", "Episodes left out", "in which the environment failed", True),
    ("return_collected", "Collected return", "of the real episodes, with exploration noise", False),
    ("train_loss", "Training loss", "mean over the models", True),
    ("fit_passes", "Epochs of fitting", "over the training set", True),
)
"""Column, title, note, and whether the axis includes zero."""
_OWN = (
    "iteration",
    "real_steps",
    "return_real",
    "return_real_std",
    "return_imagined",
    "validations",
    "disagreement_real",
)
"""Columns shown elsewhere."""
_TRUST = (*RATIOS, "outside")
"""`trust_of` draws the columns that begin so, for each run."""


@dataclass(frozen=True)
class Seen:
    """A run with its name, colour and findings on the page."""

    run: SeenRun
    group: Group
    name: str
    colour: str
    concerns: list[Concern]


class Budget:
    """Bytes left for videos."""

    def __init__(self, left: int) -> None:
        self.left = left


def task_section(task: str, seen: list[Seen], groups: list[Group], folder: Path, left: Budget, few: bool) -> str:
    """The section of one task as HTML; `few`: every run is unfolded. `folder` is where the page lies."""
    x, x_label = x_axis([s.run for s in seen])
    colours = {id(s.group): s.colour for s in seen}
    parts = [f"<section><h2>{escape(task)}</h2>", _learning(task, seen, groups, colours, x, x_label)]
    trust = [_trust(s, x, x_label) for s in seen]
    if any(trust):
        inside = f'{swatches([("real", "real"), ("imagined", "imagined")])}<div class="grid">{"".join(trust)}</div>'
        folded = f"<details><summary>{counted(len(seen), 'run')}</summary>{inside}</details>"
        parts.append(f"<h3>Real and imagined return</h3>{inside if len(seen) <= 12 else folded}")
    several = len(groups) > 1
    still = [title for name, title, *_ in _QUANTITIES if _is_zero(seen, name)]
    # Quantities that each run shows by itself are drawn together as well, to compare several runs.
    drawn = [q for q in _QUANTITIES if q[1] not in still and (len(seen) > 1 or not q[0].startswith(_TRUST))]
    small = [_across(seen, *q, x, x_label) for q in drawn]
    others = [_across(seen, name, name, "", False, x, x_label) for name in _others(seen)]
    if any(small):
        parts.append(f'<h3>All runs of {escape(task)}</h3>{_legend(groups, colours) * several}<div class="grid">')
        parts.append(f"{''.join(small)}</div>")
    if still:
        parts.append(f'<p class="small">Zero in every iteration of every run: {", ".join(still).lower()}.</p>')
    if any(others):
        parts.append(f"<details><summary>Other columns</summary><div class=grid>{''.join(others)}</div></details>")
    for s in seen:
        parts.append(
            f"<details{' open' * few}><summary>{escape(s.name)}</summary>"
            f'<p class="small path">{escape(str(s.run.path))}</p>'
            f'<div class="grid">{_of_run(s, x, x_label)}</div>{_video(s, folder, left)}</details>'
        )
    return "".join([*parts, "</section>"])


def _learning(task: str, seen: list[Seen], groups: list[Group], colours: dict[int, str], x: str, x_label: str) -> str:
    """The learning curve, twice: wide for a desk, narrow for a phone; the style sheet shows one of them."""
    lines: list[Line] = []
    y, y_label, what = "return_real", "real return", "Return of an episode of the deterministic policy"
    if not any(np.isfinite(s.run.column(y)).any() for s in seen):
        # only another program can play
        y, y_label, what = "return_collected", "collected return", "Return of an episode with exploration noise"
    log = is_far(x, [s.run.column(x)[-1] for s in seen])
    for g in groups:
        c, colour = curve(g, x, y, log), colours[id(g)]
        if len(c.seeds) > 1:
            lines += [Line(*seed, g.label, f"{colour} thin", dots=False) for seed in c.seeds]
        lines.append(Line(c.x, c.mean, g.label, f"{colour} thick", len(c.seeds) == 1, c.low, c.high))
    levels = no_skill([s.run for s in seen])
    lines += [Line(_ends(lines), np.full(2, level), name, "level dashed", False) for name, level in levels.items()]
    title = f"Learning curves of {task}"
    wide = chart(title, lines, x_label, y_label, size=(1120, 340), axes=Axes(log=log))
    narrow = chart(title, lines, x_label, y_label, axes=Axes(log=log))
    seeds = max(len(g.runs) for g in groups)
    said = {1: "", 2: " Thin: seeds; thick: their mean; band: their range."}.get(
        seeds, " Thin: seeds; thick: their mean; band: its 95 % bootstrap interval (of two seeds, their range)."
    )
    said += "".join(f" Dashed: {name} earns {charts.number(level)}." for name, level in levels.items())
    return (
        f"{_legend(groups, colours)}<figure class=wide>{wide}</figure><figure class=narrow>{narrow}</figure>"
        f'<p class="small">{what} against {x_label}.{said}</p>'
    )


def _ends(lines: list[Line]) -> np.ndarray:
    """First and last x of some lines."""
    x = np.concatenate([line.x for line in lines])
    return np.array([x.min(), x.max()]) if len(x) else np.empty(0)


def _across(seen: list[Seen], name: str, title: str, note: str, zero: bool, x: str, x_label: str) -> str:
    """One quantity of all runs of a task; empty where none has it."""
    lines = [Line(s.run.column(x), s.run.column(name), s.name, s.colour, dots=len(seen) <= 4) for s in seen]
    lines = [line for line in lines if np.isfinite(line.y).any()]
    if not lines:
        return ""
    frame, log = _robust([line.y for line in lines]) if name == "gap" else None, is_far(x, [n.x[-1] for n in lines])
    log_y, mark = name.startswith(RATIOS), 1.0 if name.startswith("error_") else None
    axes = Axes(frame, len(lines) == 1, zero, mark, log, log_y)
    return figure(title, note, chart(title, lines, x_label, "", axes=axes))


def _is_zero(seen: list[Seen], name: str) -> bool:
    values = np.concatenate([s.run.column(name) for s in seen])
    return bool(np.isfinite(values).any() and (values[np.isfinite(values)] == 0).all())


def _trust(s: Seen, x: str, x_label: str) -> str:
    """Real and imagined return of one run: how far its models can be trusted."""
    at, real, imagined = (s.run.column(name) for name in (x, "return_real", "return_imagined"))
    if not np.isfinite(imagined).any():
        return ""
    lines = [Line(at, imagined, "imagined", "imagined"), Line(at, real, "real", "real thick")]
    lines = [line for line in lines if np.isfinite(line.y).any()]
    axes = Axes(frame=charts.real_frame(real, imagined))
    drawn = chart(f"Real and imagined return of {s.name}", lines, x_label, "", axes=axes)
    horizon = s.run.config.imagine.horizon
    return figure(s.name, f"imagined: only {horizon} steps, not comparable" if horizon else "", drawn)


def _of_run(s: Seen, x: str, x_label: str) -> str:
    run, at = s.run, s.run.column(x)
    parts = [trust_of(run, x, x_label)]
    losses = [name for name in run.rows[0] if name.startswith("validation_loss_")]
    if losses:
        styles = [f"c{k % charts.COLOURS}{' dashed' * (k // charts.COLOURS % 2)}" for k in range(len(losses))]
        lines = [
            Line(at, run.column(name), f"model {name.rsplit('_', 1)[1]}", style, dots=False)
            for name, style in zip(losses, styles, strict=True)
        ]
        drawn = chart("Validation loss", lines, x_label, "", axes=Axes(zero=True))
        legend = [(style, line.name) for style, line in zip(styles, lines, strict=True)]
        parts.append(figure("Validation loss", "of each model, on held-out real steps", drawn, legend))
    if np.isfinite(run.column("updates")).any():
        tried, kept, rejected = (run.column(n) for n in ("updates", "accepted_updates", "rejected_steps"))
        curves = (("tried", tried, "c2"), ("accepted", kept, "c0"), ("rejected", rejected, "c3"))
        lines = [Line(at, y, name, style, dots=False) for name, y, style in curves if np.isfinite(y).any()]
        drawn = chart("Policy updates", lines, x_label, "", axes=Axes(zero=True))
        legend = [(line.style, line.name) for line in lines]
        kept_by = "accepted by validation" if run.config.takes_votes else "kept"
        parts.append(figure("Policy updates", f"tried, {kept_by}, rejected without a move", drawn, legend))
    stages = [name for name in run.rows[0] if name.startswith("seconds_") and np.nansum(run.column(name)) > 0]
    if stages:
        names = [name.removeprefix("seconds_") for name in stages]
        seconds = np.array([run.column(name) for name in stages])
        iterations = [int(row["iteration"] or 0) for row in run.rows]
        drawn = bars("Stage times", names, seconds, iterations, "iteration", "")
        legend = [(f"c{i % charts.COLOURS}", name) for i, name in enumerate(names)]
        parts.append(figure("Stage times", "seconds of every iteration", drawn, legend))
    return "".join(parts)


def _legend(groups: list[Group], colours: dict[int, str]) -> str:
    return swatches(
        [
            (colours[id(g)], f"{g.label} ({counted(len(g.runs), 'seed')})" if len(g.runs) > 1 else g.label)
            for g in groups
        ]
    )


def _video(s: Seen, folder: Path, left: Budget) -> str:
    file = s.run.path / "video.mp4"
    try:
        size = file.stat().st_size
        if size > left.left:
            link = "./" + quote(os.path.relpath(file, folder))
            return f'<p>Video: <a href="{escape(link, quote=True)}">{escape(str(file))}</a> ({size / 1e6:.1f} MB)</p>'
        content = base64.b64encode(file.read_bytes()).decode()
    except OSError:
        return ""  # none was made
    left.left -= size
    return (
        f'<figure class="video"><figcaption><b>Video</b> <small>the policy at work</small></figcaption>'
        f'<video controls muted loop playsinline preload="auto" src="data:video/mp4;base64,{content}"></video>'
        "</figure>"
    )


def _others(seen: list[Seen]) -> list[str]:
    """Columns without a chart of their own, such as those of later versions."""
    known = {*_OWN, *(q[0] for q in _QUANTITIES)}
    names = dict.fromkeys(name for s in seen for name in s.run.rows[0])
    shown = ("validation_loss_", *_TRUST)
    return [n for n in names if n not in known and not is_clock(n) and not n.startswith(shown)]


def _robust(values: list[np.ndarray]) -> tuple[float, float]:
    """Limits that leave out what few iterations have: the first models may promise a hundredfold."""
    finite = np.concatenate([v[np.isfinite(v)] for v in values])
    low, high = (float(q) for q in np.quantile(finite, [0.0, 0.9]))
    high = float(finite.max()) if finite.max() <= 3 * max(high, -low, 1e-9) else 2 * max(high, 0.0)
    return min(low, 0.0), max(high, 0.0) if high > 0 or low < 0 else 1.0
