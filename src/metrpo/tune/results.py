"""The results of a search: a record of each trial, a table of the best, and the command that repeats the best."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from metrpo.config import flatten
from metrpo.counting import counted, named_value
from metrpo.tune.search import OBJECTIVE, Search

if TYPE_CHECKING:
    from optuna import Study

TrialState = Literal["complete", "pruned", "failed"]
_STATES: dict[str, TrialState] = {"COMPLETE": "complete", "PRUNED": "pruned", "FAIL": "failed"}
PICTURE = "tune.png"
_WIDE = 160
"""Columns of the table where no terminal says how many there are."""
_SHOWN = 10
"""Trials in the table."""
ENOUGH = 10
"""Least number of complete trials that give a setting's importance; with fewer, it would be chance."""


@dataclass(frozen=True)
class Record:
    """A finished trial."""

    number: int
    state: TrialState
    value: float | None
    """Its value (`OBJECTIVE`), or the value when it was pruned."""
    returns: list[float]
    """The value of each seed; empty unless the trial is complete."""
    iterations: int
    """Iterations that all its seeds have finished."""
    real_steps: int
    """Real steps of all its seeds."""
    settings: dict[str, Any]
    """The searched settings."""
    usual: bool
    """Whether these are the preset's."""
    failure: str | None


@dataclass(frozen=True)
class Tuned:
    """All finished trials so far, in order."""

    search: Search
    records: list[Record]
    importance: dict[str, float]
    """Shares of the variance among good trials (PED-ANOVA), most important first; empty where there are too few."""

    @property
    def best(self) -> Record | None:
        """The complete trial with the highest value."""
        return max(self._complete, key=lambda r: r.value or 0.0, default=None)

    @property
    def _complete(self) -> list[Record]:
        return [r for r in self.records if r.state == "complete"]

    @property
    def failed(self) -> list[Record]:
        """The failed trials."""
        return [r for r in self.records if r.state == "failed"]

    def command(self, record: Record) -> str:
        """The command line that repeats a trial with its first seed."""
        return shlex.join(["metrpo", "train", *self.search.runs(record.number, record.settings)[0].arguments])

    def record(self) -> dict[str, Any]:
        """All of it as JSON."""
        best = self.best
        return {
            "search": self.search.record(),
            "objective": OBJECTIVE,
            "trials": [dataclasses.asdict(r) for r in self.records],
            "best": None
            if best is None
            else {"number": best.number, "value": best.value, "command": self.command(best)},
            "importance": self.importance,
        }

    def print(self, console: Console | None = None) -> None:
        """Prints the best trials, a summary of all, and how to repeat the best."""
        console = console or Console(highlight=False)
        if not console.is_terminal:
            console.width = max(console.width, _WIDE)
        count = {state: sum(r.state == state for r in self.records) for state in _STATES.values()}
        steps = sum(r.real_steps for r in self.records)
        console.print(self._table())
        outcomes = ", ".join(f"{n} {state}" for state, n in count.items() if n)
        trials, taken = counted(len(self.records), "trial"), counted(steps, "real step")
        lines = [f"{trials}: {outcomes or 'none finished'}; {taken}. Return: {OBJECTIVE}."]
        if self.importance:
            parts = ", ".join(f"{name} {share:.0%}" for name, share in self.importance.items())
            lines.append(f"importance (PED-ANOVA, of the complete trials): {parts}")
        if self.best is not None:
            others = "".join(f" {seed}" for seed in self.search.seeds[1:])
            lines.append("To repeat the best" + (f" with its first seed (others:{others})" if others else "") + ":")
            lines.append(f"\n  {self.command(self.best)}\n")
        for line in lines:
            console.print(Text(line), soft_wrap=True)

    def _table(self) -> Table:
        grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
        for name in ("trial", "return", "seeds", *self.search.space, "real steps", ""):
            grid.add_column(name, justify="left" if name == "" else "right", overflow="fold")
        for r in sorted(self._complete, key=lambda r: -(r.value or 0.0))[:_SHOWN]:
            settings = [_number(r.settings[name]) for name in self.search.space]
            seeds = ", ".join(f"{value:.1f}" for value in r.returns) if len(r.returns) > 1 else ""
            note = "the preset's own" if r.usual else ""
            cells = [str(r.number), f"{r.value:.1f}", seeds, *settings, f"{r.real_steps:,}", note]
            grid.add_row(*(Text(cell, style="bold" if r is self.best else "") for cell in cells))
        return grid


def tuned(study: Study, search: Search) -> Tuned:
    """The finished trials of a study."""
    records = []
    for trial in study.get_trials(deepcopy=False):
        if trial.state.name not in _STATES:
            continue
        about, steps = trial.user_attrs, trial.intermediate_values
        settings = {name: search.space[name].value(label) for name, label in trial.params.items()}
        records.append(
            Record(
                number=trial.number,
                state=_STATES[trial.state.name],
                value=trial.value if trial.value is not None or not steps else steps[max(steps)],
                returns=list(about.get("returns", [])),
                iterations=max(steps, default=0),
                real_steps=int(about.get("real_steps", 0)),
                settings=settings,
                usual=settings == search.usual,
                failure=about.get("failure"),
            )
        )
    return Tuned(search, records, _importance(study, search))


def _importance(study: Study, search: Search) -> dict[str, float]:
    import optuna

    values = [t.value for t in study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.COMPLETE])]
    if len(values) < ENOUGH or len(set(values)) == 1 or len(search.space) < 2:
        return {}
    return {name: float(share) for name, share in optuna.importance.get_param_importances(study).items()}


def describe(search: Search, out: Path) -> str:
    """The search in words: its trials, its settings and ranges, and the command of a trial."""
    trials, seeds = counted(search.trials, "trial"), counted(len(search.seeds), "seed")
    steps = search.base.real_steps
    budget = counted(search.steps, "iteration") if steps is None else counted(steps, "real step")
    lines = [f"{out}: {trials} of {seeds}, {budget} each; the search covers"]
    usual = search.usual or {}
    for name, over in search.space.items():
        lines.append(f"  {name} = {over}" + (f" (the preset has {_number(usual[name])})" if usual else ""))
    if not usual:
        values = flatten(search.base)
        others = [
            f"{n} = {_number(values[n])} lies outside {o}" for n, o in search.space.items() if not o.holds(values[n])
        ]
        lines.append(f"No trial uses the preset's own values: {', '.join(others)}.")
    values = search.usual or {name: over.outermost[0] for name, over in search.space.items()}
    what = "the first trial" if usual else "one trial"
    lines.append(f"{what}: metrpo train {shlex.join(search.runs(0, values)[0].arguments)}")
    return "\n".join(lines)


def shown(settings: Mapping[str, Any]) -> str:
    """A trial's settings in a line."""
    return ", ".join(f"{name} {_number(value)}" for name, value in settings.items())


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else named_value(value)
