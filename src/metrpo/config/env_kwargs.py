"""Keyword arguments of an environment as a setting: strings KEY=VALUE, where VALUE is JSON or a plain string."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from metrpo.errors import ConfigError
from metrpo.safe_load import brief, json_of

_PYTHONS = {"True": True, "False": False, "None": None}
"""Words that Python users type for JSON's."""


def canonical(arguments: Iterable[str] | Mapping[str, Any]) -> tuple[str, ...]:
    """The keyword arguments, sorted and each written in one way, so that equal arguments are equal strings.

    Raises `ConfigError` for what is no KEY=VALUE, a key that is no Python name, or a repeated key.
    """
    if isinstance(arguments, Mapping):
        pairs = [(str(key), value) for key, value in arguments.items()]
    else:
        pairs = [_pair(text) for text in arguments]
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
    """The value as `_value` reads it: JSON, or the plain string where it cannot be mistaken for JSON."""
    if isinstance(value, str) and _value(value) == value and isinstance(_value(value), str):
        return value
    try:
        return json.dumps(value, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"env_kwargs: {key}: expected numbers, strings, lists or dicts of them ({error})") from None
