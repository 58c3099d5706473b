"""Grids of runs: all combinations, refused as a whole when one cannot be, each what `metrpo train` would run."""

from __future__ import annotations

import dataclasses
import hashlib

import pytest

from metrpo.commands import main, parse
from metrpo.commands.sweep import grid_of
from metrpo.config import Config
from metrpo.errors import ConfigError, TaskError
from metrpo.launch import dispatch, grid
from metrpo.launch.backend import Means
from metrpo.launch.grid import Grid, from_file, seeds_of, values_of
from metrpo.run import machine

GRID = Grid(
    ("Swimmer", "mbbl/Pendulum"),
    ("me-trpo", "k-1"),
    (0, 1),
    settings={"trpo.max_kl": [0.01, 0.05], "ensemble.hidden": [[8], [16, 16]], "deterministic": [True]},
)


def test_every_combination_is_a_run_of_its_own():
    runs = GRID.runs()
    assert len(runs) == len({run.name for run in runs}) == 2 * 2 * 2 * 2 * 2
    assert [run.seed for run in runs] == [0] * 16 + [1] * 16, "a first seed of everything comes first"
    assert runs[0].name == "Swimmer/me-trpo,trpo.max_kl=0.01,ensemble.hidden=8,deterministic=True/seed-0"
    assert {run.name.count("/") for run in runs} == {2}
    c = runs[-1].config
    assert (c.task, c.system, c.seed, c.ensemble.members) == ("mbbl/Pendulum", "k-1", 1, 1)
    assert (c.trpo.max_kl, c.ensemble.hidden, c.deterministic) == (0.05, (16, 16), True)


def test_a_long_combination_has_a_folder_name_every_disk_takes(tmp_path):
    many = {
        "ensemble.members": [2],
        "ensemble.hidden": [[256, 256, 256]],
        "fit.max_passes": [100],
        "imagine.steps": [50000],
        "imagine.horizon": [100],
        "validate.max_updates": [40],
        "validate.patience": [25],
        "collect.steps": [4000],
        "trpo.max_kl": [0.01],
        "trpo.cg_iterations": [10],
        "policy.hidden": [[32, 32]],
        "advantage.discount": [0.99, 0.999],
    }
    runs = Grid(("Swimmer",), seeds=(0,), settings=many).runs()
    words = "me-trpo," + ",".join(
        f"{n}={'x'.join(map(str, v[0])) if isinstance(v[0], list) else v[0]}" for n, v in many.items()
    )
    assert len(words) > 255
    folders = [run.name.split("/")[1] for run in runs]
    assert folders[0] == words[:180] + "," + hashlib.sha256(words.encode()).hexdigest()[:16]
    assert folders[1].startswith(words[:180])
    assert len(set(folders)) == 2, "what is cut off still counts"
    for run in runs:
        (tmp_path / run.name).mkdir(parents=True)
    assert grid.variant_name("k-1", (("a", "é" * 124 + "b"),)) == "k-1,a=" + "é" * 124 + "b", "255 bytes"
    assert grid.variant_name("k-10", (("a", "é" * 125),)).startswith("k-10,a=" + "é" * 86 + ","), "no half letters"


def test_what_is_run_is_what_the_grid_says(monkeypatch):
    monkeypatch.setattr(machine, "prepare", lambda *_: None)
    for run in Grid(("Swimmer",), settings=GRID.settings | {"imagine.horizon": [50], "learn_reward": [False]}).runs():
        typed = parse.parse(["train", *run.arguments])
        assert Config(**{f.name: getattr(typed, f.name) for f in dataclasses.fields(Config)}) == run.config


def told(line):
    """The grid of a command line."""
    return grid_of(parse.parse(["sweep", *line.split()]))


@pytest.mark.parametrize(
    "lines",
    [
        ("--set ensemble.members=1,2 trpo.max_kl=0.1", "--set ensemble.members=1,2 --jobs 2 --set trpo.max_kl=0.1"),
        ("--set ensemble.members=1,2 trpo.max_kl=0.1", "--set=ensemble.members=1,2 --set=trpo.max_kl=0.1"),
        ("--tasks Swimmer Snake", "--tasks Swimmer --tasks Snake"),
        ("--systems k-1 k-10 --seeds 0", "--systems k-1 --seeds 0 --systems k-10"),
        ("--seeds 0 1 2 5", "--seeds 0:3 --seeds 5", "--seeds 0:3,5", "--seeds=0,1 --seeds 2,5 1"),
    ],
)
def test_lists_may_be_given_at_once_or_one_by_one(lines):
    first, *others = map(told, lines)
    assert len(first.runs()) > 1
    for other in others:
        assert other == first


