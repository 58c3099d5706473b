"""A policy for machines without metrpo: a Python file that needs only NumPy, an ONNX graph, or a copy of its arrays."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from keyword import iskeyword
from pathlib import Path
from typing import Any

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.policy_zoo import is_name, located
from metrpo.run.files import atomic_write, metrpo_version
from metrpo.run.loaded_policy import LoadedPolicy
from metrpo.run.onnx_export import onnx_model
from metrpo.run.policy_file import FILE, load_policy, with_interface
from metrpo.run.python_export import python_source
from metrpo.run.python_template import SOURCE
from metrpo.safe_load import opened

_Writer = Callable[[LoadedPolicy, Path], bytes | str]
_TAKEN = sys.stdlib_module_names | {"numpy"}
"""A file of one of these names would stand in for that module, in what it imports itself and in its neighbours."""


def export(run_dir: Path, out: Path | None = None) -> Path:
    """Writes a run's policy to `out` (.py, .onnx or .npz; default: `policy.py` in the run directory) and returns it.

    All three map observations [B, O] to actions [B, A] in [-1, 1], as `load_policy` does; the .py also [O] to [A], and
    its `control` to the environment's own range. They say how observations are laid out, and that range. A history the
    .py and the .npz keep by themselves; an .onnx, which cannot, takes whole states [B, S] and says their layout.

    Raises `MetrpoError` for another ending, a name that Python cannot import, a .py file in the way that is not ours,
    or when the onnx package is missing, `RunDirectoryError` when there is no policy, it is damaged, or `out` cannot be
    written.
    """
    if out is None and is_name(run_dir):
        raise MetrpoError(f"{run_dir}: expected --out, because this is no run directory; add --out policy.py")
    run_dir = located(run_dir)
    source = run_dir if run_dir.suffix == ".npz" else run_dir / FILE
    out = source.with_name("policy.py") if out is None else out
    if out.suffix not in _WRITERS:
        raise MetrpoError(f"{out}: expected a name that ends in {', '.join(_WRITERS)}; got {out.suffix or 'no ending'}")
    if out.suffix == ".py":
        _require_importable(out)
    policy = _completed(load_policy(run_dir))
    if out.suffix == ".py" and out.is_file() and not _is_ours(out):
        raise MetrpoError(f"{out} exists and is no exported policy; choose another name, or remove it first")
    atomic_write(out, _WRITERS[out.suffix](policy, source))
    return out


def _require_importable(out: Path) -> None:
    """Raises `MetrpoError` for a file that no `import` can name, or that stands in the way of what it imports."""
    if _is_importable(out.stem):
        return
    better = re.sub(r"\W+", "_", out.stem).strip("_").lstrip("0123456789_")
    better = better if _is_importable(better) else f"{better or 'my'}_policy"
    expected = "no module of Python or NumPy" if out.stem in _TAKEN else "a name that Python can import"
    raise MetrpoError(f"{out}: expected {expected}, such as {better}.py, got {out.name}")


def _is_importable(name: str) -> bool:
    return name.isidentifier() and not iskeyword(name) and name not in _TAKEN


def _completed(policy: LoadedPolicy) -> LoadedPolicy:
    """A policy from before its file said what its environment shows and takes, with that of a task of ours."""
    if policy.info.observation is not None:
        return policy
    from metrpo.world.registry import get_task, tasks
    from metrpo.world.tasks.gymnasium_formulas import KNOWN

    name = policy.info.task
    if name not in KNOWN and name not in tasks():  # to ask a file of somebody's would run it
        return policy
    return replace(policy, info=with_interface(policy.info, get_task(name).interface))


def _is_ours(path: Path) -> bool:
    start = SOURCE[:40].encode()
    with opened(path, RunDirectoryError) as file:
        return file.read(len(start)) == start


def _info(policy: LoadedPolicy, source: Path) -> dict[str, Any]:
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    info = {**asdict(policy.info), "metrpo": metrpo_version(), "policy_sha256": digest}
    # NaN and infinity are JSON to Python, but neither Python literals nor JSON to anybody else.
    return dict(json.loads(json.dumps(info), parse_constant=lambda _: None))


_WRITERS: dict[str, _Writer] = {
    ".py": lambda policy, source: python_source(policy, _info(policy, source)),
    ".onnx": lambda policy, source: onnx_model(policy, _info(policy, source)),
    ".npz": lambda _, source: source.read_bytes(),
}
