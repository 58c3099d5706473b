"""What a newcomer adds: a function, its row in a table and its name among the choices; nothing else knows of it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import metrpo
import tiny_run
from places import SUPPORT

SAMPLING = '''

def boldest_model(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """The largest of all models' predictions, dimension by dimension."""
    return with_carried(ensemble, states, actions, jnp.max(_of_all_models(ensemble, states, actions), axis=0))


SAMPLINGS["boldest_model"] = Sampling(boldest_model)
'''
IMPROVER = """

def _bold(
    settings: PhaseSettings, policy: Policy, moments: Any, batch: Batch, key: Key[Array, ""]
) -> tuple[Policy, Any, ImproveInfo]:
    print("bold", "compiles")
    return vpg.improve(policy, moments, batch, settings.gradient, settings.mean_penalty)


IMPROVERS["bold"] = _by_score_function(_bold)
"""

GREET = """
from dataclasses import dataclass

from tyro.conf import Positional


@dataclass(frozen=True)
class Greet:
    whom: Positional[str]


def run(command):
    print(f"hello {command.whom}")
    return 0
"""


def scratch_copy(folder: Path) -> Path:
    """The package, copied into a folder that PYTHONPATH may name."""
    package = folder / "metrpo"
    shutil.copytree(Path(metrpo.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    return package


def test_a_new_command_is_one_file_and_one_row(tmp_path):
    """Nothing else has to know of it."""
    package = scratch_copy(tmp_path)
    (package / "commands" / "greet.py").write_text(GREET)
    table = package / "commands" / "command_table.py"
    table.write_text(table.read_text().replace('        "doctor":', '        "greet": "Say hello",\n        "doctor":'))

    def run_there(*words: str) -> str:
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        command = [sys.executable, "-m", "metrpo", *words]
        return subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout

    assert "greet      Say hello" in run_there("--help")
    assert run_there("greet", "you") == "hello you\n"


def test_a_new_sampling_and_a_new_improver_are_a_row_and_a_name_each(tmp_path):
    """In a scratch copy of the package: they run by name, and the files that change are these four."""
    package = scratch_copy(tmp_path)
    for name, text in (("model/sampling.py", SAMPLING), ("policy/improvers/improver_table.py", IMPROVER)):
        (package / name).write_text((package / name).read_text() + text)
    for name, choice, choices in (
        ("stage_settings.py", '"one_model"] = "step_rand"', '"one_model", "boldest_model"] = "step_rand"'),
        ("schema.py", '"bptt-stochastic", "actor-critic"]', '"bptt-stochastic", "bold", "actor-critic"]'),
    ):
        file = package / "config" / name
        file.write_text(file.read_text().replace(choice, choices))
    chosen = ["--iterations", "1", "--imagine.sampling", "boldest_model", "--improver", "bold"]
    line = tiny_run.process_line(tmp_path / "run", *chosen)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tmp_path, SUPPORT)))}
    ran = subprocess.run(line, capture_output=True, text=True, env=environment)
    assert ran.returncode == 0, ran.stderr
    assert "bold compiles" in ran.stdout
    assert metrpo.read_metrics(tmp_path / "run" / "metrics.csv")[0]["updates"] > 0
