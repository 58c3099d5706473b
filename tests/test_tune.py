"""Searches: what is typed, what is refused, where the optimum is known, what is saved by pruning, and what a kill costs."""

from __future__ import annotations

import json
import math
import signal
import threading
from pathlib import Path

import pytest

from metrpo import cli
from metrpo.config import to_json
from metrpo.errors import ConfigError, MetrpoError, RunDirectoryError, TaskError
from metrpo.experiments import tune as tuning
from metrpo.experiments.search import Search, from_file, worth
from metrpo.experiments.space import Choices, Range, span, span_of
from metrpo.experiments.study import FILE
from metrpo.experiments.tune import tune
from metrpo.run.metrics import to_csv

SPACE = {"trpo.max_kl": Range(0.001, 1.0, log=True), "ensemble.members": Choices((1, 3, 5))}
STEPS = 6


def search(trials=12, **other):
    return Search("Swimmer", other.pop("space", SPACE), iterations=STEPS, trials=trials, **other)


def best_at(run):
    """The most that a run earns: 10 at max_kl = 0.1 with 3 members, less elsewhere; seeds differ by one."""
    c = run.config
    return 10 - 2 * abs(math.log10(c.trpo.max_kl) + 1) - 3 * (c.ensemble.members != 3) + c.seed - 0.5


class Fake:
    """Runs in this process: each look at one is an iteration, in which its return rises to what it can earn."""

    def __init__(self, returns=best_at, fails=(), dies_after=None):
        self.returns, self.fails = returns, fails
        self.begun, self.looks, self.dies_after = [], 0, dies_after

    def __call__(self, run, out, cores):
        self.begun.append(run)
        return FakeWorker(self, run, out / run.name)


class FakeWorker:
    def __init__(self, fake, run, directory):
        self.fake, self.run, self.directory, self.code = fake, run, directory, None
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "config.json").write_text(to_json(run.config))
        self.rows = tuning.rows_of(run, directory.parents[2])

    def poll(self):
        if self.code is not None:
            return self.code
        self.fake.looks += 1
        if self.fake.looks == self.fake.dies_after:
            raise Killed
        if (self.run.variant, self.run.seed) in self.fake.fails:
            Path(f"{self.directory}.log").write_text("many words\nthe last words\n")
            self.code = 2
            return self.code
        n = len(self.rows) + 1
        row = {"iteration": n, "real_steps": 100 * n, "return_real": self.fake.returns(self.run) * n / STEPS}
        self.rows.append(row)
        (self.directory / "metrics.csv").write_text(to_csv(self.rows))
        self.code = 0 if n == STEPS else None
        return self.code

    def terminate(self):
        if self.code is None:
            self.code = 143

    def wait(self):
        return self.code


class Killed(BaseException):
    """The process is gone: nothing of it runs any more."""


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(tuning, "_POLL", 0.0)


def silent(line):
    pass


def test_fake(tmp_path):
    found = tune(search(25), tmp_path, 1, print, Fake())
    found.print()
    from metrpo.experiments.draw_tuned import draw

    draw(found, Path("/tmp/h-tune-fake/tune.png"))

