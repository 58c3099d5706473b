"""Calls between the package's modules in a small run, as a tree: `python benchmarks/tools/ways.py [MODULE.FUNCTION]`.

`docs/concepts.md`, "Three ways through the code", is an extract of it. A function is printed when a function of another
module calls it, and once below each caller. With an argument, only what that function leads to.
"""

from __future__ import annotations

import sys
import tempfile
from types import FrameType
from typing import Any

import metrpo

Tree = dict[str, Any]


def name_of(frame: FrameType) -> str | None:
    """Module and qualified name of a function of the package; None for others and for what is defined in functions."""
    module, name = frame.f_globals.get("__name__", ""), frame.f_code.co_qualname
    inner = "<" in name or name.startswith("_") or "._" in name
    return f"{module.removeprefix('metrpo.')}.{name}" if module.startswith("metrpo.") and not inner else None


def trace(tree: Tree, into: str | None) -> None:
    """Fills `tree` with the calls of this thread from now on."""
    stack: list[tuple[FrameType, Tree]] = []

    def follow(frame: FrameType, event: str, _: object) -> None:
        if event == "return" and stack and stack[-1][0] is frame:
            stack.pop()
        if event != "call" or (name := name_of(frame)) is None:
            return
        if stack or into is None or name == into:
            inside = stack[-1][1] if stack else tree
            stack.append((frame, inside.setdefault(name, {})))

    sys.setprofile(follow)


def show(tree: Tree, indent: int = 0, module: str = "") -> None:
    """Prints it; calls within a module are not shown, what they lead to is."""
    for name, inner in tree.items():
        own = name.rpartition(".")[0]
        if own != module:
            print("  " * indent + name)
        show(inner, indent + (own != module), own)


def main() -> None:
    """One iteration on Pendulum with tiny models."""
    config = metrpo.preset("Pendulum-v1", iterations=1)
    tiny = {"ensemble.hidden": (8,), "fit.max_steps": 10, "imagine.steps": 400, "validate.max_updates": 5}
    config = metrpo.presets.override(config, tiny)
    tree: Tree = {}
    with tempfile.TemporaryDirectory() as directory:
        trace(tree, sys.argv[1] if len(sys.argv) > 1 else None)
        metrpo.train(config, f"{directory}/run", metrpo.SILENT)
        sys.setprofile(None)
    show(tree)


if __name__ == "__main__":
    main()
