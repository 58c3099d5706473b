"""Without what only Unix has, a policy can be loaded, evaluated and exported, and a run begun."""

import subprocess
import sys

from helpers import random_policy
from metrpo.run.policy_file import Learned, save_policy

HIDDEN = """
import os, sys
for module in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[module] = None
for name in ("O_NONBLOCK", "getuid", "sysconf", "sched_getaffinity", "sched_setaffinity", "mkfifo"):
    delattr(os, name)
"""
USED = """
import logging
from metrpo.run import machine
assert machine.memory() > 0 and machine.cores() > 0 and machine.cache_folder()
import metrpo
policy = metrpo.load_policy("run")
print(metrpo.evaluate("run", episodes=1).returns.shape)
from metrpo.commands.main import main
assert main(["export", "run", "--out", "held.py"]) == 0
assert main(["evaluate", "run", "--episodes", "1"]) == 0
from metrpo.run.lock import hold
import pathlib
hold(pathlib.Path("run")).close()
import metrpo.training, metrpo.launch.dispatch, metrpo.external
print("all")
"""


def test_a_policy_is_used_where_there_is_no_unix(tmp_path):
    save_policy(tmp_path / "run", random_policy(0, 3, 1), "Pendulum-v1", Learned(1, 200, 1.5))
    code = [sys.executable, "-c", HIDDEN + USED]
    ran = subprocess.run(code, cwd=tmp_path, capture_output=True, text=True)
    assert (ran.returncode, ran.stdout.splitlines()[-1]) == (0, "all"), ran.stderr
    assert "(1,)" in ran.stdout
    assert "has no Unix file locks" in ran.stderr
