"""Runs the code of a notebook without Jupyter, which would bring thirty packages: `python notebooks.py FILE.ipynb`.

Cells are plain Python; of IPython's magics, `%%writefile NAME` alone is known.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path


def cells(notebook: Path) -> list[dict]:
    """Its cells of code."""
    return [cell for cell in json.loads(notebook.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]


def run(notebook: Path) -> None:
    """Runs them in the current folder, one after the other."""
    names = {"__name__": "__main__"}
    sys.path.insert(0, os.getcwd())
    for number, cell in enumerate(cells(notebook), 1):
        source = "".join(cell["source"])
        first, _, rest = source.partition("\n")
        if first.startswith("%%writefile "):
            Path(first.split()[1]).write_text(rest)
            continue
        exec(compile(source, f"{notebook.name}, cell {number}", "exec"), names)


if __name__ == "__main__":
    run(Path(sys.argv[1]).resolve())
