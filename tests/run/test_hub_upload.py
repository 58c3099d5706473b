"""Policies on the Hugging Face hub, whose part a stub plays here: what is sent, the card, what is refused."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

import metrpo
from helpers import random_policy
from hub_stub import OWNER, TOKEN, hub
from metrpo.commands import main
from metrpo.config import Config
from metrpo.errors import MetrpoError, RunDirectoryError, TaskError
from metrpo.evaluation import evaluate, render
from metrpo.hub import repository
from metrpo.run.hub_upload import parcel
from metrpo.run.policy_file import Learned, save_policy
from metrpo.world.registry import get_task
from seen_runs import a_run

CONFIG = Config("Swimmer", seed=3, iterations=2)
FILES = {"README.md", "config.json", "curve.png", "metrics.csv", "policy.json", "policy.npz", "policy.py", "replay.mp4"}


def a_finished_run(folder, config=CONFIG, returns=(1.5, 34.25)):
    rows = [
        {"iteration": i, "real_steps": 3000 * i, "return_real": value, "return_real_std": 0.75 * i}
        for i, value in enumerate(returns, 1)
    ]
    a_run(folder, config, rows)
    save_policy(
        folder, random_policy(0, 10, 2), config.task, Learned(len(rows), 3000 * len(rows), returns[-1]), settings=config
    )
    yardsticks = {"task": config.task, "zero": {"mean": -1.25}, "random": {"mean": -2.5}}
    about = {"commit": "abc1234", "created": "2026-01-02T03:04", "yardsticks": yardsticks}
    (folder / "run.json").write_text(json.dumps(about))
    (folder / "curve.png").write_bytes(b"a picture")
    (folder / "video.mp4").write_bytes(b"a video")
    return folder


def head_of(card):
    yaml = pytest.importorskip("yaml")
    start, head, body = card.split("---\n", 2)
    assert start == ""
    return yaml.safe_load(head), body


def test_a_dry_run_writes_the_card_and_lists_the_files(tmp_path, monkeypatch, capsys):
    run_dir = a_finished_run(tmp_path / "run")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)  # neither the extra nor a network
    assert main.main(["push", str(run_dir), "--repo", "me/swim", "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert {line.split()[0] for line in out.splitlines()[:-1]} == FILES
    assert out.splitlines()[-1] == f"would upload to me/swim; the card (README.md): {run_dir / 'model_card.md'}"
    head, body = head_of((run_dir / "model_card.md").read_text())
    assert (head["library_name"], "Swimmer" in head["tags"]) == ("metrpo", True)
    (result,) = head["model-index"][0]["results"]
    assert (result["dataset"]["name"], result["metrics"][0]["value"]) == ("Swimmer", "34.25 +/- 1.50")
    for said in (
        "return: 34.25 +/- 1.50, mean and standard deviation over 20 real episodes",
        "doing nothing: -1.2",
        "random actions: -2.5",
        "6,000 real steps",
        "system me-trpo, preset fast, seed 3",
        "commit: abc1234; 2026-01-02",
        'import metrpo\npolicy = metrpo.load_policy("hub:me/swim")\n',
        "![Learning curve](curve.png)",
    ):
        assert said in body, said
    assert main.main(["push", str(run_dir), "--dry-run"]) == 0
    assert "would upload to OWNER/metrpo-Swimmer;" in capsys.readouterr().out


def test_what_a_run_lacks_the_card_says(tmp_path):
    run_dir = a_finished_run(tmp_path / "run", dataclasses.replace(CONFIG, seed=1), returns=(1.0, float("nan")))
    for name in ("run.json", "curve.png", "video.mp4"):
        (run_dir / name).unlink()
    made = parcel(run_dir, "me/swim")
    assert set(made.files) == FILES - {"curve.png", "replay.mp4"}
    head, body = head_of(made.card)
    assert "model-index" not in head
    for said in ("return: not measured\n", "random actions: not measured", "commit: unknown; date unknown"):
        assert said in body, said
    assert "curve.png" not in body


def test_what_a_policy_remembers_its_card_says(tmp_path):
    config = dataclasses.replace(CONFIG, task="mine.py:arm", history=2, max_action=0.5, max_change=0.2)
    made = parcel(a_finished_run(tmp_path / "run", config), "me/arm")
    assert (
        "\nIts actions stay within 0.5 of 0, each within 0.2 of the one before. It sees the last 2 "
        "observations and the actions between them. Call it once a step, and `policy.reset()` before each episode.\n"
    ) in made.card
    assert "`metrpo evaluate hub:me/arm --task PATH/mine.py:arm` plays it." in made.card
    plain = parcel(a_finished_run(tmp_path / "plain", CONFIG), "me/swim").card
    assert "policy.reset" not in plain
    assert "`metrpo evaluate hub:me/swim` plays it." in plain


def test_any_name_of_a_task_is_a_text_of_the_card(tmp_path):
    evil = '/home/me/secret/mine.py:a"b: [\n---\nx`!'
    made = parcel(a_finished_run(tmp_path / "run", dataclasses.replace(CONFIG, task=evil)), None)
    head, body = head_of(made.card)
    assert head["tags"][-1] == 'mine.py:a"b: [ --- x`!'
    assert "secret" not in made.card, "a folder of the author's machine"
    assert body.startswith("\n# me-trpo for `mine.py:a\"b: [ --- x'!`\n")
    assert made.repo == "OWNER/metrpo-mine-a-b-x"


def test_what_is_no_finished_run_is_refused(tmp_path, capsys):
    run_dir = a_finished_run(tmp_path / "run", dataclasses.replace(CONFIG, iterations=3))
    for place, said in (
        (run_dir, "expected a finished run, got one of 2 iterations whose budget is not spent; resume it with"),
        (tmp_path, "expected the directory of a finished run, got one without policy.npz"),
        (tmp_path / "none", "expected the directory of a finished run, got one without policy.npz"),
        ("zoo:Snake", "expected the directory of your own run, got a policy's name"),
    ):
        assert main.main(["push", str(place), "--dry-run"]) == 2
        assert said in capsys.readouterr().err
    for repo in ("me", "me/", "a/b/c", "me/a--b", "me/../x", "me/x y"):
        with pytest.raises(MetrpoError, match="expected a repository as OWNER/NAME"):
            repository(repo)


def test_without_the_extra_it_is_said_what_to_install(tmp_path, monkeypatch, capsys):
    run_dir = a_finished_run(tmp_path / "run")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for command in (["push", str(run_dir), "--repo", "me/x"], ["push", str(run_dir)], ["evaluate", "hub:me/x"]):
        assert main.main(command) == 2
        assert "pip install 'metrpo[hub]'" in capsys.readouterr().err


# ---------------------------------------------------------------- against the stub


@pytest.fixture(scope="module")
def stub():
    pytest.importorskip("huggingface_hub")
    with hub() as running:
        yield running


def metrpo_with(stub, home, *words, token=TOKEN):
    """The library reads its variables when it is imported: in a process of its own."""
    command = [sys.executable, "-m", "metrpo", *map(str, words)]
    return subprocess.run(command, env=stub.environment(home, token), capture_output=True, text=True, timeout=60)


def test_a_policy_is_pushed_and_loaded_again(stub, tmp_path):
    run_dir = a_finished_run(tmp_path / "run")
    ran = metrpo_with(stub, tmp_path / "home", "push", run_dir, "--private")
    name = f"{OWNER}/metrpo-Swimmer"
    assert (ran.returncode, ran.stdout) == (0, f"{stub.address}/{name}\n"), ran.stderr
    sent = stub.repos[name]
    assert (set(sent), stub.private[name], stub.commits.count(name)) == (FILES, True, 1)
    assert sent["policy.npz"] == (run_dir / "policy.npz").read_bytes()
    assert sent["replay.mp4"] == b"a video"
    assert f'load_policy("hub:{name}")' in sent["README.md"].decode()
    again = metrpo_with(stub, tmp_path / "home", "push", run_dir, "--repo", name)
    assert (again.returncode, stub.commits.count(name)) == (0, 2), "a repository that is there takes a second commit"
    code = f"import metrpo, numpy; print(metrpo.load_policy('hub:{name}')(numpy.zeros(10)).tolist())"
    there = stub.environment(tmp_path / "other", token=None)
    loaded = subprocess.run([sys.executable, "-c", code], env=there, capture_output=True, text=True, timeout=60)
    assert json.loads(loaded.stdout) == metrpo.load_policy(run_dir)(np.zeros(10)).tolist(), loaded.stderr


def test_nobody_and_a_stranger_are_told_what_to_do(stub, tmp_path):
    run_dir = a_finished_run(tmp_path / "run")
    ran = metrpo_with(stub, tmp_path / "home", "push", run_dir, "--repo", "me/no", token=None)
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1)
    assert "got no token; run: hf auth login, or set HF_TOKEN" in ran.stderr
    ran = metrpo_with(stub, tmp_path / "home", "push", run_dir, "--repo", "me/no", token="hf_wrong")
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1), ran.stderr
    assert "me/no: expected the hub to take it;" in ran.stderr
    assert "401" in ran.stderr
    assert "me/no" not in stub.repos
    ran = metrpo_with(stub, tmp_path / "home", "evaluate", "hub:me/no", token=None)
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1), ran.stderr
    assert "hub:me/no: expected a repository on the Hugging Face hub that holds policy.npz; " in ran.stderr


# ---------------------------------------------------------------- what a policy from the hub may do


def test_a_policy_of_the_hub_runs_no_code_that_its_author_names(tmp_path, monkeypatch):
    """What its file says of the task is a stranger's: neither a file here of that name is run nor a module imported."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("import pathlib; pathlib.Path('ran').touch(); raise SystemExit")
    (tmp_path / "imported.py").write_text("import pathlib; pathlib.Path('ran').touch()")
    monkeypatch.syspath_prepend(tmp_path)
    there = tmp_path / "there"
    monkeypatch.setattr("metrpo.policy_zoo.downloaded", lambda place: there)
    a_finished_run(there, dataclasses.replace(CONFIG, task="mine.py:task", imports=("imported",)))
    for use in (evaluate, render):
        with pytest.raises(TaskError, match="a downloaded name runs no code here; name the task yourself: --task"):
            use("hub:me/x")
    task = get_task("Swimmer")
    monkeypatch.setattr("metrpo.world.batch_episodes.evaluate", lambda known, *_: np.array([float(known.horizon)]))
    assert evaluate("hub:me/x", task="Swimmer").mean == task.horizon
    recorded = []
    monkeypatch.setattr("metrpo.evaluation.record", lambda make, policy, out, seed: recorded.append(str(out)) or out)
    render("hub:me/x", task="Swimmer")
    assert recorded == ["x.mp4"], "nothing is written into the cache"
    with pytest.raises(MetrpoError, match="hub:me/x: expected --out"):
        metrpo.run.policy_export.export("hub:me/x")
    assert not (tmp_path / "ran").exists()
    with pytest.raises(RunDirectoryError, match="expected the directory of your own run"):
        parcel("hub:me/x", None)
