"""How the code is kept, in numbers: sizes, wide functions, names that stand twice, arrows up, privates in tests.

    python benchmarks/tools/house.py [--json] [FOLDER]

FOLDER is a checkout, this one unless it is given. `git archive TAG | tar x -C FOLDER` makes one of an earlier state.
"""

from __future__ import annotations

import argparse
import ast
import collections
import json
import re
import statistics
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

WIDE = 7
"""Parameters that a function may have."""
_DOCUMENTED = {"_replace", "_asdict", "_make", "_fields", "_exit"}
"""Of named tuples and of `os`: public in spite of their names."""
Function = ast.FunctionDef | ast.AsyncFunctionDef


def main() -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).resolve().parents[2])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    given = parser.parse_args()
    numbers = measure(given.folder)
    print(json.dumps(numbers, indent=1) if given.json else table(numbers))
    return 0


def measure(folder: Path) -> dict[str, object]:
    """Every number by its name; a list of names stands for its length."""
    files = {path.relative_to(folder): path.read_text() for path in sorted((folder / "src").rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in files.items()}
    lengths = {str(path): text.count("\n") for path, text in files.items()}
    sizes = {
        f"{path}:{f.name}": (f.end_lineno or 0) - f.lineno + 1 for path, tree in trees.items() for f in functions(tree)
    }
    modules = ((path.stem, path) for path in files if path.stem not in ("__init__", "__main__"))
    classes = ((name, path) for path, tree in trees.items() for name in public_classes(tree))
    tests = [path.read_text() for path in (folder / "tests").rglob("*.py")]
    return {
        "files": len(files),
        "lines": sum(lengths.values()),
        "lines of tests": sum(text.count("\n") for text in tests),
        "median file": statistics.median(lengths.values()),
        "longest file": longest(lengths),
        "files beyond 250 lines": [name for name, length in lengths.items() if length > 250],
        "median function": statistics.median(sizes.values()),
        "longest function": longest(sizes),
        "functions beyond 40 lines": [name for name, length in sizes.items() if length > 40],
        f"functions of more than {WIDE} parameters": [
            f"{path}:{f.name}" for path, tree in trees.items() for f in functions(tree) if parameters(f) > WIDE
        ],
        "module names that stand twice": twice(modules),
        "public class names that stand twice": twice(classes),
        "arrows up": arrows_up(folder),
        "private accesses in tests": sum(private_accesses(text) for text in tests),
    }


def functions(tree: ast.AST) -> Iterator[Function]:
    """All functions, methods and inner functions."""
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def parameters(function: Function) -> int:
    """How many a caller sees: `self` and `cls` do not count."""
    arguments = function.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def public_classes(tree: ast.Module) -> Iterator[str]:
    """Classes and aliases of types (`Row = dict[...]`) at the top of a module, without an underscore."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node.name
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript | ast.BinOp):
            yield from (t.id for t in node.targets if isinstance(t, ast.Name) and re.match(r"[A-Z][a-z]\w*$", t.id))


def twice(named: Iterable[tuple[str, Path]]) -> list[str]:
    """Names of more than one file, with the files."""
    places = collections.defaultdict(list)
    for name, path in named:
        places[name].append(str(path))
    return [f"{name}: {', '.join(paths)}" for name, paths in sorted(places.items()) if len(paths) > 1]


def longest(lengths: dict[str, int]) -> str:
    """The name of the longest, with its length."""
    name = max(lengths, key=lambda name: lengths[name])
    return f"{lengths[name]} ({name})"


def arrows_up(folder: Path) -> int | str:
    """Imports against the layers of pyproject.toml, as import-linter counts them."""
    command = [Path(sys.executable).with_name("lint-imports"), "--no-logo", "--no-cache"]
    try:
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, env={"PYTHONPATH": "src"})
    except OSError as error:
        return f"not measured: {error}"
    if not re.search(r"^Contracts: ", ran.stdout, re.MULTILINE):
        return f"not measured: {(ran.stdout + ran.stderr).strip()[-200:]}"
    return len(re.findall(r"^- +metrpo\S* -> metrpo", ran.stdout, re.MULTILINE))


def private_accesses(text: str) -> int:
    """`module._name` and `from module import _name`, but of `self` and `cls`, and but what Python documents."""
    attributes = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Attribute))
    outside = (a for a in attributes if not (isinstance(a.value, ast.Name) and a.value.id in ("self", "cls")))
    imported = (
        alias.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom) for alias in node.names
    )
    names = [*(a.attr for a in outside), *imported]
    return sum(bool(re.match(r"_[a-z]", name)) and name not in _DOCUMENTED for name in names)


def table(numbers: dict[str, object]) -> str:
    """One line a number; names below theirs."""
    lines = []
    for name, value in numbers.items():
        names = value if isinstance(value, list) else []
        lines.append(f"{name:<40} {len(names) if isinstance(value, list) else value}")
        lines += [f"    {one}" for one in names]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
