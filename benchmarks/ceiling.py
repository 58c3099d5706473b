"""What a task allows: the best return that a search finds on the true simulator.

    python benchmarks/ceiling.py HalfCheetah --out results/ceilings/HalfCheetah.json

searches, from each of several resets, for the actions of a whole episode (open loop). In rounds: first among gaits
(each joint a sine of its own amplitude, phase and offset, all of one frequency) by the cross-entropy method, then over
every action by iCEM (Pinneri et al. 2020): noise correlated in time, of several colours, around a mean that follows the
elites, some of which stay in the next population. When it narrows it is widened again around the best plan. The rest
of the budget goes to the best plan of all rounds and of the resets before. The result is a lower bound of what can be
earned from these starts by somebody who knows them; a policy must do with one answer to all.

The best plan of each reset is played again in the task's environment; that return is the one reported. Beside it stands
what no action and uniform random actions earn (20 episodes each).
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from metrpo import get_task
from metrpo.run.files import source_commit
from metrpo.world import batch_episodes
from metrpo.world.open_loop import OpenLoop
from metrpo.world.task import Task

POPULATION, ELITES, KEPT = 50, 8, 3
GAIT_SHARE, ROUND_SHARE = 0.3, 0.3
"""Of the budget: for the gaits of all rounds, and for what comes of them."""
COLOURS = (0.5, 1.0, 2.0)
"""Power spectra 1 / f^colour."""
MOMENTUM, WIDE, NARROW = 0.1, (0.2, 0.1, 0.05), 0.01
"""Of mean and std; the std that each restart begins with, in turn; the std at which the search is widened again."""
Score = Callable[[np.ndarray], np.ndarray]


def coloured(rng: np.random.Generator, count: int, steps: int, size: int) -> np.ndarray:
    """[count, steps, size]: noise of std 1 with power spectrum 1 / f^colour, a colour drawn for each sample."""
    frequencies = np.fft.rfftfreq(steps)
    frequencies[0] = frequencies[1]
    colours = rng.choice(COLOURS, count)[:, None, None]
    amplitudes = frequencies[None, :, None] ** (-colours / 2)
    shape = (count, len(frequencies), size)
    spectrum = amplitudes * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    noise = np.fft.irfft(spectrum, steps, axis=1)
    return noise / noise.std(axis=(1, 2), keepdims=True)


def gaits(parameters: np.ndarray, steps: int, interval: float) -> np.ndarray:
    """[N, T, A] out of [N, 1 + 3 A]: log2 of the frequency in Hz; amplitudes, phases and offsets of the joints."""
    frequency = 2.0 ** np.clip(parameters[:, :1, None], -2, 4)
    amplitude, phase, offset = (x[:, None] for x in np.split(parameters[:, 1:], 3, axis=1))
    t = interval * np.arange(steps)[None, :, None]
    return np.clip(offset + amplitude * np.sin(2 * np.pi * frequency * t + phase), -1, 1)


def best_gait(score: Score, task: Task, interval: float, budget: int, rng: np.random.Generator) -> np.ndarray:
    """[T, A]: the best of `budget` gaits, by the cross-entropy method."""
    size = task.action_size
    mean = np.concatenate([[0.5], np.full(size, 0.7), np.zeros(2 * size)])
    std = np.concatenate([[1.0], np.full(size, 0.5), np.full(size, 2.0), np.full(size, 0.3)])
    best, plan = -math.inf, np.zeros((task.horizon, size))
    for _ in range(max(1, budget // POPULATION)):
        drawn = mean + std * rng.standard_normal((POPULATION, len(mean)))
        plans = gaits(drawn, task.horizon, interval)
        returns = score(plans)
        elites = drawn[np.argsort(returns)[-ELITES:]]
        mean, std = 0.2 * mean + 0.8 * elites.mean(0), 0.2 * std + 0.8 * np.maximum(elites.std(0), 0.02)
        if returns.max() > best:
            best, plan = float(returns.max()), plans[returns.argmax()]
    return plan


def best_plan(
    score: Score, begin: list[np.ndarray], budget: int, rng: np.random.Generator
) -> tuple[np.ndarray, list[tuple[int, float]]]:
    """[T, A], and the best return after so many episodes: iCEM around the best of `begin`."""
    returns = score(np.array(begin))
    best, plan = float(returns.max()), begin[int(returns.argmax())]
    curve, used, restarts = [(len(begin), best)], len(begin), 0
    mean, std, kept = plan, np.full(plan.shape, WIDE[0]), np.empty((0, *plan.shape))
    while used + POPULATION <= budget:
        fresh = POPULATION - len(kept) - 1
        drawn = np.clip(mean + std * coloured(rng, fresh, *plan.shape), -1, 1)
        plans = np.concatenate([drawn, kept, mean[None]])
        returns, used = score(plans), used + len(plans)
        elites = plans[np.argsort(returns)[-ELITES:]]
        mean = MOMENTUM * mean + (1 - MOMENTUM) * elites.mean(0)
        std = MOMENTUM * std + (1 - MOMENTUM) * elites.std(0)
        kept = elites[-KEPT:]
        if returns.max() > best:
            best, plan = float(returns.max()), plans[returns.argmax()]
        curve.append((used, best))
        if std.mean() < NARROW:
            restarts += 1
            mean, std, kept = plan, np.full(plan.shape, WIDE[restarts % len(WIDE)]), plan[None]
    return plan, curve


def played(task: Task, plan: np.ndarray, seed: int) -> float:
    """The plan's return in the environment itself."""
    episode = batch_episodes.play(task, lambda states, numbers, steps: plan[steps], iter([seed]))[0]
    return float(episode.rewards.sum(dtype=np.float64))


