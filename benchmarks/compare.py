"""Systems side by side: `python benchmarks/compare.py SYSTEM_DIR... [--columns return_real gap] [--out FILE.png]`.

A system directory holds `seed-*/metrics.csv`, as in `results/`. One panel for each column, against real steps: every
seed as a thin line, their mean as a thick one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from metrpo import read_metrics


def draw(axes: Axes, systems: list[Path], column: str) -> None:
    """One panel."""
    for number, system in enumerate(systems):
        runs = [read_metrics(path) for path in sorted(system.glob("seed-*/metrics.csv"))]
        length = min(len(run) for run in runs)
        values = np.array([[row[column] for row in run[:length]] for run in runs], dtype=float)
        steps = np.mean([[row["real_steps"] for row in run[:length]] for run in runs], axis=0) / 1000
        for line in values:
            axes.plot(steps, line, color=f"C{number}", linewidth=0.8, alpha=0.5)
        label = f"{system.name} ({len(runs)} seeds)"
        axes.plot(steps, values.mean(axis=0), "o-", color=f"C{number}", linewidth=2.2, markersize=4, label=label)
    if column == "gap":
        axes.axhline(0, color="#333333", linewidth=0.8)
        # Early models may promise a hundredfold, which must not flatten the rest.
        axes.set_yscale("symlog", linthresh=10)
    axes.set_xlabel("real steps (thousands)")
    axes.set_ylabel(column)
    axes.grid(True, color="#dddddd", linewidth=0.7)
    axes.legend(frameon=False)


def main() -> None:
    """Draws the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", type=Path, nargs="+")
    parser.add_argument("--columns", nargs="+", default=["return_real", "gap"])
    parser.add_argument("--out", type=Path, default=Path("comparison.png"))
    arguments = parser.parse_args()
    figure = Figure(figsize=(6 * len(arguments.columns), 4.5), dpi=130, layout="constrained")
    for axes, column in zip(
        figure.subplots(1, len(arguments.columns), squeeze=False)[0], arguments.columns, strict=True
    ):
        draw(axes, arguments.systems, column)
    figure.savefig(arguments.out)
    print(arguments.out)


if __name__ == "__main__":
    main()
