"""The robot's own program: moves the arm with the newest policy, hands over what happened, asks for the next policy.

    metrpo init examples/robot/arm.py:task --run-dir runs/arm
    python examples/robot/robot.py runs/arm --rounds 4

It needs NumPy and metrpo's two functions below, no JAX; the learner is another process (`metrpo improve`), and could be
on another machine that shares the folder.
"""

import argparse
import subprocess
import sys

import numpy as np

import metrpo

STEPS, DT = 60, 0.05


class Arm:
    """Stands for the hardware: one joint that a motor of 4 N m turns against gravity (1 kg at 0.5 m); up is best."""

    def __init__(self, rng):
        self.angle, self.speed = np.pi + rng.uniform(-0.5, 0.5), 0.0  # hanging

    def sense(self):
        return np.array([np.cos(self.angle), np.sin(self.angle), self.speed / 5])

    def move(self, torque):
        self.speed += DT * (9.81 / 0.5 * np.sin(self.angle) + (torque - 0.1 * self.speed) / 0.25)
        self.speed = np.clip(self.speed, -15, 15)
        self.angle += DT * self.speed
        return np.cos(self.angle) - 0.01 * self.speed**2


def play(policy, noise, rng):
    """One episode: states [61, 3], actions [60, 1], rewards [60]."""
    policy.reset()
    arm = Arm(rng)
    states, actions, rewards = [arm.sense()], [], []
    for _ in range(STEPS):
        action = policy.limited(policy.unlimited(states[-1]) + noise * rng.standard_normal(1))
        rewards.append(arm.move(float(policy.to_env(action)[0])))
        actions.append(action)
        states.append(arm.sense())
    return states, actions, rewards


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("run_dir")
    arguments.add_argument("--rounds", type=int, default=4)
    arguments.add_argument("--episodes", type=int, default=10)
    given = arguments.parse_args()
    rng = np.random.default_rng(0)
    for _ in range(given.rounds):
        policy = metrpo.load_policy(given.run_dir)
        for _ in range(given.episodes):
            episode = play(policy, noise=rng.uniform(0, 1), rng=rng)
            metrpo.append_episode(given.run_dir, *episode, terminated=False)
        subprocess.run([sys.executable, "-m", "metrpo", "improve", given.run_dir], check=True)
    policy = metrpo.load_policy(given.run_dir)
    returns = [sum(play(policy, noise=0, rng=rng)[2]) for _ in range(20)]
    print(f"return {np.mean(returns):.1f} ± {np.std(returns):.1f} without noise, of {STEPS} at most")


if __name__ == "__main__":
    main()
