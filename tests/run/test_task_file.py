"""Tasks out of files and modules: neighbours, the current folder, Gymnasium's own form, and files that have moved."""

import contextlib
import dataclasses
import json
import re
import shutil
import sys
import textwrap
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest

from helpers import random_policy
from metrpo.commands import main
from metrpo.commands.parse import parse
from metrpo.config import Config, to_json
from metrpo.errors import ConfigError, TaskError
from metrpo.external import begin
from metrpo.presets import override, preset
from metrpo.run.policy_file import Learned, save_policy
from metrpo.run.task_file import moved, remember, task_of_run
from metrpo.training import train
from metrpo.world import resolve
from metrpo.world.registry import get_task

pytestmark = pytest.mark.usefixtures("plain_curve")

MAKE = """
    import gymnasium

    def make(**kwargs):
        return gymnasium.make("Pendulum-v1", {horizon}, **kwargs)
"""


@pytest.fixture(autouse=True)
def _as_before(monkeypatch, tmp_path):
    """Each test has modules, paths and places of its own, and a current folder."""
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    monkeypatch.setattr(resolve, "_PLACES", {})
    monkeypatch.setattr(gymnasium.envs.registration, "registry", registry := dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", registry)
    before = set(sys.modules)
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path)
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]
    resolve.resolved.cache_clear()


def write(path, text, **fields):
    Path(path).write_text(textwrap.dedent(text.format(**fields)))


def test_a_task_file_finds_its_neighbours(tmp_path):
    write("there/robot_parts.py", "LENGTH = 7\n")
    write("there/late_parts.py", "LENGTH = 8\n")
    write(
        "there/mine.py",
        "import robot_parts\n"
        + textwrap.dedent(MAKE).format(horizon="late()")
        + textwrap.dedent("""
        def late():
            import late_parts
            return robot_parts.LENGTH + late_parts.LENGTH
    """),
    )
    path = list(sys.path)
    assert get_task("there/mine.py:make").horizon == 15
    assert sys.path == [*path, str(tmp_path / "there")], "nothing of Python's own may be shadowed later"


def test_a_module_of_the_current_folder_is_found(tmp_path, monkeypatch):
    write("my_task.py", MAKE, horizon=30)
    assert get_task("my_task:make").horizon == 30
    write("there/other_task.py", MAKE, horizon=40)
    with pytest.raises(TaskError, match=r"expected a module other_task in .*, found none; go to the folder that holds"):
        get_task("other_task:make")
    with pytest.raises(TaskError, match=f"expected a module no_such in {re.escape(str(tmp_path))} or on"):
        get_task("mine/Env-v0", imports=["no_such"])
    write("needy_task.py", "import other_task")
    with pytest.raises(
        TaskError, match=r"cannot import needy_task \(ModuleNotFoundError: No module named 'other_task'"
    ):
        get_task("needy_task:make")


def test_gymnasiums_own_form_imports_what_registers_the_id():
    write(
        "my_ids.py",
        """
        import gymnasium
        entry = "gymnasium.envs.classic_control.pendulum:PendulumEnv"
        gymnasium.register("MyOwn-v3", entry_point=entry, max_episode_steps=60)
        gymnasium.register("mine/MyOwn-v3", entry_point=entry, max_episode_steps=70)
    """,
    )
    task = get_task("my_ids:MyOwn-v3")
    assert (task.name, task.horizon) == ("my_ids:MyOwn-v3", 60)
    assert get_task("my_ids:mine/MyOwn-v3").horizon == 70
    write(
        "more_ids.py",
        """
        import gymnasium
        gymnasium.register("MyOwn-v5", entry_point=gymnasium.spec("Pendulum-v1").entry_point, max_episode_steps=80)
    """,
    )
    assert get_task("more_ids.py:MyOwn-v5").horizon == 80
    with pytest.raises(TaskError, match="my_ids neither defines nor registers 'MyOwn-v4'; define it there"):
        get_task("my_ids:MyOwn-v4")


def test_two_files_of_one_name_are_two_tasks(monkeypatch):
    write("mine.py", MAKE, horizon=20)
    write("there/mine.py", MAKE, horizon=25)
    assert (get_task("mine.py:make").horizon, get_task("there/mine.py:make").horizon) == (20, 25)
    monkeypatch.chdir("there")
    assert get_task("mine.py:make").horizon == 25, "what the name means here"


