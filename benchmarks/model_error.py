"""How wrong the models of a run are: `python benchmarks/model_error.py RUN_DIR [--episodes 20]`.

Plays fresh real episodes with the run's policy and its exploration noise, which the models never saw, and lets every
member predict them open-loop for 1, 10 and 50 steps from every state, given the real actions. Printed for each state
dimension: root mean square error of the prediction over that of predicting no change (1: no better than that).
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from stored import newest_of

from metrpo.model import ensemble as ensembles
from metrpo.policy import gaussian
from metrpo.stages.ensemble_fit import ensemble_of
from metrpo.types import Episode
from metrpo.world.collection import collect, explore
from metrpo.world.registry import task_for


def relative_error(ensemble: ensembles.Ensemble, episodes: list[Episode], steps: int) -> np.ndarray:
    """[O]: error after `steps` predicted steps, over the error of standing still; mean over starts and members."""
    starts, actions, ends = [], [], []
    for e in episodes:
        for t in range(len(e.actions) - steps + 1):
            starts.append(e.states[t])
            actions.append(e.actions[t : t + steps])
            ends.append(e.states[t + steps])
    states = jnp.broadcast_to(jnp.array(starts), (ensemble.members, *np.shape(starts)))
    for step in range(steps):
        action = jnp.array(actions)[:, step]
        states = ensembles.predict(ensemble, states, jnp.broadcast_to(action, (ensemble.members, *action.shape)))
    observed = np.s_[..., : len(starts[0]) - len(ensemble.carried.indices)]
    error = (np.asarray(states) - np.array(ends))[observed]
    still = (np.array(starts) - np.array(ends))[observed]
    return np.sqrt(np.mean(error**2, axis=(0, 1)) / np.mean(still**2, axis=0))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=20)
    arguments = parser.parse_args()
    settings, state = newest_of(arguments.run_dir)
    task = task_for(settings)
    ensemble = ensemble_of(settings, task, state.networks, state.dataset.train)
    act = partial(gaussian.mean, jax.tree.map(np.asarray, state.policy))
    rng, steps = np.random.default_rng(2**40), arguments.episodes * task.horizon
    episodes = collect(task, lambda rng: explore(act, settings.collect, rng), steps, rng)
    print(f"{task.name}, iteration {state.iteration}, {len(episodes)} fresh episodes; error relative to no change")
    for steps in (1, 10, 50):
        print(f"{steps:>3} steps  ", " ".join(f"{x:6.2f}" for x in relative_error(ensemble, episodes, steps)))


if __name__ == "__main__":
    main()
