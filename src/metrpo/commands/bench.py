"""`metrpo bench` measures how fast this machine runs metrpo."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from metrpo.commands.options import Switch, require_at_least_one


@dataclass(frozen=True)
class Bench:
    """Measure how fast this machine runs metrpo: fitting, imagination, policy updates, whole iterations.

    Run nothing else meanwhile. Each round times every piece once, so that all see the same machine; medians count.
    For example:
        metrpo bench
        metrpo bench --peers --rounds 9 --json > bench.json
    """

    peers: Switch = False
    """Measure mbrl-lib, sb3-contrib and PyTorch too; the first time installs them (gigabytes) in a separate folder."""
    rounds: int = 7
    """How many times to time each piece."""
    iterations: Annotated[Switch, arg(help="Skip whole iterations and process starts (minutes).")] = True
    json: Switch = False
    """Print JSON."""

    def __post_init__(self) -> None:
        require_at_least_one("rounds", self.rounds)


def run(command: Bench) -> int:
    """Returns the exit code."""
    from metrpo.run import machine

    machine.prepare(None, deterministic=False)
    from metrpo.speed.measure import bench

    def tell(text: str) -> None:
        print(f"metrpo bench: {text}", file=sys.stderr, flush=True)

    report = bench(command.peers, command.rounds, command.iterations, tell)
    print(json.dumps(report.record(), indent=2) if command.json else report.text())
    return 0
