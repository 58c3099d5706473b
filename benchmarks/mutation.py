"""Mutation testing: `pip install cosmic-ray==8.7.0`, then `python benchmarks/mutation.py [trpo ...] [--fresh]`.

Cosmic-ray makes the mutants (an operator, number or constant changed); those that differ in annotations alone, which
nothing evaluates, are left out, as is what does not parse. Each of the others runs in a copy of the repository, in a
process forked from one that has JAX and pytest imported already: a third of the time of a new one. Tests run in the
order of what they cost, those that killed before first, until one fails. A test may take ten times its CPU seconds, not
seconds, so that a busy machine kills nothing; beyond, the mutant counts as killed by the clock.

`results/mutation/NAME.csv` is the record, a row a mutant, kept as it goes: the same command goes on where it was, does
again what survived, and does all again when the module has changed (or with `--fresh`). `equivalent.csv` beside it says
of survivors why no test can tell them from the original. Exit code 1: there are others.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # a process with threads must not fork
    os.environ[variable] = "1"
# Mutants are compiled more than they are run: a third of the time is gone without optimisations.
flags = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
os.environ |= {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}

import jax  # noqa: E402 (the environment must stand first)
import pytest  # noqa: E402
from hypothesis import HealthCheck, Phase, settings  # noqa: E402
from mutants import FIELDS, mutants  # noqa: E402
from scipy.stats import binomtest  # noqa: E402

for module in (
    "gymnasium",
    "hypothesis.extra.numpy",
    "jax.flatten_util",
    "jax.scipy.linalg",
    "mujoco",
    "optax",
    "tyro",
):
    importlib.import_module(module)

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "results" / "mutation"
LEARNED = "tests/world/test_resolve.py::test_the_dataset_holds_reward_and_end_where_they_are_learned"
MODULES = {
    "trpo": ("src/metrpo/policy/improvers/trpo.py", ["tests/policy/improvers/test_trpo.py"]),
    "advantage": ("src/metrpo/policy/advantage.py", ["tests/policy/test_advantage.py"]),
    "validate": ("src/metrpo/policy/stopping.py", ["tests/policy/test_stopping.py"]),
    "dataset": ("src/metrpo/world/dataset.py", ["tests/world/test_dataset.py", LEARNED]),
    "checkpoint": ("src/metrpo/run/checkpoint.py", ["tests/run/test_checkpoint.py"]),
}
PATIENCE = 600
"""Seconds of silence after which a mutant counts as hanging without work."""


class Watch:
    """A pytest plugin: cheap tests first, each with a limit of its own; tells what failed and what each one took."""

    def __init__(self, cost: dict[str, float], kills: Counter[str]) -> None:
        self.cost, self.kills, self.took, self.failed = cost, kills, {}, ""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self.cost.get(item.nodeid, 0.0) / (1 + self.kills[item.nodeid]))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        started = time.process_time()
        if item.nodeid in self.cost:
            limit = int(started + 10 + 10 * self.cost[item.nodeid])
            resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
        result = yield
        self.took[item.nodeid] = time.process_time() - started
        return result

    def pytest_exception_interact(self, node: pytest.Item, call: pytest.CallInfo) -> None:
        self.failed = self.failed or f"{node.nodeid}: {call.excinfo.typename}"


def in_child(copy: Path, tests: list[str], watch: Watch, pipe: int) -> None:
    """Runs `tests` in `copy` in this forked process, which ends; a JSON line into `pipe` says what happened."""
    os.setsid()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    out = os.open(copy / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    os.dup2(out, 2)
    os.chdir(copy)
    sys.dont_write_bytecode = bool(watch.cost)
    sys.path.insert(0, str(copy / "src"))
    os.environ["PYTHONPATH"] = str(copy / "src")
    # The same examples every time, and no search for the smallest one that fails.
    checks = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
    phases = [Phase.explicit, Phase.generate]
    settings.register_profile(
        "mutation", derandomize=True, database=None, deadline=None, phases=phases, suppress_health_check=checks
    )
    settings.load_profile("mutation")
    flags = [
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "--timeout=0",
        "-W",
        "ignore::pytest.PytestAssertRewriteWarning",
    ]
    code = pytest.main([*flags, *tests], plugins=[watch])
    import metrpo

    assert Path(metrpo.__file__).is_relative_to(copy), "the mutated code must be what is imported"
    os.write(pipe, json.dumps([int(code), watch.failed, watch.took]).encode())
    os._exit(0)


def verdict(
    copy: Path, tests: list[str], cost: dict[str, float], kills: Counter[str]
) -> tuple[str, str, dict[str, float]]:
    """(outcome, by which test and error, CPU seconds of each test) of the code that stands in `copy`."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            in_child(copy, tests, Watch(cost, kills), writer)
        finally:
            os._exit(70)
    os.close(writer)
    said = b""
    try:
        with open(reader, "rb", buffering=0) as pipe:
            while (ready := select.select([pipe], [], [], PATIENCE)[0]) and (more := pipe.read(65536)):
                said += more
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if said:
        code, failed, took = json.loads(said)
        if code not in (0, 1, 2) or "HealthCheck" in failed:
            raise SystemExit(f"no verdict ({failed}):\n{(copy / 'output.txt').read_text()}")
        return ("killed" if code else "survived"), failed, took
    if not ready or status == -signal.SIGXCPU:
        return "timeout", "", {}
    if status >= 0:
        raise SystemExit(f"no verdict:\n{(copy / 'output.txt').read_text()}")
    return "killed", signal.Signals(-status).name, {}


