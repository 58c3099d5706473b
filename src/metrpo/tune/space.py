"""The range or the choices of a searched setting, as typed and for Optuna."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import types
import typing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from metrpo.config import Config, types_of
from metrpo.errors import ConfigError
from metrpo.launch.grid import values_of

if TYPE_CHECKING:
    from optuna import Trial

_NUMBER = r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"
"""Without a bare point at either end: 1...5 could be read in two ways."""
_RANGE = re.compile(rf"(?P<log>log +)?(?P<low>{_NUMBER}) *\.\. *(?P<high>{_NUMBER})(?: +step +(?P<step>{_NUMBER}))?")
_FORMS = "A..B, log A..B, A..B step C, or choices such as 1,3,5 or [64],[200,200]"


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included: whole ones where the setting is one, in steps, or evenly in log."""

    low: float
    high: float
    log: bool = False
    step: float | None = None
    """Between two neighbours; None: any, of whole numbers every one."""

    @property
    def outermost(self) -> tuple[Any, ...]:
        """The values that a setting must be able to take."""
        return (self.low, self.high)

    def holds(self, value: Any) -> bool:
        """Whether `value` is among them."""
        if type(value) not in (int, float) or not self.low <= value <= self.high:
            return False
        steps = (value - self.low) / self.step if self.step else 0.0
        return math.isclose(steps, round(steps), abs_tol=1e-9)

    def ask(self, trial: Trial, name: str) -> Any:
        """The trial's value, drawn by Optuna unless it has one."""
        if isinstance(self.low, int):
            return trial.suggest_int(name, self.low, int(self.high), step=int(self.step or 1), log=self.log)
        return trial.suggest_float(name, self.low, self.high, step=self.step, log=self.log)

    def label(self, value: Any) -> Any:
        """As Optuna keeps a value."""
        return value

    def value(self, label: Any) -> Any:
        """What Optuna keeps as `label`."""
        return label

    def __str__(self) -> str:
        step = "" if self.step is None else f" step {self.step}"
        return f"{'log ' if self.log else ''}{self.low}..{self.high}{step}"


@dataclass(frozen=True)
class Choices:
    """These values, in no order."""

    values: tuple[Any, ...]

    @property
    def outermost(self) -> tuple[Any, ...]:
        """The values that a setting must be able to take."""
        return self.values

    def holds(self, value: Any) -> bool:
        """Whether `value` is among them."""
        return value in self.values

    def ask(self, trial: Trial, name: str) -> Any:
        """The trial's value, drawn by Optuna unless it has one."""
        return self.value(trial.suggest_categorical(name, [self.label(value) for value in self.values]))

    def label(self, value: Any) -> Any:
        """As Optuna keeps a value, whose choices are plain numbers and texts: "[200, 200]" for a list."""
        return json.dumps(value) if isinstance(value, tuple) else value

    def value(self, label: Any) -> Any:
        """What Optuna keeps as `label`."""
        return next(value for value in self.values if self.label(value) == label)

    def __str__(self) -> str:
        return ",".join(v if isinstance(v, str) else json.dumps(v) for v in self.values)


Span = Range | Choices


def span_of(text: str) -> tuple[str, Span]:
    """A searched setting as typed: "trpo.max_kl=log 0.003..0.1", "ensemble.members=1,3,5".

    Raises `ConfigError` for an unknown setting or another form.
    """
    name, equals, values = (part.strip() for part in text.partition("="))
    if not equals or not name or not values:
        raise ConfigError(f"search: expected NAME={_FORMS}; got {text!r}")
    return name, span(name, values if ".." in values else values_of(f"{name}={values}")[1])


def span(name: str, values: Any) -> Span:
    """What setting `name` is searched over: a range as text, or a list of choices.

    Raises `ConfigError` for an unknown setting, another form, or what the setting cannot be.
    """
    kind = _kind(name)
    if isinstance(values, str):
        return _range(name, kind, values)
    if not isinstance(values, list | tuple):
        raise ConfigError(f"search: {name}: expected {_FORMS}; got {values!r}")
    choices = tuple(tuple(v) if isinstance(v, list) else v for v in values)
    if kind is float:  # 1 and 1.0 are one choice
        choices = tuple(float(v) if type(v) is int else v for v in choices)
    if len(set(choices)) < max(len(choices), 2):
        raise ConfigError(f"search: {name}: expected at least two choices, each once, got {values}; --set fixes one")
    return Choices(choices)


def _range(name: str, kind: Any, text: str) -> Range:
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"search: {name}: expected {_FORMS}; got {text!r}")
    if kind not in (int, float):
        raise ConfigError(
            f"search: {name}: expected choices, because it is no number (see: metrpo train --help-all); got {text!r}"
        )
    try:
        low, high = kind(match["low"]), kind(match["high"])
        step = kind(match["step"]) if match["step"] else None
    except ValueError:
        raise ConfigError(f"search: {name}: expected whole numbers, got {text!r}") from None
    if not -math.inf < low < high < math.inf:
        raise ConfigError(f"search: {name}: expected two finite numbers, the lower one first, got {text!r}")
    if match["log"] and (low <= 0 or step):
        raise ConfigError(f"search: {name}: expected log of numbers above 0 and without a step, got {text!r}")
    result = Range(low, high, bool(match["log"]), step)
    if step is not None and (step <= 0 or not result.holds(high)):
        raise ConfigError(f"search: {name}: expected a whole number of steps from {low} to {high}, got {text!r}")
    return result


def _kind(name: str) -> Any:
    """The type of a setting, of one that may be None the other type."""
    kind: Any = Config
    for part in name.split("."):
        hints = types_of(kind) if dataclasses.is_dataclass(kind) else {}
        if part not in hints:
            raise ConfigError(f"search: unknown setting {name!r} (see: metrpo train --help-all)")
        kind = hints[part]
    return typing.get_args(kind)[0] if isinstance(kind, types.UnionType) else kind
