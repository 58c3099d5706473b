"""Memory stays flat: a run of 200 iterations, all its files included, holds no more at its end than early on."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from places import SUPPORT

ITERATIONS, SETTLED = 200, 20
LIMITS = {"collect.max_train": 400, "collect.max_validation": 200}

RUN = f"""
import json, resource, sys
import probe
from metrpo import training
from metrpo.config import Config
from metrpo.presets import override
from metrpo.console.progress import Progress

class Memory(Progress):
    resident = []

    def end(self, row, seconds_left=None):
        with open("/proc/self/statm") as file:
            self.resident.append(int(file.read().split()[1]) * resource.getpagesize())

config = override(Config(task="Probe", iterations={ITERATIONS}, evaluation_episodes=1), {{
    **{LIMITS}, "collect.steps": 40, "ensemble.members": 2, "ensemble.hidden": (8,), "fit.batch_size": 20,
    "fit.max_passes": 4, "imagine.steps": 60, "policy.hidden": (4,), "validate.max_updates": 4, "validate.starts": 4,
}})
with probe.registered():
    state = training.train(config, sys.argv[1], Memory())
print(json.dumps([Memory.resident, int(state.dataset.train.size), int(state.dataset.validation.size)]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read as Linux gives it")
@pytest.mark.timeout(1800)
def test_two_hundred_iterations_hold_no_more_memory_than_twenty(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(SUPPORT), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path / "run")], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    resident, train, validation = json.loads(done.stdout.splitlines()[-1])
    assert len(resident) == ITERATIONS
    early, late = resident[SETTLED], max(resident[-10:])
    print(f"resident: {early / 2**20:.1f} MiB after {SETTLED} iterations, {late / 2**20:.1f} after {ITERATIONS}")
    assert late <= 1.05 * early
    # 40 steps an iteration are 8,000 steps: both sets are full, and no larger than they may be.
    assert (train, validation) == (LIMITS["collect.max_train"], LIMITS["collect.max_validation"])
    # Nor does the directory grow: two checkpoints, and the episodes that they have not learned from.
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == 2
    assert len(list((tmp_path / "run" / "episodes").iterdir())) <= 4
