"""How well a run's critics value its own episodes: `python benchmarks/critics.py RUN_DIR [--episodes 4]`.

Plays real episodes of the newest actor, with its noise and without, and compares what the critics (their least) say of
every step with the discounted rewards that followed, for steps after which the episode has enough left to tell. Printed
for each: the return, what is said and what followed on average, their correlation, and the slope of what followed on what is said.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from metrpo import config, init
from metrpo.policy import squashed
from metrpo.policy.inputs import normalised
from metrpo.policy.value import critics as critic_networks
from metrpo.policy.value.critics import valued
from metrpo.run.directory import RunDirectory
from metrpo.seeds import Stage, rng_of
from metrpo.stages.state import inputs_for
from metrpo.world import collection
from metrpo.world.origin import of_real
from metrpo.world.registry import task_for


def main() -> None:
    """Prints one line for each way to act."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=4)
    given = parser.parse_args()
    settings = config.from_json((given.run_dir / "config.json").read_text())
    with RunDirectory(given.run_dir, settings) as run:
        state = run.load(init(settings))
    if state is None:
        parser.error(f"{given.run_dir}: expected a run with a checkpoint, got none")
    task, learner = task_for(settings), state.baseline
    inputs, actor = inputs_for(settings, task, state.dataset), squashed.on_host(learner.actor)
    discount = settings.advantage.discount
    left = int(np.log(0.1) / np.log(discount))
    rng = rng_of(settings.seed, 0, Stage.EVALUATE)

    def noisy(observed: np.ndarray) -> np.ndarray:
        return squashed.draw(actor, normalised(inputs, observed), rng)

    def plain(observed: np.ndarray) -> np.ndarray:
        return np.tanh(squashed.moments(actor, normalised(inputs, observed))[0])

    for name, act in (("noisy", noisy), ("plain", plain)):
        episodes = [
            collection.play(task, of_real(act, state.origin), int(rng.integers(2**31))) for _ in range(given.episodes)
        ]
        told, followed = [], []
        for episode in episodes:
            after = 0.0
            returns = np.zeros(len(episode.rewards))
            for t in range(len(returns) - 1, -1, -1):
                after = episode.rewards[t] + discount * after
                returns[t] = after
            seen = normalised(inputs, np.asarray(episode.states[: len(returns)] - state.origin, np.float32))
            said = critic_networks.outputs(learner.critics, seen, np.asarray(episode.actions, np.float32))
            kept = slice(0, len(returns) if episode.terminated else max(len(returns) - left, 1))
            told.append(np.asarray(valued(learner.scale, np.min(said, axis=0)))[kept])
            followed.append(returns[kept])
        q, g = np.concatenate(told), np.concatenate(followed)
        totals = [float(np.sum(e.rewards)) for e in episodes]
        slope, _ = np.polyfit(q, g, 1)
        print(
            f"{name}: returns {' '.join(f'{x:.0f}' for x in totals)}; said {q.mean():.1f} (std {q.std():.1f}), "
            f"followed {g.mean():.1f} (std {g.std():.1f}); correlation {np.corrcoef(q, g)[0, 1]:.2f}, slope {slope:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
