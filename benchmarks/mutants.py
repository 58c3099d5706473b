"""The mutants of a module that differ from it when they run, made by cosmic-ray's operators; for `mutation.py`."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from itertools import count

from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

FIELDS = ("mutant", "line", "operator", "before", "after", "outcome", "by")


def mutants(source: str) -> Iterator[dict[str, str]]:
    """Every different mutant of `source`: a row of the record, and its text as `text`."""
    seen = {meaning(source)}
    for name in sorted(operator_names()):
        operator = get_operator(name)
        if operator.arguments():
            continue
        for occurrence in count():
            text = mutate_code(source, operator(), occurrence)
            if text is None:
                break
            if (what := meaning(text)) in seen or what is None:
                continue
            seen.add(what)
            old, new = source.splitlines(), text.splitlines()
            first = next(n for n, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
            same = next(n for n, (a, b) in enumerate(zip(reversed(old), reversed(new), strict=False)) if a != b)
            before, after = (" ".join(x.strip() for x in lines[first : len(lines) - same]) for lines in (old, new))
            digest = hashlib.sha256(what.encode()).hexdigest()[:12]
            cells = (digest, str(first + 1), name.removeprefix("core/"), before, after)
            yield dict(zip(FIELDS, cells, strict=False)) | {"text": text}


def meaning(text: str) -> str | None:
    """What a module does, as text: its syntax tree without annotations and docstrings; None where it has none."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return ast.dump(tree)
