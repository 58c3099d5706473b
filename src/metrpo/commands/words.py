"""The words of a command line: lists in their several spellings, and the error where the words make no sense."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import io
import os
import re
import typing
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Annotated, TypeVar

import tyro

from metrpo.commands.options import RunOptions
from metrpo.errors import ConfigError

T = TypeVar("T")
_KINDS = {"INT": "a whole number", "FLOAT": "a number"}
_BUDGET = ("--iterations", "--real-steps")
_NEEDS = {
    "DIR": ("a run directory", ""),
    "TASK": ("a task", "; metrpo tasks lists them"),
    "FIGURE": ("a figure", "; metrpo reproduce --help lists them"),
}
"""A command's positional word -> what it is, and how to find one."""


def joined(arguments: Sequence[str], lists: Collection[str]) -> list[str]:
    """The arguments with every option among `lists` once: `--set a --set b`, `--set=a --set b` become `--set a b`."""
    parts: list[str | list[str]] = []
    values_of: dict[str, list[str]] = {}
    open_list: list[str] | None = None
    for word in arguments:
        option, equals, value = word.partition("=")
        option = option.replace("_", "-")
        if word.startswith("-"):
            open_list = None
        if option in lists:
            if option not in values_of:
                values_of[option] = [option]
                parts.append(values_of[option])
            values_of[option] += [value] if equals else []
            open_list = None if equals else values_of[option]
        elif open_list is not None:
            open_list.append(word)
        else:
            parts.append(word)
    return [word for part in parts for word in (part if isinstance(part, list) else [part])]


def lists_of(kind: type) -> set[str]:
    """The options of a command that take several values."""
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = [f for f in dataclasses.fields(kind) if isinstance(f.default, tuple)]
    return {option for f in fields for option in _spelt(f.name, hints[f.name])}


def _spelt(name: str, hint: object, prefix: str = "") -> list[str]:
    """How an option is typed: by its field's name, or as its mark `arg` says."""
    marks = getattr(hint, "__metadata__", ())
    own = next((mark.name for mark in marks if getattr(mark, "name", None)), name.replace("_", "-"))
    return [f"--{prefix}{own}", *(alias for mark in marks for alias in getattr(mark, "aliases", None) or ())]


def command_of(arguments: Sequence[str], commands: Collection[str]) -> str:
    """The command that is typed. Raises `ConfigError` for an unknown one, and suggests the nearest."""
    word = arguments[0]
    if word in commands:
        return word
    if word.startswith("-"):
        raise ConfigError(f"expected a command before {word}, such as train; metrpo --help lists them")
    near = difflib.get_close_matches(word, commands, 1)
    raise ConfigError(f"unknown command {word!r}{_meant(near)} metrpo --help lists them")


def understood(parse: Callable[[], T], kind: type, arguments: Sequence[str]) -> T:
    """What `parse` returns. Where it would print a complaint and exit with 2, raises `ConfigError` in one line instead.

    `kind` is the command's class, `arguments` are its words.
    """
    _require_one_budget(arguments)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed), _wide():
            return parse()
    except SystemExit as end:
        if not end.code:
            raise
    if needed := _needed(printed.getvalue(), kind, arguments):
        raise ConfigError(needed) from None
    raise ConfigError(f"{arguments[0]}: {_complaint(printed.getvalue(), kind, arguments)}") from None


def _require_one_budget(arguments: Sequence[str]) -> None:
    words = [part for word in arguments for part in (word.split("=", 1) if word.startswith("--") else (word,))]
    options = [word.replace("_", "-") for word in words]
    # No real steps at all: learning from a log alone, for so many iterations.
    from_log = "--real-steps" in options[:-1] and options[options.index("--real-steps") + 1] == "0"
    if all(option in options for option in _BUDGET) and not from_log:
        raise ConfigError(f"{arguments[0]}: expected {' or '.join(_BUDGET)}, got both; leave one out")


def _needed(text: str, kind: type, arguments: Sequence[str]) -> str | None:
    """What to type where the command's positional word is missing, or given as an option; else None."""
    command = arguments[0]
    for name, metavar in _positionals(kind):
        if any(word.partition("=")[0] == f"--{name}" for word in arguments):
            return f"{command} takes {metavar} without --{name}: metrpo {command} {metavar}"
        if re.search(rf"^\W*Required .*\n(?:.*\n)*?\W*{re.escape(metavar)} ", text, re.MULTILINE):
            what, more = _NEEDS.get(metavar, (metavar, ""))
            return f"{command} needs {what}: metrpo {command} {metavar}{more}"
    return None


