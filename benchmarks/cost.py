"""How cost grows: `python benchmarks/cost.py [--out docs/cost.png] [--record results/performance/cost.json]`.

Times what an outer iteration repeats, on HalfCheetah with the `fast` preset: 500 training steps of the ensemble and the
validations that go with them, five policy updates and their validation. One of dataset size, number of models,
width and horizon (at the same number of imagined steps) changes at a time. Medians of three, after one for warming up.
Run nothing else meanwhile.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from pathlib import Path

from metrpo.run import machine

machine.prepare(None, deterministic=False)

import jax  # noqa: E402 (the environment must stand first)
import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from metrpo import get_task, policy_phase, preset  # noqa: E402
from metrpo.model import ensemble as ensembles  # noqa: E402
from metrpo.model.ensemble import Ensemble  # noqa: E402
from metrpo.model.fit import fit  # noqa: E402
from metrpo.policy import gaussian  # noqa: E402
from metrpo.policy.improvers.improver_table import init_memory  # noqa: E402
from metrpo.policy.improvers.settings import PhaseSettings  # noqa: E402
from metrpo.policy.value import linear  # noqa: E402
from metrpo.presets import override  # noqa: E402
from metrpo.types import Transitions  # noqa: E402

STEPS = 500
BASE = {"transitions": 20_000, "models": 5, "width": 200, "horizon": 100}
GRID = {
    "transitions": [2_000, 20_000, 100_000, 200_000],
    "models": [1, 5, 20],
    "width": [64, 200, 512, 1024],
    "horizon": [25, 50, 100, 200, 400],
}


def cost(transitions: int, models: int, width: int, horizon: int, repeats: int = 3) -> dict[str, float]:
    """Median seconds of the fit and of the policy updates with their validation."""
    config = override(preset("HalfCheetah"), {"ensemble.members": models, "ensemble.hidden": (width, width)})
    task = dataclasses.replace(get_task("HalfCheetah"), horizon=horizon)
    rng = np.random.default_rng(0)

    def draw(count: int) -> Transitions:
        states = rng.standard_normal((count, task.state_size), dtype=np.float32)
        actions = rng.standard_normal((count, task.action_size), dtype=np.float32)
        return jax.device_put(Transitions(states, actions, 0.01 * states[::-1], count))

    train, validation = draw(transitions), draw(transitions // 2)
    normaliser = ensembles.normaliser_of(train, 0.1, 1e-4)
    networks = ensembles.init(jax.random.key(0), models, task.state_size, task.action_size, (width, width))
    per_pass = max(1, transitions // config.fit.batch_size)
    passes = -(-STEPS // per_pass)
    fitting = dataclasses.replace(config.fit, max_passes=passes, patience=passes, validate_every=min(5, passes))
    policy = gaussian.init(jax.random.key(1), task.state_size, task.action_size, config.policy.hidden, 1.0)
    settings = PhaseSettings.of(config, cut=False)
    memory = init_memory(settings, policy, linear.init(task.state_size))
    pool = np.asarray(0.1 * train.states[:1000])
    starts = pool[rng.integers(len(pool), size=(5, policy_phase.rollouts_for(config.imagine.steps, horizon)))]
    seconds: dict[str, list[float]] = {"fit": [], "improve": []}
    for _ in range(repeats + 1):
        start = time.perf_counter()
        ensemble, info = fit(Ensemble(networks, normaliser), train, validation, fitting, jax.random.key(0))
        jax.block_until_ready(ensemble)
        # Whole passes only: brought to the same number of steps.
        seconds["fit"].append((time.perf_counter() - start) * STEPS / (info.passes * per_pass))
        start = time.perf_counter()
        simulator = policy_phase.simulator_of(config, task, ensemble)
        jax.block_until_ready(policy_phase.run_updates(settings, simulator, policy, memory, starts, jax.random.key(2)))
        policy_phase.values_of(simulator, policy, pool[: config.validate.starts])
        seconds["improve"].append(time.perf_counter() - start)
    return {name: statistics.median(values[1:]) for name, values in seconds.items()}


def main() -> None:
    """Measures, writes the record and draws the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/cost.png"))
    parser.add_argument("--record", type=Path, default=Path("results/performance/cost.json"))
    parser.add_argument("--redraw", action="store_true", help="only draw what is recorded")
    arguments = parser.parse_args()
    if not arguments.redraw:
        measured = {
            name: [BASE | {name: value} | cost(**(BASE | {name: value})) for value in values]
            for name, values in GRID.items()
        }
        arguments.record.parent.mkdir(parents=True, exist_ok=True)
        arguments.record.write_text(json.dumps(measured, indent=1) + "\n")
    record = json.loads(arguments.record.read_text())
    figure = Figure(figsize=(10.5, 3.2), dpi=130, layout="constrained")
    for axes, (name, rows) in zip(figure.subplots(1, len(record), sharey=True), record.items(), strict=True):
        for what, label in (("fit", f"{STEPS} training steps"), ("improve", "5 policy updates, 1 validation")):
            axes.plot([row[name] for row in rows], [row[what] for row in rows], "o-", label=label)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(GRID[name], [f"{value // 1000}k" if value > 9999 else str(value) for value in GRID[name]])
        axes.minorticks_off()
        axes.tick_params(axis="x", labelsize=8)  # 100k and 200k stand side by side
        axes.set_xlabel({"transitions": "training transitions", "width": "width of both layers"}.get(name, name))
        axes.grid(True, color="#dddddd", linewidth=0.7)
    figure.axes[0].set_ylabel("seconds")
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(arguments.out)
    print(arguments.out)


if __name__ == "__main__":
    main()