def run(name: str, fresh: bool, minutes: float, explained: set[tuple[str, str, str]]) -> list[dict[str, str]]:
    """The record of a module's mutants after the runs that it lacked, for so long."""
    path, tests = MODULES[name]
    todo = list(mutants((ROOT / path).read_text()))
    known = {} if fresh else {row["mutant"]: row for row in read(RECORDS / f"{name}.csv")}
    rows = [known.get(m["mutant"], m) for m in todo]
    kills: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        # What does not depend on the mutant need not be compiled again: the cache goes by the compiled operations.
        jax.config.update("jax_compilation_cache_dir", f"{copy}/cache")
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
        for part in ("src", "tests"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        outcome, by, cost = verdict(copy, tests, {}, kills)
        if outcome != "survived":
            raise SystemExit(f"the tests fail without a mutation: {by}\n{(copy / 'output.txt').read_text()}")
        end = time.monotonic() + 60 * minutes
        # In a random order, so that what is done when time runs out is a fair sample of all.
        for n, i in enumerate(random.Random(0).sample(range(len(todo)), len(todo)), 1):
            mutant, outcome = todo[i], rows[i].get("outcome")
            settled = outcome == "survived" and (name, mutant["before"], mutant["after"]) in explained
            if settled or outcome in ("killed", "timeout"):
                continue
            if time.monotonic() > end:
                break
            (copy / path).write_text(mutant["text"])
            outcome, by, _ = verdict(copy, tests, cost, kills)
            kills[by.rsplit(": ", 1)[0]] += 1
            rows[i] = mutant | {"outcome": outcome, "by": by}
            write(RECORDS / f"{name}.csv", [row for row in rows if "outcome" in row])
            print(f"{name} {n}/{len(todo)} {outcome}: {mutant['after']}  {by}", file=sys.stderr, flush=True)
    return rows


def share(hits: int, of: int, exact: bool) -> str:
    """A share in words; of a random sample, with Wilson's interval."""
    low, high = binomtest(hits, of).proportion_ci(method="wilson")
    return f"{hits / of:.1%}" + ("" if exact else f" ({low:.1%} to {high:.1%})")


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file, none of one that is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: list[dict[str, str]]) -> None:
    """Replaces a record by `rows`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with (new := path.with_suffix(".new")).open("w", newline="") as file:
        table = csv.DictWriter(file, FIELDS, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    new.replace(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", choices=[*MODULES, []], metavar="MODULE", help=", ".join(MODULES))
    parser.add_argument("--fresh", action="store_true", help="do every mutant again")
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="per module: a random sample of the mutants"
    )
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # which takes the child and the copy along
    explained = {(row["module"], row["before"], row["after"]) for row in read(RECORDS / "equivalent.csv")}
    holes = 0
    columns = ("module", "mutants", "run", "killed", "timeout", "equivalent", "survived", "killed of what can be, 95 %")
    print("|", " | ".join(columns), "|\n|", " | ".join("---" for _ in columns), "|")
    for name in options.modules or MODULES:
        rows = run(name, options.fresh, options.minutes, explained)
        found = Counter(row.get("outcome") for row in rows)
        survived = [row for row in rows if row.get("outcome") == "survived"]
        equal = sum((name, row["before"], row["after"]) in explained for row in survived)
        counts = (len(rows), len(rows) - found[None], found["killed"], found["timeout"], equal, len(survived) - equal)
        cells = (name, *counts, share(found["killed"] + found["timeout"], counts[1] - equal, exact=not found[None]))
        print("|", " | ".join(str(cell) for cell in cells), "|", flush=True)
        holes += counts[-1]
    sys.exit(holes > 0)
