"""Keyword arguments of an environment as a setting: texts KEY=VALUE, whose value is JSON, or a text as it stands."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from metrpo.errors import ConfigError
from metrpo.safe_load import brief, json_of

_PYTHONS = {"True": True, "False": False, "None": None}
"""Words that Python users type for JSON's."""


def canonical(given: Iterable[str] | Mapping[str, Any]) -> tuple[str, ...]:
    """The keyword arguments by name, each written in one way: equal arguments are equal texts.

    Raises `ConfigError` for what is no KEY=VALUE, a key that is no Python name, or one that is given twice.
    """
    if isinstance(given, Mapping):
        pairs = [(str(key), value) for key, value in given.items()]
    else:
        pairs = [_pair(text) for text in given]
    if twice := [key for i, (key, _) in enumerate(pairs) if key in dict(pairs[:i])]:
        raise ConfigError(f"env_kwargs: expected each argument once, got {twice[0]} twice; leave one out")
    return tuple(sorted(f"{key}={_text(key, value)}" for key, value in pairs))


def keywords(env_kwargs: Iterable[str]) -> dict[str, Any]:
    """The keyword arguments as Python values: `("g=5.0",)` is `{"g": 5.0}`. Raises `ConfigError` as `canonical`."""
    return dict(_pair(text) for text in env_kwargs)


def _pair(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.isidentifier():
        raise ConfigError(f"env_kwargs: expected KEY=VALUE, such as g=5.0 or mode=easy, got {brief(text)}")
    return key, _value(value)


def _value(text: str) -> Any:
    if text in _PYTHONS:
        return _PYTHONS[text]
    try:
        return json_of(text, "", ConfigError)
    except ConfigError:
        return text


def _text(key: str, value: Any) -> str:
    """The value as `_value` reads it: JSON, and a text that could not be taken for JSON as it stands."""
    if isinstance(value, str) and _value(value) == value and isinstance(_value(value), str):
        return value
    try:
        return json.dumps(value, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"env_kwargs: {key}: expected numbers, texts, lists or dicts of them ({error})") from None
