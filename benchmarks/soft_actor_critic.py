"""Stable-Baselines3's SAC as a model-free line beside the actor-critic in the ensemble.

`PYTHON benchmarks/soft_actor_critic.py TASK [--seed 0] [--real-steps 100000] [--env-kwargs KEY=VALUE ...] [--out DIR]`,
with a Python that has metrpo and stable-baselines3: its defaults, on the task's own environment, an evaluation without
noise every 1,000 real steps. Written to DIR (results/sac/TASK/seed-SEED): metrics.csv, and about.json with versions
and commit.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from importlib.metadata import version
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC

from metrpo import get_task
from metrpo.run.files import folder_name, source_commit
from metrpo.world.task import Task

EVERY, EPISODES = 1_000, 5
COLUMNS = ("real_steps", "return_real", "return_real_std", "wall_seconds")


def main() -> None:
    """Learns, evaluates and writes a row each time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real-steps", type=int, default=100_000)
    parser.add_argument("--env-kwargs", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    task = get_task(given.task, given.env_kwargs)
    out = given.out or Path("results") / "sac" / folder_name(task.name) / f"seed-{given.seed}"
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    versions = {name: version(name) for name in ("stable-baselines3", "torch", "gymnasium", "mujoco")}
    about = {
        "task": task.name,
        "env_kwargs": given.env_kwargs,
        "seed": given.seed,
        "commit": source_commit(),
        "versions": versions,
    }
    (out / "about.json").write_text(json.dumps(about, indent=1) + "\n")
    model, begun = SAC("MlpPolicy", environment(task), seed=given.seed, device="cpu"), time.perf_counter()
    with (out / "metrics.csv").open("w", newline="") as file:
        rows = csv.DictWriter(file, COLUMNS)
        rows.writeheader()
        while model.num_timesteps < given.real_steps:
            model.learn(EVERY, reset_num_timesteps=False)
            returns = evaluated(model, task, given.seed)
            row = (model.num_timesteps, np.mean(returns), np.std(returns), time.perf_counter() - begun)
            rows.writerow(dict(zip(COLUMNS, row, strict=True)))
            file.flush()
            print(f"{row[0]:,} real steps  return {row[1]:.1f}  {row[3]:.0f} s", flush=True)


def environment(task: Task) -> gymnasium.Env:
    """The task's environment as SAC wants it: without global positions, and the end by the time limit said apart."""
    env = gymnasium.wrappers.TimeLimit(task.make_env(), task.horizon)
    low, high = (np.delete(x, task.unseen) for x in (env.observation_space.low, env.observation_space.high))
    space = gymnasium.spaces.Box(low, high, dtype=env.observation_space.dtype)
    return gymnasium.wrappers.TransformObservation(env, lambda observed: np.delete(observed, task.unseen), space)


def evaluated(model: SAC, task: Task, seed: int) -> list[float]:
    """Returns of episodes without noise."""
    env, returns = environment(task), []
    for number in range(EPISODES):
        observed, _ = env.reset(seed=10_000 * (seed + 1) + number)
        total, over = 0.0, False
        while not over:
            observed, reward, terminated, truncated, _ = env.step(model.predict(observed, deterministic=True)[0])
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    return returns


if __name__ == "__main__":
    main()