def idle(task: Task, random: bool) -> dict[str, float]:
    """Mean and standard deviation of 20 episodes without action, or with uniform random ones."""
    rng = np.random.default_rng(0)

    def act(states: np.ndarray, numbers: np.ndarray, steps: np.ndarray) -> np.ndarray:
        shape = (len(states), task.action_size)
        return rng.uniform(-1, 1, shape) if random else np.zeros(shape)

    returns = [e.rewards.sum(dtype=np.float64) for e in batch_episodes.play(task, act, iter(range(1000, 1020)))]
    return {"mean": float(np.mean(returns)), "sd": float(np.std(returns, ddof=1))}


def search(name: str, resets: int, budget: int, rounds: int, seed: int) -> dict[str, Any]:
    """The record for a task: `budget` episodes of search for each of `resets` starts."""
    task, rng, began = get_task(name), np.random.default_rng(seed), time.monotonic()
    found: list[np.ndarray] = []
    rows: list[dict[str, Any]] = []
    for number in range(resets):
        simulator = OpenLoop(name, number)
        score: Score = lambda plans, s=simulator: s.rewards(plans).sum(axis=1)  # type: ignore[misc]  # noqa: E731
        still = np.zeros((task.horizon, task.action_size))
        gaits_found, plans = [], [still, *found]
        for _ in range(rounds):
            gaits_found.append(best_gait(score, task, simulator.interval, int(GAIT_SHARE * budget / rounds), rng))
            plans.append(best_plan(score, [still, gaits_found[-1]], int(ROUND_SHARE * budget / rounds), rng)[0])
        in_rounds = int((GAIT_SHARE + ROUND_SHARE) * budget)
        plan, curve = best_plan(score, plans, budget - in_rounds, rng)
        found.append(plan)
        row = {
            "reset_seed": number,
            "best": played(task, plan, number),
            "gait": float(score(np.array(gaits_found)).max()),
            "rounds": [round(float(r), 2) for r in score(np.array(plans[-rounds:]))],
            "zero_action": float(score(still[None])[0]),
            "at_limits": float(np.mean(np.abs(plan) >= 1)),
            "curve": [(used + in_rounds, round(best, 2)) for used, best in curve[:: max(1, len(curve) // 20)]],
        }
        rows.append(row)
        print(f"{name}, reset {number}: {row['best']:.2f} (gait {row['gait']:.2f}, rounds {row['rounds']})", flush=True)
    best = [row["best"] for row in rows]
    return {
        "task": task.name,
        "horizon": task.horizon,
        "best": {"mean": float(np.mean(best)), "min": min(best), "max": max(best)},
        "zero_action": idle(task, random=False),
        "random_actions": idle(task, random=True),
        "episodes_per_reset": budget,
        "rounds": rounds,
        "search_seed": seed,
        "resets": rows,
        "seconds": round(time.monotonic() - began, 1),
        "commit": source_commit(),
    }


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--resets", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=20_000, help="of search, for each reset")
    parser.add_argument("--rounds", type=int, default=6, help="gaits to begin from; fewer with a small budget")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    record = search(given.task, given.resets, given.episodes, given.rounds, given.seed)
    text = json.dumps(record, indent=1)
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(text + "\n")
    print({key: record[key] for key in ("best", "zero_action", "random_actions", "seconds")})


if __name__ == "__main__":
    main()
