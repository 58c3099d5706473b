"""Whether a change of the code changed what it computes: small deterministic runs, as hashes of what they write.

    git stash; python benchmarks/tools/same_runs.py --out before.json; git stash pop
    python benchmarks/tools/same_runs.py --against before.json

Two iterations of every improver, sampling and rule, of a learned reward, of a long horizon and of the baselines that
need no other library. Hashed are the arrays of every policy and checkpoint and the rows of the metrics, clock readings
left out. The exit code is 1 where a hash differs. Some ten minutes on one core.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

SMALL = [
    *("--collect.steps", "400", "--fit.max-steps", "40", "--imagine.steps", "2000", "--validate.max-updates", "10"),
    *("--validate.starts", "10", "--evaluation-episodes", "2", "--iterations", "2", "--deterministic", "--no-video"),
    *("--ensemble.hidden", "32", "32"),
]
RUNS: dict[str, str] = {
    "Swimmer": "Swimmer",
    "Swimmer-paper": "Swimmer --preset paper",
    "Pendulum-learned": "Pendulum-v1 --learn-reward",
    "mbbl-long-horizon": "mbbl/HalfCheetah --preset long-horizon",
    "curious": "Swimmer --imagine.disagreement 0.1",
    **{name: f"Swimmer --improver {name}" for name in ("ppo", "vpg", "bptt", "bptt-stochastic")},
    **{
        name: f"Swimmer --imagine.sampling {name}"
        for name in ("model_mean_std", "model_mean", "model_med", "eps_rand", "one_model")
    },
    **{f"rule-{name}": f"Swimmer --validate.rule {name}" for name in ("one_model", "real", "trpo_mean", "no_early")},
    "system-trpo": "HalfCheetah --system trpo",
    "system-svg-1": "Swimmer --system svg-1",
    "system-svg-inf": "Swimmer --system svg-inf",
}


def run(name: str, folder: Path) -> dict[str, str]:
    """Runs one row and returns a hash for each thing that it wrote."""
    out = folder / name
    words = [sys.executable, "-m", "metrpo", "train", *RUNS[name].split(), *SMALL, "--run-dir", str(out)]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        return {"exit": f"{done.returncode}: {done.stderr.strip()[-300:]}"}
    return hashes(out)


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of the arrays in every .npz and of the rows in every .csv under `folder`, clock readings left out."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".npz":
            found[str(path.relative_to(folder))] = _of_arrays(path)
        elif path.suffix == ".csv":
            found[str(path.relative_to(folder))] = _of_rows(path)
    return found


def _of_arrays(path: Path) -> str:
    digest = hashlib.sha256()
    with np.load(path, allow_pickle=False) as arrays:
        for key in sorted(set(arrays.files) - {"meta.json"}):  # it holds settings, the version and clock readings
            if arrays[key].dtype.kind in "biufc":
                digest.update(f"{key} {arrays[key].dtype} {arrays[key].shape}".encode() + arrays[key].tobytes())
    return digest.hexdigest()[:16]


def _of_rows(path: Path) -> str:
    with path.open() as lines:
        rows = [
            {k: v for k, v in row.items() if not k.startswith("seconds_") and k != "wall_seconds"}
            for row in csv.DictReader(lines)
        ]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()[:16]


def main() -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="file for the hashes, as JSON")
    parser.add_argument("--against", type=Path, help="hashes of before")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("names", nargs="*", default=[], help=f"only some of {', '.join(RUNS)}")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        names = given.names or list(RUNS)
        found = dict(zip(names, pool.map(lambda name: run(name, Path(folder)), names), strict=True))
    if given.out:
        given.out.write_text(json.dumps(found, indent=1) + "\n")
    if not given.against:
        print(json.dumps(found, indent=1))
        return 0
    before = json.loads(given.against.read_text())
    for name in names:
        print(f"{name:<20} {'same' if found[name] == before[name] else f'DIFFERS: {before[name]} -> {found[name]}'}")
    return int(any(found[name] != before[name] for name in names))


if __name__ == "__main__":
    sys.exit(main())
