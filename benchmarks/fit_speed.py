"""Validation loss against seconds, for settings of the fit: `python benchmarks/fit_speed.py RUN_DIR VARIANT...`.

A variant is a list of settings, such as `fit.learning_rate=0.002,fit.max_steps=2500`, or `as-run`. The data of a
finished run are cut where its first ten iterations ended and fitted one after the other, each fit warm-started from
the one before, as the run did. Printed for every variant: validation loss (mean over the members) and seconds of each
fit, and their mean and sum. Pin the process (taskset) when something else runs.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from pathlib import Path

import jax
import numpy as np

from metrpo import config, get_task, init
from metrpo.model.fit import fit
from metrpo.presets import override
from metrpo.run.directory import RunDirectory
from metrpo.stages.ensemble_fit import ensemble_of, fresh_networks
from metrpo.types import Transitions
from metrpo.world import dataset as datasets

ITERATIONS = 10


def main() -> None:
    """Prints one line for each variant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("variants", nargs="+")
    arguments = parser.parse_args()
    settings = config.from_json((arguments.run_dir / "config.json").read_text())
    task = get_task(settings.task)
    with RunDirectory(arguments.run_dir, settings) as run:
        state = run.load(init(settings))
    if state is None or state.iteration < ITERATIONS:
        parser.error(f"{arguments.run_dir}: expected a run of at least {ITERATIONS} iterations with its checkpoint")

    def first(data: Transitions, share: float, capacity: int) -> Transitions:
        size = int(int(data.size) * share)
        cut = Transitions(*(np.asarray(x[:size]) for x in data[:3]), size)
        return jax.device_put(datasets.with_capacity(cut, capacity))

    for variant in arguments.variants:
        values = {} if variant == "as-run" else dict(pair.split("=") for pair in re.split(r",(?=[a-z])", variant))
        now = override(settings, {name: json.loads(value) for name, value in values.items()})
        losses, seconds = [], []
        networks = fresh_networks(now, task, jax.random.key(7))
        for iteration in range(1, ITERATIONS + 1):
            share = iteration / state.iteration
            train = first(state.dataset.train, share, now.collect.max_train)
            validation = first(state.dataset.validation, share, now.collect.max_validation)
            real = Transitions(*(np.asarray(x[: int(train.size)]) for x in train[:3]), int(train.size))
            before = ensemble_of(now, task, networks, real)
            start = time.perf_counter()
            ensemble, info = fit(before, train, validation, now.fit, jax.random.key(iteration))
            losses.append(float(np.mean(info.validation_loss)))
            seconds.append(time.perf_counter() - start)
            networks = ensemble.networks
        row = "  ".join(f"{loss:.3f} ({s:.0f} s)" for loss, s in zip(losses, seconds, strict=True))
        print(f"{variant}: {row}  mean {np.mean(losses):.3f}, {np.sum(seconds):.0f} s", flush=True)


if __name__ == "__main__":
    main()
