"""Everything that a machine with one NVIDIA GPU has to show, in eight minutes:

    python benchmarks/gpu_check.py --out gpu.json

writes to `--out`, after each part: the machine and the precision of matrix products; parity with the CPU
(`gpu_parity.py` says how it is judged); seconds per stage of the presets `paper` on Swimmer and HalfCheetah and `fast`
on HalfCheetah, with what was cut; and what `metrpo bench` measures of our own work. Each part is a process with a time
limit of its own: one that fails or takes too long leaves what it has written and the next one goes on. `--tiny` makes
everything small, for a test without a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from metrpo.run import machine
from metrpo.run.files import source_commit

PARTS = {"parity": 0.3, "paper Swimmer": 0.22, "paper HalfCheetah": 0.22, "bench": 0.35, "fast HalfCheetah": 0.5}
"""Most that a part may take of the time that is left of the whole when it begins."""
CUTS = {"paper": {"iterations": 3, "validate.max_updates": 50}, "fast": {"iterations": 3}}
"""What differs from a preset in its part: fewer outer iterations and, in `paper`, 50 of at most 400 updates in each."""
TINY_CUTS = {
    "collect.steps": 200,
    "ensemble.members": 2,
    "ensemble.hidden": (8,),
    "fit.max_passes": 5,
    "imagine.steps": 200,
    "validate.max_updates": 5,
    "validate.starts": 4,
    "evaluation_episodes": 1,
    "iterations": 1,
}
ROUNDS = 3
Save = Callable[[dict[str, Any]], None]


def stages(task: str, name: str, tiny: bool, seconds: float, save: Save) -> None:
    """Whole outer iterations of a preset, each with its seconds per stage, as many as there is time for."""
    from metrpo import training
    from metrpo.console.progress import PlainProgress
    from metrpo.presets import override, preset
    from metrpo.speed.measure import compilations

    end, rows = time.monotonic() + seconds, []
    cuts = TINY_CUTS if tiny else CUTS[name]
    config = override(preset(task, name), cuts)
    state, last, progress = training.init(config), 0.0, PlainProgress()
    while state.iteration < config.iterations and time.monotonic() + last < end:
        progress.begin(state.iteration + 1, config.iterations)
        start = time.monotonic()
        with compilations() as seen:
            state, row = training.step(config, state, progress)
        last = time.monotonic() - start
        progress.end(row)
        kept = ("real_steps", "return_real", "return_imagined", "updates", "accepted_updates", "fit_passes")
        times = {key: value for key, value in row.items() if key.startswith("seconds_")}
        update = (row["seconds_improve"] + row["seconds_validate"]) / max(row["updates"], 1)
        more = {
            "seconds": last,
            "compilations": len(seen),
            "seconds_compiling": sum(seen),
            "seconds_per_update": update,
        }
        rows.append({key: row[key] for key in kept} | times | more)
        save({"cut": {key: str(value) for key, value in cuts.items()}, "iterations": list(rows)})


def bench(tiny: bool, seconds: float, save: Save) -> None:
    """`metrpo bench` without peers, and variants that a GPU may want: TF32, and TRPO's batch in one piece."""
    import jax

    from metrpo.policy.improvers import linearised
    from metrpo.speed import measure, ours

    def in_one_piece() -> ours.Work:
        was = linearised.CHUNK
        linearised.CHUNK = ours.ROLLOUTS * ours.HORIZON
        try:
            return ours._trpo(ours.TRPOConfig())
        finally:
            linearised.CHUNK = was

    end, available = time.monotonic() + seconds, ours.works()
    makers: dict[str, tuple[Callable[[], ours.Work], str | None]] = {
        key: (make, None) for key, make in available.items()
    }
    for key in ("fit-1024", "imagine-1024", "trpo"):
        makers[f"{key}-tf32"] = (available[key], "tensorfloat32")
    makers["trpo-one-chunk"] = (in_one_piece, None)
    if tiny:
        makers = {key: makers[key] for key in ("trpo-1-cg",)}
    works: dict[str, ours.Work] = {}
    taken: dict[tuple[str, str], list[float]] = {}
    preparing: dict[str, float] = {}

    def tell() -> None:
        complete = {key: values for key, values in taken.items() if len(values) == max(map(len, taken.values()))}
        known = {k: w._replace(bound=w.bound if (w.bound, "metrpo") in complete else None) for k, w in works.items()}
        timings = [measure._timing(key, "metrpo", v, known, complete) for (key, _), v in complete.items()]
        save(
            {
                "text": measure.BenchReport({}, timings).text(),
                **measure.BenchReport(measure._machine(), timings).record(),
            }
        )

    def turn(key: str) -> None:
        precision = makers[key][1]
        with jax.default_matmul_precision(precision) if precision else nullcontext():
            if key not in works:
                start = time.monotonic()
                works[key] = makers[key][0]()
                preparing[key] = time.monotonic() - start
            taken.setdefault((key, "metrpo"), []).append(measure._turn(works[key].run))

    for number in range(1 if tiny else ROUNDS):
        for key in makers:
            if time.monotonic() > end - 5 and number:
                return
            turn(key)
            print(f"bench: round {number + 1}: {key}: {1e3 * taken[key, 'metrpo'][-1]:.2f} ms", flush=True)
            if number == 0:
                tell()
        tell()


