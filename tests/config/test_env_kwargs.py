"""Keyword arguments of an environment: one way to write each, and what is made with them."""

import contextlib

import pytest

from metrpo import training
from metrpo.commands.default_dir import default_run_dir
from metrpo.commands.parse import parse
from metrpo.config import Config, difference, from_json, to_json
from metrpo.config.env_kwargs import canonical, keywords
from metrpo.errors import ConfigError, RunDirectoryError, TaskError
from metrpo.history import History
from metrpo.launch.grid import Grid
from metrpo.presets import override, preset
from metrpo.run.directory import RunDirectory
from metrpo.world.registry import get_task


def test_values_are_json_or_texts_and_have_one_spelling():
    typed = ("size=[1,2]", "g=5.0", "mode=hard", "on=true", "version='5'", 'number="5"', "none=None", "deep={}")
    values = keywords(typed)
    assert values == {
        "size": [1, 2], "g": 5.0, "mode": "hard", "on": True, "version": "'5'", "number": "5", "none": None, "deep": {},
    }  # fmt: skip
    assert canonical(values) == canonical(typed) == canonical(reversed(typed))
    assert keywords(canonical(values)) == values
    assert canonical(["on=True"]) == ("on=true",)
    assert keywords([f"deep={'[' * 100_000}"])["deep"].startswith("[["), "never a RecursionError"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["g"], r"env_kwargs: expected KEY=VALUE, such as g=5.0 or mode=easy, got 'g'"),
        (["=5"], "expected KEY=VALUE"),
        (["a b=5"], "expected KEY=VALUE"),
        (["g=1", "g=2"], "expected each argument once, got g twice"),
        ({"f": print}, "env_kwargs: f: expected numbers, strings, lists or dicts of them"),
    ],
)
def test_what_is_no_argument_is_refused(given, message):
    with pytest.raises(ConfigError, match=message):
        canonical(given)
    with pytest.raises(ConfigError, match="imports: expected the name of a module, got 'a-b'"):
        Config("x", imports=("a-b",))


def test_arguments_are_part_of_a_runs_settings(tmp_path):
    config = preset("Pendulum-v1", env_kwargs={"g": 5.0})
    assert config == override(preset("Pendulum-v1"), {"env_kwargs": ["g=5.0"]})
    assert from_json(to_json(config)).env_kwargs == ("g=5.0",)
    assert difference(preset("Pendulum-v1"), config) == {"env_kwargs": ((), ("g=5.0",))}
    typed = parse(["train", "Pendulum-v1", "--env-kwargs", "g=5.00"])
    assert typed.config == config
    assert str(default_run_dir(config)) == "runs/Pendulum-v1-fast-seed0-env_kwargs=g-5.0"
    RunDirectory(tmp_path / "run", config).close()
    with RunDirectory(tmp_path / "run", config) as run:
        run.episodes.layout = History(1, 3, 1)
        run.path.joinpath("metrics.csv").write_text("iteration\n1\n")
    with pytest.raises(RunDirectoryError, match="env_kwargs"):
        RunDirectory(tmp_path / "run", preset("Pendulum-v1", env_kwargs={"g": 9.0}))


def test_a_grid_may_vary_them():
    runs = Grid(("Pendulum-v1",), settings={"env_kwargs": [["g=5.0"], ["g=9.0", "render_mode=rgb_array"]]}).runs()
    assert [run.arguments[-2:] for run in runs] == [["--env-kwargs", "g=5.0"], ["g=9.0", "render_mode=rgb_array"]]
    assert [parse(["train", *run.arguments]).config for run in runs] == [run.config for run in runs]
    named = Grid(("Pendulum-v1",), settings={"imports": [["json"]]}).runs()
    assert parse(["train", *named[0].arguments]).config.imports == ("json",)


def test_formulas_are_held_against_an_environment_with_arguments():
    assert get_task("Pendulum-v1", {"g": 5.0}).reward is get_task("Pendulum-v1").reward
    with contextlib.closing(get_task("Pendulum-v1", {"g": 5.0}).make_env()) as env:
        assert env._env.unwrapped.g == 5.0
    with_other = preset("Reacher-v5", env_kwargs={"reward_control_weight": 7.0})
    with pytest.raises(TaskError, match="learn it from data with --learn-reward"):
        training.check(with_other, get_task("Reacher-v5", with_other.env_kwargs))
    training.check(preset("Reacher-v5"), get_task("Reacher-v5"))


def test_arguments_that_cannot_be_used_are_refused():
    with pytest.raises(TaskError, match=r"Pendulum-v1: cannot create the environment \(TypeError: .*gravity"):
        get_task("Pendulum-v1", {"gravity": 1})
    with pytest.raises(TaskError, match="Swimmer: expected no env_kwargs, got g=5: its environment exists already"):
        get_task("Swimmer", {"g": 5})