def test_a_setting_is_given_once():
    with pytest.raises(ConfigError, match=r"set: expected each name once, got trpo.max_kl, trpo.max_kl"):
        told("--set trpo.max_kl=0.1 --set trpo.max_kl=0.2")


def test_a_budget_is_each_runs_and_names_no_folder(tmp_path):
    usual = told("--seeds 0").runs()
    for name in ("iterations", "real_steps"):
        runs = told(f"--seeds 0 --{name.replace('_', '-')} 7000").runs()
        assert [getattr(run.config, name) for run in runs] == [7000]
        assert [run.name for run in runs] == [run.name for run in usual], "a larger budget goes on with the same runs"
        assert f"--{name.replace('_', '-')} 7000" in " ".join(runs[0].arguments)
        (tmp_path / "grid.toml").write_text(f'tasks = ["Swimmer"]\nseeds = [0]\n{name} = 7000')
        assert from_file(tmp_path / "grid.toml").runs() == runs
    for words in ("--iterations 3 --real-steps 4", "--iterations 3 --set real_steps=100"):
        with pytest.raises(ConfigError, match="leave one out"):
            told(words).runs()
    (tmp_path / "grid.toml").write_text('tasks = ["Swimmer"]\niterations = 3\nreal_steps = 4')
    with pytest.raises(ConfigError, match="got both"):
        from_file(tmp_path / "grid.toml").runs()


def test_systems_may_have_budgets_of_their_own(tmp_path):
    runs = told("--systems me-trpo trpo k-1 --seeds 0 --iterations 4 --budget trpo=90000 me-trpo=3000").runs()
    found = {run.system: (run.config.iterations, run.config.real_steps) for run in runs}
    assert {system: steps for system, (_, steps) in found.items()} == {"me-trpo": 3000, "trpo": 90000, "k-1": None}
    assert found["k-1"] == (4, None)
    assert [run.name for run in runs] == [run.name for run in told("--systems me-trpo trpo k-1 --seeds 0").runs()]
    assert ["--real-steps 90000" in " ".join(run.arguments) for run in runs] == [False, True, False]
    file = tmp_path / "grid.toml"
    head = 'tasks = ["Swimmer"]\nsystems = ["me-trpo", "trpo", "k-1"]\nseeds = [0]\niterations = 4\n'
    file.write_text(f"{head}[budget]\ntrpo = 90000\nme-trpo = 3000\n")
    assert from_file(file).runs() == runs
    for words, message in (
        ("--budget trpo=9", r"budget: expected a system of the grid \(me-trpo\), got trpo"),
        ("--budget me-trpo", "budget: expected SYSTEM=REAL_STEPS such as trpo=300000, got 'me-trpo'"),
        ("--budget me-trpo=1e6", "budget: expected SYSTEM=REAL_STEPS"),
        ("--budget me-trpo=-1", "real_steps: expected at least 0"),
        ("--budget me-trpo=1 me-trpo=2", "budget: expected each name once, got me-trpo, me-trpo"),
        ("--budget me-trpo=1 --set real_steps=2", "set: real_steps: expected the budget once"),
    ):
        with pytest.raises(ConfigError, match=message):
            told(words).runs()
    for text, message in (('trpo = "many"', "real_steps: expected"), ("trpo = 1.5", "real_steps: expected")):
        file.write_text(f"{head}[budget]\n{text}\n")
        with pytest.raises(ConfigError, match=message):
            from_file(file).runs()
    file.write_text(f"{head}budget = 3\n")
    with pytest.raises(ConfigError, match="budget: expected a table of systems and their real steps, got 3"):
        from_file(file)


