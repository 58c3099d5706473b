"""A robot's control loop at a fixed rate: one action every period, deadlines that were missed counted.

    metrpo init examples/robot/arm.py:task --run-dir runs/arm --max-action 0.8 --max-change 0.3
    python examples/robot/fixed_rate.py runs/arm --hz 20

The policy's file holds the limits of the run: no action is larger, and none changes by more from one step to the next.
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from robot import DT, Arm

import metrpo


class Timing(NamedTuple):
    """What one run of the loop was like."""

    steps: int
    missed: int
    slowest: float
    total: float


def control(policy, arm, hz, steps, clock=time.perf_counter, sleep=time.sleep):
    """Plays `steps` actions, one every 1 / hz seconds; where sensing and acting take longer, that deadline is missed.

    A missed deadline delays nothing but its own step: the next one is due at the next tick of the same clock.
    """
    policy.reset()
    period, total, slowest, missed = 1 / hz, 0.0, 0.0, 0
    due = clock()
    for _ in range(steps):
        began = clock()
        action = policy(arm.sense())
        total += arm.move(float(policy.to_env(action)[0]))
        took = clock() - began
        slowest, due = max(slowest, took), due + period
        if (left := due - clock()) >= 0:
            sleep(left)
            continue
        missed += 1
        due += -(-(clock() - due) // period) * period  # the ticks that have passed are not made up for
        sleep(max(due - clock(), 0.0))
    return Timing(steps, missed, slowest, total)


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("run_dir", type=Path)
    arguments.add_argument("--hz", type=float, default=1 / DT)
    arguments.add_argument("--steps", type=int, default=60)
    given = arguments.parse_args()
    if given.hz <= 0:
        arguments.error(f"--hz: expected a number above 0, got {given.hz:g}")
    try:
        policy = metrpo.load_policy(given.run_dir)
    except metrpo.MetrpoError as error:
        arguments.error(str(error))
    done = control(policy, Arm(np.random.default_rng(0)), given.hz, given.steps)
    rate = f"{done.steps} steps at {given.hz:g} Hz: {done.missed} deadlines missed"
    print(f"{rate}, slowest step {1000 * done.slowest:.2f} ms; return {done.total:.1f}")


if __name__ == "__main__":
    main()