def where(commit: str | None) -> dict[str, Any]:
    """The machine, its software, and the precision of matrix products: as JAX has it and as metrpo sets it."""
    import jax

    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,power.limit", "--format=csv,noheader"]
    try:
        driver = subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        driver = None
    names = ("jax", "jaxlib", "jax-cuda12-plugin", "jax-cuda13-plugin", "numpy", "optax", "mujoco", "gymnasium")
    return {
        "devices": machine.device_names(),
        "nvidia-smi (name, driver, memory, power limit)": driver,
        "cores": machine.cores(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in names},
        "commit": commit or source_commit(),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS"),
        "jax_default_matmul_precision": jax.config.jax_default_matmul_precision,
        "JAX_DEFAULT_MATMUL_PRECISION, set by metrpo unless the user did": os.environ.get(
            "JAX_DEFAULT_MATMUL_PRECISION"
        ),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def run_part(given: argparse.Namespace, scratch: Path) -> None:
    """One part, in a process of its own; writes what it has to `--out` as it goes."""

    def save(record: dict[str, Any]) -> None:
        partial = given.out.with_suffix(".partial")
        partial.write_text(json.dumps(record))
        partial.replace(given.out)

    if given.part in ("reference", "parity"):
        import gpu_parity

        size = gpu_parity.TINY if given.tiny else gpu_parity.Size()
        if given.part == "reference":
            return gpu_parity.reference(size, given.out)
        theirs = scratch / "reference.npz"
        gpu_parity.parity(size, gpu_parity.start_reference(Path(__file__), theirs, given.tiny), theirs, save)
    elif given.part == "where":
        save(where(given.commit))
    elif given.part == "bench":
        bench(given.tiny, given.seconds, save)
    else:
        name, task = given.part.split()
        stages(task, name, given.tiny, given.seconds, save)
    return None


def _environment(part: str) -> None:
    """Sets JAX's environment before it is imported: as `metrpo train` does, on the CPU alone for the reference."""
    if part == "reference":
        os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=1"  # as many devices as the GPUs: one
        machine.prepare("cpu", deterministic=False)
    else:
        if not machine.has_nvidia():
            os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=1")
        machine.prepare("gpu" if machine.has_nvidia() else None, deterministic=False)


def run_all(given: argparse.Namespace) -> None:
    """Every part within its time; the record is written after each."""
    began = time.monotonic()
    record: dict[str, Any] = {"command": "python benchmarks/gpu_check.py" + " --tiny" * given.tiny, "parts": {}}
    for part in ("where", *PARTS):
        left = given.seconds - (time.monotonic() - began)
        limit = 60.0 if part == "where" else PARTS[part] * left
        print(f"== {part}: at most {limit:.0f} s", flush=True)
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as scratch:
            out = Path(scratch) / "part.json"
            command = [sys.executable, __file__, "--part", part, "--out", str(out), "--seconds", str(limit - 5)]
            command += ["--tiny"] * given.tiny + (["--commit", given.commit] if given.commit else [])
            outcome = _within(command, limit)
            got = json.loads(out.read_text()) if out.exists() else None
        record["parts"][part] = {"outcome": outcome, "seconds": time.monotonic() - start, "result": got}
        record["seconds"] = time.monotonic() - began
        given.out.write_text(json.dumps(record, indent=1) + "\n")
        print(f"== {part}: {outcome} after {record['parts'][part]['seconds']:.0f} s", flush=True)


def _within(command: list[str], limit: float) -> str:
    """Runs `command` in a process group of its own, ended after `limit` seconds; says how it went."""
    process = subprocess.Popen(command, start_new_session=True)
    try:
        code = process.wait(limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)
        process.wait()
        return "out of time"
    return "done" if code == 0 else f"failed with exit code {code}"


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu.json"))
    parser.add_argument("--seconds", type=float, default=450.0, help="for everything")
    parser.add_argument("--commit", help="of this source, where git cannot tell")
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.part is None:
        return run_all(given)
    _environment(given.part)
    return run_part(given, given.out.parent)


if __name__ == "__main__":
    main()
