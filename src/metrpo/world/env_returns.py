"""Checks that a real environment returns what Gymnasium promises; every call of an environment goes through here."""

from __future__ import annotations

import decimal
import logging
import numbers
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from metrpo.errors import MetrpoError, TaskError

_log = logging.getLogger("metrpo")
Env = TypeVar("Env", bound=Any)
_MOST = float(np.finfo(np.float32).max) / 2
"""Beyond this, the difference of two numbers may be infinite in float32, in which everything is learned."""


_LONGEST = 100
"""Most characters of a returned value in a message."""


def representable(values: Any) -> bool:
    """Whether all are finite, and so are their differences in float32."""
    return bool(np.all(np.abs(values) <= _MOST))  # false for NaN


def after_reset(name: str, reset: Callable[[], Any]) -> tuple[Any, dict[str, Any]]:
    """The observation and the info (empty where it is no dict) of the environment `name`'s `reset()`.

    Raises `TaskError`, naming the environment, the call, what was expected and what was got, for anything else.
    """
    result = _call(name, "reset", reset)
    if not (isinstance(result, tuple) and len(result) == 2):
        raise broken(name, "reset()", "(observation, info)", result, "return both, as Gymnasium does since 0.26")
    observation, info = result
    return observation, _dict(info)


def after_step(name: str, step: Callable[[], Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Observation, reward, terminated, truncated and info (empty where it is no dict) of `step()`.

    The reward may not be finite. Raises `TaskError` as `after_reset`.
    """
    result = _call(name, "step", step)
    if not (isinstance(result, tuple) and len(result) == 5):
        expected = "(observation, reward, terminated, truncated, info)"
        raise broken(name, "step()", expected, result, "return all five, as Gymnasium does since 0.26")
    observation, reward, terminated, truncated, info = result
    number = _number(reward)
    if number is None:
        raise broken(name, "step()", "one finite number as reward", reward, "return float(reward)")
    for flag, value in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(value, bool | np.bool_):
            raise broken(name, "step()", f"a bool as {flag}", value, f"return bool({flag})")
    return observation, number, bool(terminated), bool(truncated), _dict(info)


def broken(
    name: str, call: str, expected: str, got: object, advice: str, kind: type[TaskError] = TaskError
) -> TaskError:
    """The error of an environment that breaks its promise."""
    gave = _cut(got, 400) if isinstance(got, str) else shown(got)
    return kind(f"{name}: {call}: expected {expected}, got {gave}; {advice}")


@contextmanager
def closing(env: Env, name: str) -> Iterator[Env]:
    """Closes an environment after the block. One that cannot be closed gives a warning, for its work is done.

    Within `warning_once`, the same warning is given once.
    """
    try:
        yield env
    finally:
        try:
            env.close()
        except Exception as error:
            text = f"{name}: close() raised {type(error).__name__}: {error}"
            if _warned is None or not _warned[text]:
                _log.warning("%s; nothing is lost", text)
            if _warned is not None:
                _warned[text] += 1


_warned: Counter[str] | None = None
"""How often each warning was due since `warning_once` began."""


@contextmanager
def warning_once() -> Iterator[None]:
    """Gives every warning of `closing` once in this block, and counts them at its end."""
    global _warned
    _warned, before = Counter(), _warned
    try:
        yield
    finally:
        for text, times in _warned.items():
            if times > 1:
                _log.warning("%s, %d times in all", text, times)
        _warned = before


def _call(name: str, what: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except MetrpoError:
        raise
    except Exception as error:
        raise TaskError(
            f"{name}: {what}() raised {type(error).__name__}: {error}; "
            "first make the environment run by itself (gymnasium.utils.env_checker.check_env helps)"
        ) from error


def array_of(value: Any) -> np.ndarray | None:
    """The value as an array of real numbers, in its own type; None where it is none."""
    try:
        array = np.asarray(value)
    except Exception:  # whatever somebody's type raises
        return None
    return array if array.dtype.kind in "biuf" else None


def _number(value: Any) -> float | None:
    array = array_of(value)
    if array is not None:
        return float(array.item()) if array.size == 1 else None
    try:
        return float(value) if isinstance(value, numbers.Real | decimal.Decimal) else None
    except (ValueError, OverflowError):
        return None


def _dict(info: Any) -> dict[str, Any]:
    # Nothing is read from it, so that it may be anything.
    return info if isinstance(info, dict) else {}


def shown(value: object) -> str:
    """What an environment has given, in at most a hundred characters: of a dict or a space of parts, its keys."""
    keys = getattr(value, "spaces", value)
    text = repr(value)
    if len(text) > _LONGEST and isinstance(keys, dict):
        text = f"a {type(value).__name__} of {', '.join(map(repr, keys))}"
    return _cut(text, _LONGEST)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."
