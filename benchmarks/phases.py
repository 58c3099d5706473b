"""Policy phases in fixed models: `python benchmarks/phases.py RUN_DIR [--phases 5] [--seeds 3] VARIANT...`.

A variant is a list of settings, such as `policy.mean_penalty=0.2,advantage.gae_lambda=1`, or `as-run`. The models and
data of a run's newest checkpoint stay as they are; the policy goes on from the checkpoint, phase after phase. A setting
of the policy phase is so tried in minutes, without collecting and fitting. Printed for every variant, seed and phase:
updates made and accepted, what the models promise, what is earned, std and the share of saturated mean actions; and the
mean over the seeds of the last phases. `--fresh`: the policy begins untrained instead.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import jax
import numpy as np
from stored import newest_of

from metrpo import State, init, policy_phase
from metrpo.config import Config
from metrpo.console.progress import SILENT
from metrpo.model.diagnostics import diagnose
from metrpo.policy.value.value_table import init_baseline
from metrpo.presets import override
from metrpo.run.clock import Clock
from metrpo.seeds import Stage, key_of
from metrpo.stages import policy_search, records
from metrpo.stages.ensemble_fit import ensemble_of
from metrpo.world.registry import task_for


def main() -> None:
    """Prints one line for each phase."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--phases", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--fresh", action="store_true")
    arguments = parser.parse_args()
    settings, state = newest_of(arguments.run_dir)
    for variant in arguments.variants:
        values = {} if variant == "as-run" else dict(pair.split("=") for pair in variant.split(","))
        now = override(settings, {name: json.loads(value) for name, value in values.items()})
        play = partial(phases, now, state, arguments.phases, arguments.fresh, variant)
        last = [play(seed) for seed in range(10, 10 + arguments.seeds)]
        print(f"{variant}: last phases earn {np.mean(last):.1f} (worst {np.min(last):.1f})", flush=True)


def phases(config: Config, state: State, count: int, fresh: bool, variant: str, seed: int) -> float:
    """Plays `count` phases and returns what the last policy earns."""
    config = override(config, {"seed": seed})
    task, data = task_for(config), state.dataset
    ensemble = ensemble_of(config, task, state.networks, data.train)
    first = init(config).policy if fresh else state.policy
    baseline = init_baseline(config.advantage, task.state_size, key_of(seed, 0, Stage.IMPROVE))
    state = state._replace(policy=first, baseline=baseline)
    # A policy that goes on keeps its standard deviation; only an untrained one begins with the initial one.
    earned, before = np.nan, 0 if fresh else state.iteration
    for number in range(1, count + 1):
        policy, baseline, info = policy_search.improve_policy(
            config, task, state._replace(iteration=before + number - 1), ensemble, SILENT, Clock()
        )
        state = state._replace(policy=policy, baseline=baseline)
        earned = float(np.mean(records.evaluate(config, task, policy, number, origin=state.origin)))
        horizon, key = policy_phase.imagined_horizon(config, task), jax.random.key(seed)
        saturated = diagnose(ensemble, policy, data.validation, data.train, horizon, key).saturated
        std = float(np.mean(np.exp(np.asarray(policy.log_std))))
        print(
            f"{variant}  seed {seed}  phase {number}: {info.accepted_updates} of {info.updates} updates accepted, "
            f"imagined {np.mean(info.values):.1f}, real {earned:.1f}, std {std:.2f}, saturated {saturated:.0%}",
            flush=True,
        )
    return earned


if __name__ == "__main__":
    main()
