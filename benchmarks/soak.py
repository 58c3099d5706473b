"""A soak: one long run, killed at random moments and resumed by the same command, with a log of every event.

    python benchmarks/soak.py results/soak/Swimmer/me-trpo/seed-0 --hours 3 --kills 10 -- Swimmer --iterations 100000

trains for so many hours of a living process, over as many sittings as it takes: the log says how far it has come, and
the same command goes on. The moments of the kills are drawn beforehand. After each kill the rows of metrics.csv must be
those of before, and more of them; any difference ends the soak with an error.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

COLUMNS = ("utc", "event", "hours", "cpu_hours", "iterations", "seconds_since_the_last_iteration")


class Log:
    """`DIR-soak.csv`: what happened when, in hours of training."""

    def __init__(self, run_dir: Path) -> None:
        self._path, self._metrics = run_dir.with_name(f"{run_dir.name}-soak.csv"), run_dir / "metrics.csv"
        self._seen: list[dict[str, str]] = []
        self.events: list[dict[str, str]] = []
        if self._path.exists():
            with self._path.open(newline="") as file:
                self.events = list(csv.DictReader(file))

    def write(self, event: str, hours: float, cpu_hours: float) -> None:
        """One more event; raises `SystemExit` when a row of the metrics is lost or changed."""
        rows = list(csv.DictReader(self._metrics.read_text().splitlines())) if self._metrics.exists() else []
        # By column: a newer version adds some to the rows of before.
        kept = [{name: new.get(name) for name in old} for old, new in zip(self._seen, rows, strict=False)]
        if kept != self._seen:
            raise SystemExit(f"{event}: the rows of {self._metrics} are not those of before")
        self._seen = rows
        since = f"{time.time() - self._metrics.stat().st_mtime:.1f}" if rows else ""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        values = (now, event, f"{hours:.4f}", f"{cpu_hours:.4f}", str(len(rows)), since)
        self.events.append(dict(zip(COLUMNS, values, strict=True)))
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if len(self.events) == 1:
                writer.writeheader()
            writer.writerow(self.events[-1])
        print(*values, flush=True)


def soak(run_dir: Path, hours: float, kills: int, command: list[str]) -> None:
    """Trains for `hours`, killed `kills` times."""
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    log, said = Log(run_dir), run_dir.with_name(f"{run_dir.name}-soak.log")
    rng = random.Random(0)
    moments = [*sorted(rng.uniform(0, hours) for _ in range(kills)), hours]
    done = [float(event["hours"]) for event in log.events]
    cpu = [float(event["cpu_hours"]) for event in log.events]
    hours_before, cpu_before = max(done, default=0.0), max(cpu, default=0.0)
    spent = cpu_before
    for moment in moments[sum(event["event"] == "killed" for event in log.events) :]:
        with said.open("a") as out:
            process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        log.write("started", hours_before, spent)
        began = time.monotonic()
        last = moment == hours
        try:
            process.wait(max(0.0, moment - hours_before) * 3600)
            raise SystemExit(f"the run ended by itself, with {process.returncode}: see {said}")
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM if last else signal.SIGKILL)
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            last = True
        code = process.wait()
        hours_before += (time.monotonic() - began) / 3600
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = cpu_before + (used.ru_utime + used.ru_stime) / 3600
        log.write(f"ended with {code}" if last else "killed", hours_before, spent)
        if last:
            break


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--kills", type=int, default=10)
    at = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)  # argparse would take what follows for its own
    given = parser.parse_args(sys.argv[1:at])
    command = [sys.executable, "-m", "metrpo", "train", *sys.argv[at + 1 :], "--run-dir", str(given.run_dir)]
    os.environ["MUJOCO_GL"] = "disabled"  # no video at the end
    soak(given.run_dir, given.hours, given.kills, command)


if __name__ == "__main__":
    main()
