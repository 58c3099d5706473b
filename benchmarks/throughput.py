"""Four runs by `metrpo sweep`, so many at a time: what sharing the cores is worth.

    python benchmarks/throughput.py --out results/performance/throughput.json

makes the same four runs one after another (each with all cores) and at a time (each with its share), in turns, into
folders that are thrown away, and writes the seconds of every turn. Nothing else should run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from metrpo.run.files import source_commit
from metrpo.run.machine import cores

GRID = ["--tasks", "Swimmer", "--seeds", "0:4", "--set", "iterations=1"]


def seconds(jobs: int) -> float:
    """How long the four runs take, `jobs` at a time."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "metrpo", "sweep", *GRID, "--jobs", str(jobs), "--out", out]
        began = time.monotonic()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ | {"MUJOCO_GL": "disabled"})
        return time.monotonic() - began


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("throughput.json"))
    given = parser.parse_args()
    at_a_time = (1, cores())
    seconds(cores())  # compiles what all later turns find in the cache
    taken: dict[int, list[float]] = {jobs: [] for jobs in at_a_time}
    for turn in range(given.rounds):
        for jobs in at_a_time if turn % 2 == 0 else reversed(at_a_time):
            taken[jobs].append(seconds(jobs))
            print(f"{jobs} at a time: {taken[jobs][-1]:.1f} s", flush=True)
    ratio = statistics.median(one / several for one, several in zip(*taken.values(), strict=True))
    record = {
        "command": f"metrpo sweep {' '.join(GRID)} --jobs N",
        "seconds": taken,
        "one_after_another_over_at_a_time": ratio,
        "cores": cores(),
        "machine": platform.machine(),
        "commit": source_commit(),
    }
    given.out.write_text(json.dumps(record, indent=2) + "\n")
    print(f"one after another takes {ratio:.2f} times as long")


if __name__ == "__main__":
    main()
