"""The policies that come with the package: each plays its task, has a whole card, and stands where a run may."""

import json
import sys

import numpy as np
import pytest

import metrpo
from helpers import random_policy
from metrpo import policy_zoo as zoo
from metrpo.commands import main
from metrpo.config import Config
from metrpo.errors import RunDirectoryError
from metrpo.run.files import read_arrays
from metrpo.run.policy_file import Learned, save_policy
from metrpo.world.registry import get_task
from places import ROOT
from seen_runs import a_run

CARD = {
    "name", "task", "return", "no_skill", "real_steps", "system", "preset", "seed", "chosen_of", "mean_of_runs", "run",
    "commit", "created", "curve",
}  # fmt: skip


@pytest.mark.parametrize("name", zoo.names())
def test_every_policy_fits_its_task_and_has_a_card(name):
    card, policy = zoo.card(name), metrpo.load_policy(f"zoo:{name}")
    assert set(card) == CARD
    assert (policy.info.task, policy.info.return_real) == (card["task"], card["return"])
    assert card["no_skill"] is None or card["return"] > card["no_skill"]
    assert card["curve"][-1] == [card["real_steps"], round(card["return"], 2)]
    task = get_task(card["task"])
    assert policy(np.zeros(task.state_size)).shape == (task.action_size,)
    assert policy.to_env(np.zeros(task.action_size)).shape == (task.action_size,), "it knows its range of actions"
    files = {path.name: path.stat().st_size for path in zoo.located(f"zoo:{name}").iterdir()}
    assert set(files) == {"policy.npz", "policy.json", "card.json"}
    arrays = read_arrays(zoo.located(f"zoo:{name}") / "policy.npz")[0]
    assert sum(files.values()) < 20_000 + sum(x.nbytes for x in arrays.values()), "little but its weights"


def test_names_are_forgiving_and_unknown_ones_say_what_is_near():
    assert zoo.located("zoo:sWIMMER") == zoo.FOLDER / "Swimmer"
    assert zoo.located("zoo:mbbl/Pendulum") == zoo.FOLDER / "mbbl-Pendulum"
    with pytest.raises(RunDirectoryError, match="zoo:Snak: did you mean Snake"):
        metrpo.load_policy("zoo:Snak")
    with pytest.raises(RunDirectoryError, match="metrpo zoo lists the"):
        metrpo.evaluate("zoo:../zoo_policies/Snake")
    assert str(zoo.located("runs/zoo:x")) == "runs/zoo:x"


def test_the_zoo_is_evaluated_rendered_and_exported(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main.main(["evaluate", "zoo:Snake", "--episodes", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mean"] > 0.5 * zoo.card("Snake")["return"], "it swims"
    assert main.main(["export", "zoo:Snake"]) == 2
    assert "zoo:Snake: expected --out" in capsys.readouterr().err
    assert main.main(["export", "zoo:Snake", "--out", "snake.py"]) == 0
    seen = []
    monkeypatch.setattr("metrpo.evaluation.record", lambda make, policy, out, seed: seen.append(out) or out)
    assert main.main(["render", "zoo:Snake"]) == 0
    assert [str(path) for path in seen] == ["Snake.mp4"], "nothing is written into the package"


def test_the_command_lists_them_and_shows_a_card(capsys):
    assert main.main(["zoo"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in zoo.names())
    assert main.main(["zoo", "Snake"]) == 0
    assert "zoo:Snake: a policy for Snake" in capsys.readouterr().out
    assert main.main(["zoo", "Snake", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["task"] == "Snake"
    assert main.main(["zoo", "Nobody"]) == 2


def test_the_best_run_that_shows_skill_is_chosen(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "tools"))
    import fill_zoo

    def left(name, config, returns):
        rows = [{"iteration": i, "real_steps": 100 * i, "return_real": value} for i, value in enumerate(returns, 1)]
        folder = a_run(tmp_path / "runs" / name, config, rows)
        sizes = get_task(config.task).state_size, get_task(config.task).action_size
        save_policy(
            folder, random_policy(0, *sizes), config.task, Learned(len(returns), 100 * len(returns), returns[-1])
        )
        (folder / "run.json").write_text('{"commit": "abc", "created": "2026-01-02T03:04"}')

    left("a", Config("Swimmer", seed=0), [1.0, 3.0])
    left("b", Config("Swimmer", seed=1), [1.0, 9.0, 7.0])
    left("c", Config("Swimmer", seed=2, method="trpo", system="trpo"), [50.0])
    left("d", Config("Snake"), [-2.0])
    out = tmp_path / "zoo"
    for before in ("Ant", "Snake", "Swimmer"):
        (out / before).mkdir(parents=True)
        (out / before / "old").touch()
    lines = fill_zoo.fill([tmp_path / "runs"], out, {"Snake": {"zero": {"mean": -1.7}}})
    assert lines == ["left out Snake: -2.0, and no skill earns -1.7", "zoo:Swimmer: 7.0, the best of 2 runs"]
    card = json.loads((out / "Swimmer" / "card.json").read_text())
    assert (card["return"], card["mean_of_runs"], card["commit"], card["created"]) == (7.0, 5.0, "abc", "2026-01-02")
    assert card["curve"] == [[100, 1.0], [200, 9.0], [300, 7.0]]
    assert metrpo.load_policy(out / "Swimmer").info.action_low == (-1.0, -1.0)
    assert sorted(path.name for path in out.iterdir()) == ["Ant", "Swimmer"], "of these tasks, what was there is gone"
    assert not (out / "Swimmer" / "old").exists()
    sys.modules.pop("fill_zoo")