def _positionals(kind: type) -> Iterator[tuple[str, str]]:
    """Name and metavar of each positional word of a command."""
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        marks = getattr(hint, "__metadata__", ())
        if tyro.conf.Positional in marks:
            yield name, next(mark.metavar for mark in marks if getattr(mark, "metavar", None))


def _complaint(text: str, kind: type, arguments: Sequence[str]) -> str:
    """The parser's complaint (a title and paragraphs between rules) in one line."""
    bare = (line.strip("│|╭╮╰╯─+- ") for line in text.splitlines())
    title, *lines = [line for line in bare if line] or ["Nothing"]
    see = f"see metrpo {arguments[0]} {_help(kind)}"
    if title.startswith("Unrecognized"):
        return _unknown(kind, arguments)
    said = lines[0] if lines else title
    if wrong := re.match(r"Error parsing (--[\w.-]+)", said):
        usage = re.search(rf"^\W*{re.escape(wrong[1])} (.+?)\s*$", text, re.MULTILINE)
        expected = _KINDS.get(usage[1], usage[1]) if usage else "something else"
        return f"{wrong[1]}: expected {expected}, got {_given(wrong[1], arguments)}"
    if wrong := re.match(r"invalid choice '(.*)' for argument '(.*)'. Expected one of \((.*)\)", said):
        choices = [choice for part in wrong[3].split(",") if (choice := part.strip("' ")) not in ("", "None")]
        near = difflib.get_close_matches(wrong[1], choices, 1)
        return f"{wrong[2]}: expected one of {', '.join(choices)}, got {wrong[1]}{_meant(near).rstrip(';')}"
    if wrong := re.match(r"Missing value for argument '(.*)'", said):
        return f"{wrong[1]}: expected a value, got none; {see}"
    return f"{said.rstrip('!.')}; {see}"


def _given(option: str, arguments: Sequence[str]) -> str:
    """The last words given for `option`."""
    values: list[str] = []
    current = None
    for word in arguments:
        name, equals, value = word.partition("=")
        if word.startswith("--"):
            current = name.replace("_", "-")
            values = ([value] if equals else []) if current == option else values
        elif current == option:
            values.append(word)
    return " ".join(values) or "nothing"


def options_of(kind: type, prefix: str = "") -> list[str]:
    """Every option of a command's class, as it is typed."""
    hints, options = typing.get_type_hints(kind, include_extras=True), list[str]()
    for field in dataclasses.fields(kind):
        hint, marks = hints[field.name], getattr(hints[field.name], "__metadata__", ())
        base = hint.__origin__ if typing.get_origin(hint) is Annotated else hint
        if tyro.conf.Positional in marks:
            continue
        name = prefix + field.name.replace("_", "-")
        if isinstance(base, type) and dataclasses.is_dataclass(base):
            options += options_of(base, prefix if tyro.conf.OmitArgPrefixes in marks else f"{name}.")
        else:
            options += [f"--no-{name}"] if field.default is True else _spelt(field.name, hint, prefix)
            if base is bool and tyro.conf.FlagCreatePairsOff not in marks:
                options.append(f"--{prefix}no-{name.removeprefix(prefix)}")
    return options


def _unknown(kind: type, arguments: Sequence[str]) -> str:
    command, options = arguments[0], options_of(kind)
    for word in arguments[1:]:
        option = word.partition("=")[0].replace("_", "-")
        if not option.startswith("-") or option in options or re.match(r"-[\d.]", option):
            continue
        short = [o for o in options if o.rpartition(".")[2] == option.lstrip("-")]
        near = short[:1] or difflib.get_close_matches(option, options, 1)
        return f"unknown option {word.partition('=')[0]}{_meant(near)} metrpo {command} {_help(kind)} lists them"
    return f"expected fewer words without an option; see metrpo {command} --help"


def _help(kind: type) -> str:
    """The option that lists all of a command's options."""
    return "--help-all" if issubclass(kind, RunOptions) else "--help"


def _meant(near: Sequence[str]) -> str:
    return f", did you mean {near[0]}?" if near else ";"


@contextlib.contextmanager
def _wide() -> Iterator[None]:
    """Output in this block is not wrapped."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
