"""How well a run's critics value its own episodes: `python benchmarks/critics.py RUN_DIR [--episodes 4]`.

Plays real episodes of the newest actor, with its noise and without, and compares what the critics (their least) say of
every step with the discounted rewards that followed. Steps so near to a cut end that a tenth of what follows is missing
are left out. Printed for each way to act: the returns, the means of both, their correlation, and their slope.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from stored import newest_of

from metrpo import State
from metrpo.config import Config
from metrpo.policy import squashed
from metrpo.policy.inputs import normalised
from metrpo.policy.value import critics
from metrpo.seeds import Stage, rng_of
from metrpo.stages.state import inputs_for
from metrpo.types import Episode
from metrpo.world import collection
from metrpo.world.origin import of_real, relative
from metrpo.world.registry import task_for


def main() -> None:
    """Prints one line for each way to act."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=4)
    given = parser.parse_args()
    settings, state = newest_of(given.run_dir)
    for name, noise in (("with noise", 1.0), ("without", 0.0)):
        print(f"{name}: {judged(settings, state, played(settings, state, given.episodes, noise))}", flush=True)


def played(settings: Config, state: State, count: int, noise: float) -> list[Episode]:
    """Real episodes of the actor, with so much of its noise."""
    task, actor = task_for(settings), squashed.on_host(state.baseline.actor)
    inputs = inputs_for(settings, task, state.dataset)

    def draw_act(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
        def act(observed: np.ndarray) -> np.ndarray:
            means, log_std = squashed.moments(actor, normalised(inputs, observed))
            return np.tanh(means + noise * np.exp(log_std) * rng.standard_normal(means.shape))

        return of_real(act, state.origin)

    rngs = [rng_of(settings.seed, 0, Stage.EVALUATE, number) for number in range(count)]
    return list(collection.play(task, draw_act, rngs))


def judged(settings: Config, state: State, episodes: list[Episode]) -> str:
    """What the critics say of the steps of `episodes`, beside what followed."""
    discount, learner = settings.advantage.discount, state.baseline
    inputs = inputs_for(settings, task_for(settings), state.dataset)
    said, followed = [], []
    for episode in episodes:
        length = len(episode.rewards)
        returns, after = np.zeros(length), 0.0
        for t in reversed(range(length)):
            returns[t] = after = episode.rewards[t] + discount * after
        seen = normalised(inputs, np.float32(relative(episode.states[:-1], state.origin)))
        least = np.min(critics.outputs(learner.critics, seen, episode.actions), axis=0)
        kept = length if episode.terminated else max(1, length + int(math.log(10) / math.log(discount)))
        said.append(np.asarray(critics.valued(learner.scale, least))[:kept])
        followed.append(returns[:kept])
    ours, real = np.concatenate(said), np.concatenate(followed)
    totals = " ".join(f"{np.sum(episode.rewards):.0f}" for episode in episodes)
    correlation, slope = np.corrcoef(ours, real)[0, 1], np.polyfit(ours, real, 1)[0]
    return (
        f"returns {totals}; said {ours.mean():.1f} (std {ours.std():.1f}), followed {real.mean():.1f} "
        f"(std {real.std():.1f}); correlation {correlation:.2f}, slope {slope:.2f}"
    )


if __name__ == "__main__":
    main()
