"""What MBBL's Pendulum can earn at most: `python benchmarks/pendulum_optimum.py [RUN_DIR ...] [--episodes 500]`.

Dynamic programming over a grid of angles, rates and torques gives the value of every start (a bilinear table) and a
policy, greedy in it, which is then played with the environment's equations: what it earns is a lower bound of the
optimum. The policies of the run directories play from the same starts.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from metrpo.evaluation import evaluate
from metrpo.world.tasks.mbbl import MAX_TORQUE, pendulum_reward

TASK = "mbbl/Pendulum"
ANGLES, RATES, TORQUES, HORIZON, FASTEST = 361, 257, 21, 200, 8.0


def moved(angle: np.ndarray, rate: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle and rate after a step: Pendulum-v0's."""
    faster = rate + (15.0 * np.sin(angle) + 3.0 * torque) * 0.05
    return angle + faster * 0.05, np.clip(faster, -FASTEST, FASTEST)


def earned(angle: np.ndarray, rate: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """The step's reward."""
    state = np.stack([np.cos(angle), np.sin(angle), rate], -1)
    return pendulum_reward(state, (torque / MAX_TORQUE)[..., None], state)


class Table:
    """A function of angle and rate: bilinear between the points of a grid, the angle periodic."""

    def __init__(self, angle: np.ndarray, rate: np.ndarray) -> None:
        x = (angle + np.pi) % (2 * np.pi) / (2 * np.pi) * (ANGLES - 1)
        y = (rate + FASTEST) / (2 * FASTEST) * (RATES - 1)
        self._i, self._j = np.minimum(x.astype(int), ANGLES - 2), np.minimum(y.astype(int), RATES - 2)
        self._u, self._v = (x - self._i).astype(np.float32), (y - self._j).astype(np.float32)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        i, j, u, v = self._i, self._j, self._u, self._v
        low = (1 - u) * values[i, j] + u * values[i + 1, j]
        return (1 - v) * low + v * ((1 - u) * values[i, j + 1] + u * values[i + 1, j + 1])


def solve() -> list[np.ndarray]:
    """Values [ANGLES, RATES] with 0, 1, ..., HORIZON steps to go."""
    angle, rate = np.meshgrid(np.linspace(-np.pi, np.pi, ANGLES), np.linspace(-FASTEST, FASTEST, RATES), indexing="ij")
    moves = []
    for torque in np.linspace(-MAX_TORQUE, MAX_TORQUE, TORQUES):
        full = np.full_like(angle, torque)
        moves.append((earned(angle, rate, full).astype(np.float32), Table(*moved(angle, rate, full))))
    values = [np.zeros(angle.shape, np.float32)]
    for _ in range(HORIZON):
        values.append(np.max([reward + after(values[-1]) for reward, after in moves], axis=0))
    return values


def played(values: list[np.ndarray], angle: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Returns [N] of the policy that is greedy in the table."""
    total = np.zeros(len(angle))
    for left in range(HORIZON, 0, -1):
        fine = np.linspace(-MAX_TORQUE, MAX_TORQUE, 4 * TORQUES - 3)[:, None] * np.ones(len(angle))
        angles, rates = np.broadcast_to(angle, fine.shape), np.broadcast_to(rate, fine.shape)
        worth = earned(angles, rates, fine) + Table(*moved(angles, rates, fine))(values[left - 1])
        best = np.take_along_axis(fine, np.argmax(worth, axis=0)[None], axis=0)[0]
        total += earned(angle, rate, best)
        angle, rate = moved(angle, rate, best)
    return total


def starts(episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and rates [N] in which `metrpo evaluate` begins."""
    seen: list[np.ndarray] = []

    def still(observation: np.ndarray) -> np.ndarray:
        seen.append(np.array(observation, np.float64))
        return np.zeros(1)

    evaluate(still, TASK, episodes)
    first = np.array(seen[::HORIZON])
    return np.arctan2(first[:, 1], first[:, 0]), first[:, 2]


def line(name: str, returns: np.ndarray) -> dict[str, float | str]:
    """Mean and its standard error."""
    return {"name": name, "mean": float(returns.mean()), "error": float(returns.std() / np.sqrt(len(returns)))}


def main() -> None:
    """Reads the command line and prints a JSON line for each policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--episodes", type=int, default=500)
    given = parser.parse_args()
    first = starts(given.episodes)
    values = solve()
    slow = np.abs(np.linspace(-FASTEST, FASTEST, RATES)) <= 1  # at the start
    print(json.dumps({"name": "table, mean over all starts", "mean": float(values[-1][:-1, slow].mean())}))
    print(json.dumps(line("table", Table(*first)(values[-1]))))
    print(json.dumps(line("greedy in the table", played(values, *first))))
    for run in given.runs:
        print(json.dumps(line(str(run), evaluate(run, episodes=given.episodes).returns)))


if __name__ == "__main__":
    main()