def test_a_file_stands_alone():
    with pytest.raises(ConfigError, match=r"seeds: expected it in grid\.toml alone"):
        parse.parse(["sweep", "grid.toml", "--seeds", "3"])
    with pytest.raises(ConfigError, match=r"seeds: expected it in grid\.toml alone"):
        parse.parse(["sweep", "grid.toml", "--seeds=0:3"])  # its default: asked for all the same
    assert parse.parse(["sweep", "grid.toml", "--jobs", "3", "--out", "a", "--dry-run"]).dry_run


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (Grid(("Swimmer",), settings={"trpo.max_lk": [1]}), "unknown setting 'trpo.max_lk'"),
        (Grid(("Swimmer",), settings={"trpo.max_kl": [0.1, -1.0]}), "trpo.max_kl: expected a finite number > 0"),
        (Grid(("Swimmer",), settings={"trpo.max_kl": []}), "expected at least one"),
        (Grid(()), "expected at least one"),
        (Grid(("Swimmer",), ("me-trop",)), "systems: expected some of me-trpo, .* got me-trop"),
    ],
)
def test_a_grid_with_an_impossible_run_is_refused_as_a_whole(grid, message):
    with pytest.raises(ConfigError, match=message):
        grid.runs()


def test_an_unknown_task_is_refused():
    with pytest.raises(TaskError, match="unknown task 'Swimer'"):
        Grid(("Swimmer", "Swimer")).runs()


@pytest.mark.parametrize(("text", "seeds"), [("3", (3,)), ("0:3", (0, 1, 2)), (":2", (0, 1)), ("0,2,7", (0, 2, 7))])
def test_seeds(text, seeds):
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3:3", "-1", "1:", "0;1"])
def test_wrong_seeds(text):
    with pytest.raises(ConfigError, match="seeds: expected"):
        seeds_of(text)


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("ensemble.members=1,5,10", "ensemble.members", [1, 5, 10]),
        ("ensemble.hidden=[200,200],[512]", "ensemble.hidden", [[200, 200], [512]]),
        ("imagine.sampling=step_rand,model_mean", "imagine.sampling", ["step_rand", "model_mean"]),
        ("imagine.horizon=None,50", "imagine.horizon", [None, 50]),
        ("deterministic=true,False", "deterministic", [True, False]),
    ],
)
def test_values(text, name, values):
    assert values_of(text) == (name, values)


@pytest.mark.parametrize("text", ["ensemble.members", "=1", "ensemble.members="])
def test_wrong_values(text):
    with pytest.raises(ConfigError, match="set: expected NAME=VALUE"):
        values_of(text)


def test_a_file_says_the_same_as_options(tmp_path):
    file = tmp_path / "grid.toml"
    file.write_text(
        'tasks = ["Swimmer", "mbbl/Pendulum"]\nsystems = ["me-trpo", "k-1"]\nseeds = "0:2"\n'
        "[set]\ntrpo.max_kl = [0.01, 0.05]\nensemble.hidden = [[8], [16, 16]]\ndeterministic = true\n"
    )
    assert from_file(file).runs() == GRID.runs()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tasks = [", "expected a TOML file"),
        ('task = ["Swimmer"]', "got task"),
        ("seeds = 3", "expected lists"),
        ('tasks = "Swimmer"', "expected lists"),
        ('tasks = ["Swimmer"]\nset = 3', "expected lists"),
        ('seeds = "x"', "seeds: expected"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    file = tmp_path / "grid.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        from_file(file)
    with pytest.raises(ConfigError, match="expected a TOML file"):
        from_file(tmp_path / "none.toml")


def test_the_command_runs_the_grid_and_says_how_it_ended(tmp_path, monkeypatch, capsys):
    asked = []

    def two_of_three(runs, out, means, tell):
        asked.append((len(runs), out, means))
        return runs[:1]

    monkeypatch.setattr(dispatch, "dispatch", two_of_three)
    command = ["sweep", "--set", "ensemble.members=1,5", "--seeds", "0:2", "--jobs", "3", "--out", str(tmp_path)]
    assert main.main(command) == 1
    assert "1 of 4 runs failed" in capsys.readouterr().err
    assert asked == [(4, tmp_path, Means(jobs=3))]
    assert main.main([*command, "--dry-run"]) == 0
    assert capsys.readouterr().out.count("metrpo train Swimmer") == 4
    assert len(asked) == 1


def test_a_range_without_seeds_says_so():
    with pytest.raises(ConfigError, match=r"got '3:1', which holds none$"):
        seeds_of("3:1")
    with pytest.raises(ConfigError, match=r"got 'a'$"):
        seeds_of("a")
