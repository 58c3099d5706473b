"""Every command: its group, its name and what it does. The file of that name holds the rest.

`metrpo train` is `train.py`: the dataclass `Train`, which tyro turns into a parser, and `run(Train)`, which returns
the exit code. To add a command, write its file and add its row here.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

COMMANDS: dict[str, dict[str, str]] = {
    "Learn": {
        "train": "Learn a task, or resume a run",
        "tasks": "List the tasks to learn",
    },
    "Look": {
        "watch": "Show the progress of many runs, live",
        "report": "Write one HTML page: curves, warnings, videos",
        "plot": "Draw learning curves",
        "compare": "Compare runs in a table",
    },
    "Use": {
        "zoo": "List the trained policies that come with metrpo",
        "evaluate": "Play real episodes and report their returns",
        "render": "Record an episode as a video",
        "export": "Write the policy as one file that needs no metrpo",
        "push": "Upload the policy to the Hugging Face hub",
    },
    "Many runs": {
        "sweep": "Run a grid of tasks, seeds and settings",
        "tune": "Search over settings",
        "reproduce": "Run and draw a figure of the paper",
    },
    "Your robot": {
        "init": "Start a run whose episodes your own program plays",
        "collect": "Add real episodes to a run",
        "improve": "Learn from the new episodes, in one iteration",
    },
    "This machine": {
        "doctor": "Check versions, devices, OpenGL, video encoder",
        "bench": "Measure how fast this machine runs metrpo",
    },
}
"""Purpose -> command -> what it does, in a few words."""

NAMES = tuple(name for commands in COMMANDS.values() for name in commands)


def options_class(name: str) -> type:
    """The options of a command, as a dataclass."""
    return getattr(importlib.import_module(f"metrpo.commands.{name}"), name.capitalize())


def handler(name: str) -> Callable[[Any], int]:
    """What runs a command with its options and returns the exit code."""
    return importlib.import_module(f"metrpo.commands.{name}").run
