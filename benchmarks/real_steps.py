"""Real steps per second of processor time: one episode after another, and many at a time.

    taskset -c 0 python benchmarks/real_steps.py

plays the paper's tasks with a fresh policy (32-32) by `metrpo.world.collection.evaluate` and by
`metrpo.world.batch_episodes.evaluate`, in turns; medians of five. Time is the process's own, so that
others on the core count little, and threads add up: pin it to one core.
"""

from __future__ import annotations

import statistics
import time
from functools import partial

import jax
import numpy as np

from metrpo import get_task
from metrpo.policy import gaussian
from metrpo.world import batch_episodes, collection

EPISODES = {"Swimmer": 20, "Snake": 20, "Hopper": 64, "HalfCheetah": 64, "Ant": 64, "Humanoid": 20}


def main() -> None:
    """Prints one line for each task."""
    for name, episodes in EPISODES.items():
        task = get_task(name)
        fresh = gaussian.init(jax.random.key(0), task.state_size, task.action_size, (32, 32), 1.0)
        act = partial(gaussian.mean, jax.tree.map(np.asarray, fresh))
        seeds = map(collection.seed_of, [np.random.default_rng(0)] * episodes)
        played = batch_episodes.play(task, lambda states, numbers, steps: act(states), seeds)  # noqa: B023
        steps = sum(len(e.rewards) for e in played)
        rates: dict[str, list[float]] = {"one": [], "many": []}
        for _ in range(5):
            for kind, play in (("one", collection.evaluate), ("many", batch_episodes.evaluate)):
                start = time.process_time()
                play(task, act, episodes, 0)
                rates[kind].append(steps / (time.process_time() - start))
        one, many = statistics.median(rates["one"]), statistics.median(rates["many"])
        ratio = statistics.median(b / a for a, b in zip(rates["one"], rates["many"], strict=True))
        print(
            f"{name}: {one:,.0f} steps/s one by one, {many:,.0f} many at a time, {ratio:.2f} times as many", flush=True
        )


if __name__ == "__main__":
    main()
