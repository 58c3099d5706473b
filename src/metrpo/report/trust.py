"""The report's charts of how far to trust a run's models, from `metrpo.model.diagnostics`."""

from __future__ import annotations

import re

import numpy as np

from metrpo.checks.finding import after, horizons
from metrpo.report.caption import figure
from metrpo.report.charts import Axes, Line, chart, number
from metrpo.report.heatmap import heat
from metrpo.run.find import SeenRun
from metrpo.run.metrics import column

_STRONGEST = 0.6
"""Most opacity of a cell: its number stays legible on light and dark pages."""
_DIMENSIONS, _CELLS = 30, 30
"""Most rows and columns of a heat map."""
_DOTTED = 12
"""Most iterations whose points are marked."""
_NO_CHANGE = "above 1: worse than predicting no change"


def trust_of(run: SeenRun, x: str, x_label: str) -> str:
    """A run's figures on its models' errors, their agreement and where imagination goes; empty where it has none."""
    charts = (_errors, _disagreement, _coverage)
    drawn = [chart_of(run, x, x_label) for chart_of in charts]
    return "".join([*drawn, _errors_by_dimension(run), _agreement(run)])


def _errors(run: SeenRun, x: str, x_label: str) -> str:
    known = horizons(run.rows)
    if not known:
        return ""
    few = len(run.rows) <= _DOTTED
    lines = [
        Line(run.column(x), run.column(f"error_{k}"), after(k), f"c{i}{' thick' * (k in ('1', 'T'))}", dots=few)
        for i, k in enumerate(known)
    ]
    drawn = chart("Model error by steps predicted", lines, x_label, "", axes=Axes(log_y=True, mark=1.0))
    legend = [(line.style, line.name) for line in lines]
    note = "on held-out real episodes, divided by the error of predicting no change"
    return figure("Model error", note, drawn, legend, f"Median over the state's dimensions; {_NO_CHANGE}.")


def _errors_by_dimension(run: SeenRun) -> str:
    last = run.details[-1] if run.details else {}
    matches = [match for name in last if (match := re.fullmatch(r"error_(\d+|T)_(\d+)", name))]
    known = list(dict.fromkeys(match[1] for match in matches))
    dimensions = list(dict.fromkeys(int(match[2]) for match in matches))
    table = np.array([column([last], f"error_{k}_{d}")[0] for d in dimensions for k in known])
    if not np.isfinite(table).any():
        return ""
    values = table.reshape(len(dimensions), len(known))
    finite = np.isfinite(values)
    sizes = np.where(finite, values, -np.inf)
    d, k = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
    summary = (
        f"Model error by state dimension and steps predicted: largest {number(values[d, k])}, of dimension "
        f"{dimensions[d]} after {after(known[k])}; {(values[finite] > 1).sum()} of {finite.sum()} above 1"
    )
    shown = np.sort(np.argsort(-sizes.max(axis=1), kind="stable")[:_DIMENSIONS])
    rows, columns = [f"s[{dimensions[i]}]" for i in shown], ["episode" if k == "T" else k for k in known]
    drawn = heat(summary, rows, columns, values[shown], "steps predicted", _of_error, _short)
    few = f" The {len(shown)} worst of {len(dimensions)} dimensions." if len(shown) < len(dimensions) else ""
    note = f"of each state dimension, after iteration {last['iteration']}"
    return figure("Model error by dimension", note, drawn, (), f"Red, {_NO_CHANGE}.{few}")


def _disagreement(run: SeenRun, x: str, x_label: str) -> str:
    if run.config.ensemble.members == 1:
        return ""  # no model to disagree with
    curves = (("disagreement_imagined", "imagined", "imagined"), ("disagreement_real", "real", "real thick"))
    lines = [Line(run.column(x), y, name, style) for n, name, style in curves if np.isfinite(y := run.column(n)).any()]
    if not lines:
        return ""
    drawn = chart("Disagreement of the models on real and imagined states", lines, x_label, "", axes=Axes(log_y=True))
    note = "spread of the models' predictions, in standard deviations of the data"
    below = "Imagined far above real: the policy is where the models guess."
    return figure("Disagreement", note, drawn, [(line.style, line.name) for line in lines], below)


def _agreement(run: SeenRun) -> str:
    if not run.config.takes_votes:
        return ""
    rows = [row for row in run.details if np.isfinite(column([row], "improved_0"))[0]]
    members = [name for name in (rows[0] if rows else ()) if re.fullmatch(r"improved_\d+", name)]
    shares = np.array([column(rows, name) for name in members]).reshape(len(members), len(rows))
    if len(members) < 2:
        return ""
    parts = np.array_split(np.arange(len(rows)), min(len(rows), _CELLS))
    values = np.array([[_mean(share[part]) for part in parts] for share in shares])
    names = [f"model {name.rsplit('_', 1)[1]}" for name in members]
    means = ", ".join(f"{name} {_percent(_mean(share))}" for name, share in zip(names, shares, strict=True))
    summary = f"Share of the validations in which each model saw the policy improve, mean over the iterations: {means}"
    heading = "iteration" if len(parts) == len(rows) else f"iterations, about {len(rows) / len(parts):.0f} to a cell"
    columns = [str(rows[part[0]]["iteration"]) for part in parts]
    drawn = heat(summary, names, columns, values, heading, lambda share: ("c2", _STRONGEST * share), _percent)
    note = "% of the validations in which each model saw the policy improve"
    return figure("Which models agree", note, drawn, (), "A pale row is a model that the others outvote.")


def _coverage(run: SeenRun, x: str, x_label: str) -> str:
    outside = run.column("outside")
    if not np.isfinite(outside).any():
        return ""
    line = Line(run.column(x), outside, "outside", "c3")
    drawn = chart("Imagined states outside the data", [line], x_label, "", axes=Axes(zero=True))
    note = "share of the imagined states beyond the range of the real ones in any dimension"
    return figure("Outside the data", note, drawn, (), "There the models guess: no real step has been that far out.")


def _of_error(value: float) -> tuple[str, float]:
    """Blue for errors up to 1 (no change), red above; the larger the error, the stronger the colour."""
    return ("c0", _STRONGEST * 0.7 * value) if value <= 1 else ("c3", _STRONGEST * min(0.5 + np.log10(value) / 2, 1.0))


def _short(value: float) -> str:
    """Two digits, for a cell."""
    return f"{value:#.2g}" if value < 9.95 else f"{value:.0f}" if value < 1000 else number(value)


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")


def _percent(share: float) -> str:
    return f"{100 * share:.0f}" if np.isfinite(share) else "-"
