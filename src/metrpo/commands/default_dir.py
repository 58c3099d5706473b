"""The default run directory: one folder for each way to run a task, whose name says the way."""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

from metrpo.config import Config, difference, from_json
from metrpo.counting import named_value
from metrpo.errors import ConfigError
from metrpo.presets import changed
from metrpo.run.files import folder_name

_MOST, _LONGEST = 3, 60
"""How many settings a name spells out at most, and in how many letters."""


def default_run_dir(config: Config) -> Path:
    """`runs/TASK-[SYSTEM-]PRESET-seedSEED`, then the settings that are not the preset's, budget aside.

    The same settings always give the same folder. Where the name would grow too long, a hash stands for them.
    """
    system = "" if config.system == "me-trpo" else f"{config.system}-"
    plain = Path("runs") / f"{folder_name(config.task)}-{system}{config.preset}-seed{config.seed}"
    values = {name: value for name, value in changed(config).items() if name != "seed"}
    if not values or _is_run_of(plain, config):  # metrpo 0.1 put every run there
        return plain
    return plain.with_name(f"{plain.name}-{_words(values)}")


def _words(values: dict[str, Any]) -> str:
    words = ",".join(f"{name}={_word(value)}" for name, value in values.items())
    if len(values) <= _MOST and len(words) <= _LONGEST:
        return words
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    return f"{len(values)}-settings-{digest[:8]}"


def _word(value: Any) -> str:
    return folder_name(named_value(value))


def _is_run_of(folder: Path, config: Config) -> bool:
    with contextlib.suppress(OSError, UnicodeDecodeError, ConfigError):
        return not difference(from_json((folder / "config.json").read_text()), config)
    return False
