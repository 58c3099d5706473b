"""What doing nothing and random actions earn: `python benchmarks/yardsticks.py [TASK...]`.

Written to results/yardsticks.json: 100 real episodes each way from the resets 0 to 99 (20 where an episode has more
than 500 steps), mean and standard deviation.
"""

from __future__ import annotations

import json
import sys

from summarise import ROOT

from metrpo import get_task
from metrpo.world.yardsticks import measure

FILE = ROOT / "yardsticks.json"
TASKS = (
    *("Swimmer", "Snake", "HalfCheetah", "Hopper", "HopperUpright", "Ant", "Humanoid", "HumanoidStandup"),
    *("mbbl/Swimmer", "mbbl/HalfCheetah", "mbbl/Hopper", "mbbl/Ant", "mbbl/Pendulum", "mbbl/CartPole"),
    *("Pendulum-v1", "InvertedPendulum-v5", "InvertedDoublePendulum-v5", "MountainCarContinuous-v0"),
    *("HalfCheetah-v5", "Hopper-v5", "Ant-v5"),
)
ENV_KWARGS = {"Ant-v5": ("include_cfrc_ext_in_observation=false", "contact_cost_weight=0")}
"""As in its runs under results/own: without contact forces."""


def main() -> None:
    """Measures, adds to the file, and prints."""
    found = json.loads(FILE.read_text()) if FILE.exists() else {}
    for name in sys.argv[1:] or TASKS:
        task = get_task(name, ENV_KWARGS.get(name, ()))
        found[name] = measure(task, 100 if task.horizon <= 500 else 20).record()
        print(name, found[name], flush=True)
        FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
