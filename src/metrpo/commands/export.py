"""`metrpo export` writes a policy as one file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Export:
    """Write a run's policy as one file that runs without metrpo: Python with only NumPy, or ONNX.

    For example:
        metrpo export runs/Swimmer-fast-seed0
        metrpo export runs/Swimmer-fast-seed0 --out swim.py && python swim.py
        metrpo export runs/Swimmer-fast-seed0 --out swim.onnx
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory, its folder best/ (the policy that earned most), zoo:NAME (see: metrpo zoo), or hub:OWNER/NAME
    on the Hugging Face hub."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """File to write, .py, .onnx or .npz; missing folders are created; default: policy.py in the run directory."""


def run(command: Export) -> int:
    """Returns the exit code."""
    from metrpo.run.policy_export import export

    print(export(command.dir, command.out))
    return 0
