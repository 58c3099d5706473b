"""The search of a command line."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, cast

from metrpo.errors import ConfigError
from metrpo.launch.grid import require_once, seeds_of, values_of
from metrpo.tune.search import Search
from metrpo.tune.space import span_of

if TYPE_CHECKING:
    from metrpo.commands.options import Tune


def as_typed(command: Tune) -> Search:
    """The search of a command line. Raises `ConfigError` for what is none, or what `Search` raises."""
    searched, fixed = [span_of(text) for text in command.search], [values_of(text) for text in command.set]
    require_once("search", [name for name, _ in searched])
    require_once("set", [name for name, _ in fixed])
    if several := [name for name, values in fixed if len(values) != 1]:
        raise ConfigError(f"set: {several[0]}: expected one value, got several; --search chooses among them")
    names = [f.name for f in dataclasses.fields(Search) if f.name not in ("space", "settings", "seeds")]
    return Search(
        **cast(Any, {name: getattr(command, name) for name in names}),
        space=dict(searched),
        seeds=seeds_of(",".join(command.seeds)),
        settings={name: values[0] for name, values in fixed},
    )