def a_run(run_dir, task, **choice):
    """What a run of a file's task leaves, as far as evaluating it goes."""
    run_dir.mkdir()
    (run_dir / "run.json").write_text('{"format": 1}')
    config = Config(task, **choice)
    remember(run_dir, config)
    save_policy(run_dir, random_policy(0, 3, 1), task, Learned(1, 200, 1.5), settings=config)


def evaluated(capsys, *arguments):
    code = main.main(["evaluate", "--episodes", "1", "--json", *arguments])
    out, err = capsys.readouterr()
    return code, json.loads(out)["task"] if out else err


def test_a_run_is_evaluated_elsewhere_and_after_its_file_moved(tmp_path, monkeypatch, capsys):
    write("there/mine.py", MAKE, horizon=5)
    monkeypatch.chdir("there")
    a_run(tmp_path / "run", "mine.py:make")
    assert evaluated(capsys, "../run") == (0, "mine.py:make")
    monkeypatch.chdir(tmp_path)
    assert evaluated(capsys, "run") == (0, "mine.py:make")
    shutil.copytree("run", "run/best", ignore=shutil.ignore_patterns("run.json"))
    for place in ("run/best", "run/policy.npz", "run/best/policy.npz"):
        assert evaluated(capsys, place) == (0, "mine.py:make")
    (tmp_path / "there").rename(tmp_path / "moved")
    monkeypatch.setattr(resolve, "_PLACES", {})
    code, said = evaluated(capsys, "run")
    assert code == 2
    assert "expected a Python file at " in said
    assert "found none; if it has moved, give its new place: --task path/to/file.py:name" in said
    assert evaluated(capsys, "run", "--task", "moved/mine.py:make") == (0, "moved/mine.py:make")


def forgotten(monkeypatch, *names):
    """As in a new process."""
    monkeypatch.setattr(resolve, "_PLACES", {})
    monkeypatch.setattr(sys, "path", [place for place in sys.path if "/pytest-" not in place])
    resolve.resolved.cache_clear()
    for name in names:
        del sys.modules[name]


def test_a_modules_run_is_evaluated_elsewhere_and_after_it_moved(tmp_path, monkeypatch, capsys):
    Path("there/parts").mkdir()
    write("there/parts/__init__.py", "LENGTH = 5\n")
    write("there/parts/mine.py", "from . import LENGTH\n" + textwrap.dedent(MAKE).format(horizon="LENGTH"))
    monkeypatch.chdir("there")
    get_task("parts.mine:make")
    a_run(tmp_path / "run", "parts.mine:make")
    assert json.loads((tmp_path / "run" / "run.json").read_text())["task_folder"] == str(tmp_path / "there")
    monkeypatch.chdir(tmp_path)
    forgotten(monkeypatch, "parts.mine", "parts")
    assert evaluated(capsys, "run") == (0, "parts.mine:make")
    (tmp_path / "there").rename(tmp_path / "moved")
    forgotten(monkeypatch, "parts.mine", "parts")
    code, said = evaluated(capsys, "run")
    assert code == 2
    assert "expected a module parts.mine in " in said
    assert "if it has moved, give its new place: --task path/to/file.py:name" in said


def test_the_folder_of_an_installed_module_is_not_kept(monkeypatch):
    assert resolve.folder_of("pytest:fixture") is None
    assert resolve.folder_of("Pendulum-v1") is resolve.folder_of("mine.py:make") is None


def test_a_policy_may_be_evaluated_on_another_task_of_its_sizes(tmp_path, capsys):
    save_policy(tmp_path / "run", random_policy(0, 11, 3), "Hopper", Learned(1, 200, 1.5))
    assert evaluated(capsys, "run", "--task", "HopperUpright") == (0, "HopperUpright")


class State(NamedTuple):
    """Of a run that has learned nothing yet."""

    iteration: int
    real_steps: int
    policy: Any


@pytest.mark.parametrize("command", [begin, train])
def test_a_run_remembers_where_its_file_lay(command, tmp_path, monkeypatch):
    write("mine.py", MAKE, horizon=5)
    untrained = State(0, 0, random_policy(0, 3, 1))
    monkeypatch.setattr("metrpo.algorithm.init", lambda config, task: untrained)
    monkeypatch.setattr("metrpo.training.finished", lambda config, state: True)
    command(override(preset("mine.py:make"), {"trust_reward": True}), "run")
    about = json.loads(Path("run/run.json").read_text())
    assert about["task_file"] == str(tmp_path / "mine.py")
    assert about["metrpo"], "what was there stays"


@pytest.mark.parametrize("command", ["collect", "improve", "evaluate", "render"])
def test_every_command_that_plays_or_learns_takes_the_place_anew(command, monkeypatch, capsys):
    write("mine.py", MAKE, horizon=5)
    a_run(Path("run"), "mine.py:make")
    Path("run/config.json").write_text(to_json(preset("mine.py:make")))
    Path("mine.py").rename("there/moved.py")
    resolve.resolved.cache_clear()
    monkeypatch.setattr("metrpo.run.machine.prepare", lambda *_, **__: None)
    made = []
    monkeypatch.setattr(resolve, "task_of", lambda make, *_, **__: made.append(make.__module__) or raising())
    assert main.main([command, "run"]) == 2
    assert "mine.py:make: expected a Python file at" in capsys.readouterr().err
    assert main.main([command, "run", "--task", "there/moved.py:make"]) == 2
    assert "far enough" in capsys.readouterr().err
    assert [name.startswith("metrpo_task_moved") for name in made] == [True]


@pytest.mark.parametrize("command", ["collect", "improve", "evaluate", "render"])
def test_the_error_names_the_task_that_was_tried(command, capsys):
    write("mine.py", MAKE, horizon=5)
    a_run(Path("run"), "mine.py:make")
    Path("run/config.json").write_text(to_json(preset("mine.py:make")))
    assert main.main([command, "run", "--task", "nofile.py:task"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("metrpo: nofile.py:task: expected a Python file at ")
    assert "--task" not in said, "that is where it was tried"
    assert main.main([command, "run", "--task", "Swimer"]) == 2
    assert "unknown task 'Swimer'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "init"])
def test_a_new_run_hears_of_no_option_its_command_lacks(command, capsys):
    assert main.main([command, "nofile.py:task"]) == 2
    said = capsys.readouterr().err
    assert "nofile.py:task: expected a Python file at " in said
    assert "--task" not in said


def raising():
    raise TaskError("far enough")


def test_init_names_only_what_can_add_episodes_to_its_task(monkeypatch, capsys):
    write(
        "arm.py",
        """
        import dataclasses
        import metrpo
        task = dataclasses.replace(metrpo.tasks()["Swimmer"], name="arm", env_id=None)
    """,
    )
    monkeypatch.setattr("metrpo.external.begin", lambda *_: None)
    assert main.main(["init", "arm.py:task", "--run-dir", "my arm"]) == 0
    said = "add episodes (metrpo.append_episode, or metrpo collect 'my arm' --data FILE), then run"
    assert said in capsys.readouterr().out
    assert main.main(["init", "Swimmer", "--run-dir", "swim"]) == 0
    assert "add episodes (metrpo collect swim), then run" in capsys.readouterr().out


def test_only_what_lies_in_a_file_or_module_can_have_moved():
    with pytest.raises(ConfigError, match="task: expected a run whose task lies in a file or module, got"):
        moved(Config("Swimmer"), "there/mine.py:make")


def test_run_json_of_other_tasks_says_no_file(tmp_path):
    (tmp_path / "run.json").write_text('{"format": 1}')
    remember(tmp_path, Config("Swimmer"))
    assert (tmp_path / "run.json").read_text() == '{"format": 1}'
    # Made up by somebody else: it names another file than the task does.
    write("mine.py", MAKE, horizon=5)
    write("there/evil.py", "raise SystemExit(9)\n")
    (tmp_path / "run.json").write_text(json.dumps({"format": 1, "task_file": str(tmp_path / "there" / "evil.py")}))
    assert task_of_run(tmp_path, Config("mine.py:make")).horizon == 5
    assert dataclasses.is_dataclass(task_of_run(tmp_path, Config("Swimmer")))


# ---------------------------------------------------------------- arguments and imports

TILTED = """
    import gymnasium
    from gymnasium.wrappers import TimeLimit
    def tilted(horizon=20, mode="easy", **kwargs):
        assert mode in ("easy", "hard"), mode
        return TimeLimit(gymnasium.make("Pendulum-v1", **kwargs).unwrapped, horizon)
    gymnasium.register("Tilted-v0", entry_point=tilted, max_episode_steps=30)
"""


@pytest.fixture
def tilted(monkeypatch):
    """A module there/tilting.py that registers an id, in the current folder."""
    write("there/tilting.py", TILTED)
    monkeypatch.chdir("there")


def gravity(task):
    with contextlib.closing(task.make_env()) as env:
        return env._env.unwrapped.g


def test_an_imported_id_with_arguments_is_rebuilt_from_anywhere(tmp_path, tilted, monkeypatch, capsys):
    typed = ["Tilted-v0", "--import", "tilting", "--env-kwargs", "g=2.5", "mode=hard"]
    config = parse(["train", *typed]).config
    assert (config.env_kwargs, config.imports) == (("g=2.5", "mode=hard"), ("tilting",))
    a_run(tmp_path / "run", config.task, env_kwargs=config.env_kwargs, imports=config.imports)
    monkeypatch.chdir(tmp_path)
    forgotten(monkeypatch, "tilting")
    gymnasium.registry.pop("Tilted-v0")
    made = []
    monkeypatch.setattr("metrpo.evaluation.batch_episodes.evaluate", lambda task, *_: made.append(task) or np.zeros(1))
    assert evaluated(capsys, "run") == (0, "Tilted-v0")
    assert gravity(made[0]) == 2.5
    monkeypatch.setattr("metrpo.evaluation.record", lambda make_env, *_: made.append(make_env.__self__) or tmp_path)
    assert main.main(["render", "run"]) == 0
    assert gravity(made[1]) == 2.5
    with pytest.raises(TaskError, match="AssertionError: odd"):
        get_task("Tilted-v0", {"mode": "odd"})


def test_an_imported_id_whose_module_moved_is_found_by_its_new_place(tmp_path, tilted, monkeypatch, capsys):
    config = parse(["train", "Tilted-v0", "--import", "tilting", "--env-kwargs", "g=2.5"]).config
    a_run(tmp_path / "run", config.task, env_kwargs=config.env_kwargs, imports=config.imports)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").rename(tmp_path / "moved")
    forgotten(monkeypatch, "tilting")
    gymnasium.registry.pop("Tilted-v0")
    code, said = evaluated(capsys, "run")
    assert code == 2
    assert "give its new place: --task path/to/file.py:name" in said
    made = []
    monkeypatch.setattr("metrpo.evaluation.batch_episodes.evaluate", lambda task, *_: made.append(task) or np.zeros(1))
    place = "moved/tilting.py:Tilted-v0"
    assert evaluated(capsys, "run", "--task", place) == (0, place)
    assert gravity(made[0]) == 2.5


def test_a_file_that_moved_keeps_its_arguments(tmp_path, tilted, monkeypatch, capsys):
    assert get_task("tilting.py:tilted", {"horizon": 7}).horizon == 7
    a_run(tmp_path / "run", "tilting.py:tilted", env_kwargs=("g=3.5",))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").rename(tmp_path / "moved")
    monkeypatch.setattr(resolve, "_PLACES", {})
    gymnasium.registry.pop("Tilted-v0")  # the file registers it once more from its new place
    made = []
    monkeypatch.setattr("metrpo.evaluation.batch_episodes.evaluate", lambda task, *_: made.append(task) or np.zeros(1))
    assert evaluated(capsys, "run", "--task", "moved/tilting.py:tilted") == (0, "moved/tilting.py:tilted")
    assert evaluated(capsys, "run", "--task", "Pendulum-v1")[0] == 0
    assert list(map(gravity, made)) == [3.5, 10.0]
    moved(Config("tilting.py:tilted", env_kwargs=("g=3.5",)), "moved/tilting.py:tilted")
    assert gravity(get_task("tilting.py:tilted", {"g": 3.5})) == 3.5


def test_a_missing_import_is_said(tmp_path, capsys):
    assert main.main(["train", "Pendulum-v1", "--import", "nowhere_at_all"]) == 2
    assert "imports nowhere_at_all: expected a module nowhere_at_all in " in capsys.readouterr().err


def test_a_run_directory_may_end_like_a_policys_file(tmp_path, monkeypatch, capsys):
    write("mine.py", MAKE, horizon=5)
    a_run(tmp_path / "run.npz", "mine.py:make")
    assert json.loads((tmp_path / "run.npz" / "run.json").read_text())["format"] == 1, "noted besides, not instead"


def test_from_inside_the_folder_of_the_best_policy_its_runs_file_is_found(tmp_path, monkeypatch, capsys):
    write("there/mine.py", MAKE, horizon=5)
    monkeypatch.chdir("there")
    a_run(tmp_path / "run", "mine.py:make")
    shutil.copytree(tmp_path / "run", tmp_path / "run/best", ignore=shutil.ignore_patterns("run.json"))
    monkeypatch.chdir(tmp_path / "run" / "best")
    forgotten(monkeypatch)
    assert evaluated(capsys, ".") == (0, "mine.py:make")
