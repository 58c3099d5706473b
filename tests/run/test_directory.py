"""A run directory: one owner, one run, nothing twice, nothing missing, nothing overwritten."""

import dataclasses
import json
import logging
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blank_run import CONFIG, DETERMINISTIC, a_row, a_state, train
from metrpo import algorithm, training
from metrpo.config import TRPOConfig, to_json
from metrpo.console.progress import Progress
from metrpo.errors import RunDirectoryError
from metrpo.run import derived_files
from metrpo.run import directory as module
from metrpo.run.directory import RunDirectory
from metrpo.run.metrics import read_metrics
from metrpo.run.policy_file import load_policy
from places import SUPPORT


def contents(path: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file() and p.name != ".lock"
    }


def stable(path: Path) -> dict[str, bytes]:
    """All files but TensorBoard's, which name the host and the time."""
    return {name: data for name, data in contents(path).items() if not name.startswith(("events", "run.json"))}


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch):
    # The learning curve costs a second each; test_report draws it.
    monkeypatch.setattr(derived_files, "draw_curve", lambda rows, path, title, *_: None)


def test_the_rows_are_published_last(tmp_path, monkeypatch):
    """By them a run counts as finished and is not begun again: killed before, it must not look so."""
    seen = []

    def look(rows, path, title, yardsticks):
        metrics = path.with_name("metrics.csv")
        published = len(read_metrics(metrics)) if metrics.exists() else 0
        seen.append((len(rows), published, load_policy(path.parent).info.iteration))

    monkeypatch.setattr(derived_files, "draw_curve", look)
    train(tmp_path / "run", until=3)
    assert seen == [(1, 0, 1), (2, 1, 2), (3, 2, 3)]


def test_a_run_leaves_what_a_person_can_read(tmp_path):
    train(tmp_path / "a" / "run")
    path = tmp_path / "a" / "run"
    names = {str(p.relative_to(path)) for p in path.rglob("*") if p.is_file() and "tfevents" not in p.name}
    assert names == {
        ".lock",
        "run.json",
        "config.json",
        "metrics.csv",
        "policy.npz",
        "policy.json",
        "best/policy.npz",
        "best/policy.json",
        "checkpoints/iteration-00004.npz",
        "checkpoints/iteration-00005.npz",
    }
    assert json.loads((path / "run.json").read_text()).keys() >= {
        "format",
        "metrpo",
        "jax",
        "mujoco",
        "python",
        "created",
    }
    assert (path / "config.json").read_text() == to_json(CONFIG)
    rows = read_metrics(path / "metrics.csv")
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5]
    assert list(rows[0]) == [*a_row(1), "wall_seconds"]
    assert rows[4]["return_real"] == float(np.float32(5) / 3)
    assert load_policy(path).info.iteration == 5


def test_resuming_goes_on_where_it_stopped(tmp_path):
    assert train(tmp_path, until=2) == [1, 2]
    assert train(tmp_path, until=2) == []
    assert train(tmp_path, until=4) == [3, 4]
    rows = read_metrics(tmp_path / "metrics.csv")
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    walls = [row["wall_seconds"] for row in rows]
    assert walls == sorted(walls)


def test_the_state_comes_back(tmp_path):
    train(tmp_path, until=3)
    with RunDirectory(tmp_path, CONFIG) as run:
        state = run.load(a_state())
    assert state is not None
    assert state.iteration == 3
    np.testing.assert_array_equal(state.data, a_state(3).data)
    assert type(state.real_steps) is int


def test_wall_seconds_accumulate_over_resumes(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    for _ in range(2):
        with RunDirectory(tmp_path, CONFIG) as run:
            state = run.load(a_state()) or a_state()
            now[0] += 10
            row = run.save(a_state(state.iteration + 1), a_row(state.iteration + 1))
        now[0] += 1000
    assert row["wall_seconds"] == 20


KILLER = """
import os, signal, sys, warnings
from pathlib import Path
warnings.simplefilter("ignore")  # JAX warns of forks; it has not started its threads here
sys.path.insert(0, sys.argv[1])
import tensorboardX  # once, not in every child
import blank_run
from metrpo.run import derived_files
derived_files.draw_curve = lambda rows, path, title, *_: None
calls, real = 0, {name: getattr(os, name) for name in ("replace", "fsync", "unlink")}
def deadly(name):
    def call(*arguments, **named):
        global calls
        calls += 1
        if calls == deadline:
            os.kill(os.getpid(), signal.SIGKILL)
        return real[name](*arguments, **named)
    return call
for name in real:
    setattr(os, name, deadly(name))
status, deadline = 1, -1
while status:
    deadline += 2
    child = os.fork()
    if not child:
        blank_run.train(Path(sys.argv[2]) / str(deadline), blank_run.DETERMINISTIC, until=3)
        os._exit(0)
    _, status = os.waitpid(child, 0)
print(deadline)
"""


def test_a_run_killed_at_any_write_resumes_as_if_uninterrupted(tmp_path):
    command = [sys.executable, "-c", KILLER, str(SUPPORT), str(tmp_path)]
    survived = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert survived > 30
    expected, interrupted = stable(tmp_path / str(survived)), 0
    for deadline in range(1, survived, 2):
        path = tmp_path / str(deadline)
        interrupted += stable(path) != expected
        train(path, DETERMINISTIC, until=3)
        assert stable(path) == expected, f"killed at write {deadline}"
    assert interrupted > 15


def test_killed_between_checkpoint_and_metrics(tmp_path, monkeypatch):
    train(tmp_path / "cut", until=2)
    before = (tmp_path / "cut" / "metrics.csv").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "_publish", lambda *_, **__: None)
        train(tmp_path / "cut", until=3)
        assert (tmp_path / "cut" / "metrics.csv").read_bytes() == before
    assert train(tmp_path / "cut", until=3) == []
    assert [row["iteration"] for row in read_metrics(tmp_path / "cut" / "metrics.csv")] == [1, 2, 3]
    assert load_policy(tmp_path / "cut").info.iteration == 3


def test_a_deterministic_run_leaves_clocks_empty(tmp_path):
    train(tmp_path, dataclasses.replace(CONFIG, deterministic=True), until=1)
    (row,) = read_metrics(tmp_path / "metrics.csv")
    assert (row["seconds_fit"], row["wall_seconds"]) == (None, None)
    assert row["real_steps"] == 100


HOLDER = """
import sys, time
from metrpo.config import Config
from metrpo.run.directory import RunDirectory
with RunDirectory(sys.argv[1], Config("Swimmer", iterations=5)):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_until_the_first_dies(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        before = contents(tmp_path)
        with pytest.raises(RunDirectoryError, match=f"in use by another process \\(pid {holder.pid}\\)"):
            RunDirectory(tmp_path, CONFIG)
        assert contents(tmp_path) == before
    finally:
        holder.kill()
        holder.communicate()
    RunDirectory(tmp_path, CONFIG).close()


def test_changed_settings_are_refused_with_the_difference(tmp_path):
    train(tmp_path, until=1)
    before = contents(tmp_path)
    other = dataclasses.replace(CONFIG, seed=3, trpo=TRPOConfig(max_kl=0.02))
    with pytest.raises(RunDirectoryError) as error:
        train(tmp_path, other)
    assert "seed         directory has 0, asked for 3" in str(error.value)
    assert "trpo.max_kl  directory has 0.01, asked for 0.02" in str(error.value)
    assert contents(tmp_path) == before
    train(tmp_path, until=2)  # the refused attempt let go of the lock


def test_a_run_that_died_before_its_first_episode_claims_nothing(tmp_path):
    other = dataclasses.replace(CONFIG, seed=CONFIG.seed + 1)
    with RunDirectory(tmp_path, CONFIG) as run:
        run.load(a_state())
    (tmp_path / "checkpoints").mkdir(exist_ok=True)
    (tmp_path / "checkpoints" / ".iteration-00001.tmp.npz").write_bytes(b"half")
    assert train(tmp_path, other, until=1) == [1]
    assert (tmp_path / "config.json").read_text() == to_json(other)
    with pytest.raises(RunDirectoryError, match=rf"--run-dir DIR\).*delete {tmp_path} first"):
        train(tmp_path, CONFIG)


def test_what_may_be_deleted_is_quoted_for_a_shell(tmp_path):
    """Pasted behind rm, a path with a space would name two others."""
    spaced = tmp_path / "a dir" / "run"
    train(spaced)
    with pytest.raises(RunDirectoryError, match=rf"delete '{spaced}' first"):
        train(spaced, dataclasses.replace(CONFIG, seed=CONFIG.seed + 1))


@pytest.mark.parametrize(
    "kept", ["best/policy.npz", "episodes/run-000000.npz", "checkpoints/iteration-00001.npz.damaged", "metrics.csv"]
)
def test_a_run_with_anything_to_lose_keeps_its_claim(tmp_path, kept):
    with RunDirectory(tmp_path, CONFIG) as run:
        run.load(a_state())
    (tmp_path / kept).parent.mkdir(exist_ok=True)
    (tmp_path / kept).write_text("")
    with pytest.raises(RunDirectoryError, match="other settings"):
        train(tmp_path, dataclasses.replace(CONFIG, seed=CONFIG.seed + 1))


class Heard(Progress):
    def __init__(self) -> None:
        self.heard: list[tuple] = []

    def resume(self, where: str, iteration: int, of: int | None, real_steps: int, waiting: int = 0) -> None:
        self.heard.append((where, iteration, of, real_steps))


@pytest.mark.parametrize(
    ("budget", "expected"), [({"iterations": 5}, 5), ({"real_steps": 5 * a_state(1).real_steps}, 5), ({}, 2)]
)
def test_training_says_where_a_run_is_taken_up(tmp_path, monkeypatch, budget, expected):
    monkeypatch.setattr(algorithm, "init", lambda *_: a_state())
    monkeypatch.setattr(algorithm, "step", lambda _, task, s, *rest: (a_state(s.iteration + 1), a_row(s.iteration + 1)))
    config = dataclasses.replace(CONFIG, iterations=2, real_steps=None)
    first, again = Heard(), Heard()
    training.train(config, tmp_path, first)
    training.train(dataclasses.replace(config, **budget), tmp_path, again)
    assert first.heard == [], "nothing to resume"
    assert again.heard == [(str(tmp_path), 3, expected, a_state(2).real_steps)]


def test_a_finished_run_rewrites_what_is_missing_or_damaged(tmp_path, monkeypatch):
    monkeypatch.setattr(derived_files, "draw_curve", lambda rows, path, *_: path.write_text(f"{len(rows)} rows"))
    train(tmp_path, until=2)

    def contents():
        files = (path for path in tmp_path.rglob("*") if path.is_file() and "events" not in path.parts)
        return {path: path.read_bytes() for path in files}

    before = contents()
    for name in ("curve.png", "policy.json", "metrics.csv"):
        (tmp_path / name).unlink()
    (tmp_path / "policy.npz").write_bytes(b"torn")
    train(tmp_path, until=2)
    assert contents() == before


@pytest.mark.parametrize(
    ("returns", "best"),
    [
        ([1.0, 3.0, 2.0], 2),
        ([1.0, 3.0, 3.0], 3),  # of equals the newest, which knows more
        ([math.nan, -2.0, math.nan], 2),
        ([None, -2.0, -1.0], 3),
        ([math.nan, math.nan], None),  # nobody can evaluate it
    ],
)
def test_the_policy_that_earned_most_stays(tmp_path, returns, best):
    """After `return-fell`, the report advises to use it."""
    with RunDirectory(tmp_path, CONFIG) as run:
        run.load(a_state())
        for i, value in enumerate(returns, 1):
            run.save(a_state(i), a_row(i) | {"return_real": value})
    with RunDirectory(tmp_path, CONFIG) as run:  # publishes the last one again
        run.load(a_state())
    assert load_policy(tmp_path).info.iteration == len(returns)
    if best is None:
        assert not (tmp_path / "best").exists()
        return
    kept = load_policy(tmp_path / "best")
    assert (kept.info.iteration, kept.info.return_real) == (best, returns[best - 1])
    np.testing.assert_array_equal(kept.layers[0][0], a_state(best).policy.layers[0][0])


def test_killed_before_the_best_policy_was_kept(tmp_path, monkeypatch):
    train(tmp_path, until=1)
    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "_publish", lambda *_, **__: None)
        train(tmp_path, until=2)
    with RunDirectory(tmp_path, CONFIG) as run:
        run.load(a_state())
        run.save(a_state(3), a_row(3) | {"return_real": -1.0})
    assert load_policy(tmp_path / "best").info.iteration == 2


def test_a_curve_from_before_the_checkpoint_is_drawn_anew(tmp_path, monkeypatch):
    """It could not be drawn then, though all else was written."""
    monkeypatch.setattr(derived_files, "draw_curve", lambda rows, path, *_: path.write_text(f"{len(rows)} rows"))
    train(tmp_path, until=1)
    with monkeypatch.context() as patch:
        patch.setattr(derived_files, "draw_curve", lambda *_: 1 / 0)
        train(tmp_path, until=2)
    assert (tmp_path / "curve.png").read_text() == "1 rows"
    train(tmp_path, until=2)
    assert (tmp_path / "curve.png").read_text() == "2 rows"


def test_the_time_left_does_not_count_the_compilation():
    assert training.seconds_left([60.0], 9) is None
    assert training.seconds_left([60.0, 2.0], 9) == 18
    assert training.seconds_left([60.0, 2.0, 3.0, 4.0, 50.0], 2) == 8, "the median of the last three"
    assert training.seconds_left([60.0], 0) == 0
    assert training.seconds_left([60.0, 2.0], None) is None


def test_the_budget_may_change(tmp_path):
    train(tmp_path, until=1)
    more = dataclasses.replace(CONFIG, iterations=9)
    assert train(tmp_path, more, until=3) == [2, 3]
    assert (tmp_path / "config.json").read_text() == to_json(more)


def test_edited_settings_do_not_pass_for_the_run(tmp_path):
    train(tmp_path, until=2)
    other = dataclasses.replace(CONFIG, seed=3)
    (tmp_path / "config.json").write_text(to_json(other))
    before = contents(tmp_path)
    with pytest.raises(RunDirectoryError, match="directory has 0, asked for 3"):
        train(tmp_path, other)
    assert contents(tmp_path) == before


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        (
            "run.json",
            lambda p: p.write_text(p.read_text().replace('"format": 1', '"format": 2')),
            "has format 2 .* reads format 1",
        ),
        ("run.json", lambda p: p.write_text("{"), "run.json is damaged"),
        ("run.json", lambda p: p.write_text("[1]"), "run.json is damaged"),
        ("run.json", lambda p: p.unlink(), "is no run directory: expected .* got best, checkpoints, config.json"),
        ("config.json", cut, "config.json is damaged"),
        ("config.json", lambda p: p.unlink(), "config.json is missing"),
        ("config.json", lambda p: p.write_bytes(b"\xff"), "config.json is damaged"),
        (
            "config.json",
            lambda p: p.write_text(p.read_text().replace('"members": 5', '"members": 0')),
            "ensemble.members",
        ),
        (
            "checkpoints",
            lambda p: [cut(f) for f in p.iterdir()],
            r"00002.npz is damaged.* and .*00001.npz is damaged.*Nothing was changed.*no earlier checkpoint",
        ),
        (
            "checkpoints",
            lambda p: [f.unlink() for f in p.iterdir()],
            "has lost its checkpoints: expected one of iteration 2, the last in metrics.csv",
        ),
    ],
)
def test_a_damaged_directory_is_refused_and_left_alone(tmp_path, name, damage, message):
    train(tmp_path, until=2)
    damage(tmp_path / name)
    before = contents(tmp_path)
    with pytest.raises(RunDirectoryError, match=message):
        train(tmp_path)
    assert contents(tmp_path) == before


def test_a_damaged_checkpoint_costs_its_iteration_only(tmp_path, caplog):
    train(tmp_path, until=3)
    newest = tmp_path / "checkpoints" / "iteration-00003.npz"
    cut(newest)
    damaged = newest.read_bytes()
    assert train(tmp_path, until=4) == [3, 4]
    assert "iteration-00003.npz is damaged" in caplog.text
    assert "resuming from iteration-00002.npz" in caplog.text
    assert newest.with_name("iteration-00003.npz.damaged").read_bytes() == damaged, "nothing is thrown away"
    assert [row["iteration"] for row in read_metrics(tmp_path / "metrics.csv")] == [1, 2, 3, 4]


def test_a_directory_with_other_things_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(RunDirectoryError, match=r"is no run directory: expected an empty one .* got thesis\.txt"):
        RunDirectory(tmp_path, CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("place", ["a file/run", "a file", "/proc/metrpo"])
def test_a_directory_that_cannot_be_written_is_refused(tmp_path, place):
    (tmp_path / "a file").write_text("")
    with pytest.raises(
        RunDirectoryError, match=r"cannot use .* as a run directory: .*; choose a writable one|is a file; --run-dir"
    ):
        RunDirectory(tmp_path / place, CONFIG)
    assert (tmp_path / "a file").read_text() == ""


def test_a_directory_without_permission_is_refused(tmp_path, monkeypatch):
    def denied(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", denied)
    with pytest.raises(RunDirectoryError, match=r"cannot write in .*: Permission denied"):
        RunDirectory(tmp_path, CONFIG)


def test_a_full_disk_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    train(tmp_path, until=2)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, RunDirectory(tmp_path, CONFIG) as run:
        run.load(a_state())
        patch.setattr(os, "fsync", full)
        with pytest.raises(RunDirectoryError, match=r"cannot write .*No space left"):
            run.save(a_state(3), a_row(3))
    assert train(tmp_path, until=3) == [3]


def test_a_broken_picture_costs_one_warning(tmp_path, monkeypatch, caplog):
    def broken(*_: Any) -> None:
        raise RuntimeError("no fonts")

    monkeypatch.setattr(derived_files, "draw_curve", broken)
    with caplog.at_level(logging.WARNING, "metrpo"):
        assert train(tmp_path, until=3) == [1, 2, 3]
    assert [r.getMessage() for r in caplog.records] == [
        "no learning curve any more (RuntimeError: no fonts); training continues"
    ]


def test_changed_columns_are_refused_before_anything_is_written(tmp_path):
    train(tmp_path, until=1)
    with RunDirectory(tmp_path, CONFIG) as run:
        run.load(a_state())
        before = contents(tmp_path)
        with pytest.raises(ValueError, match="expected the columns"):
            run.save(a_state(2), {"iteration": 2, "real_steps": 200})
        assert contents(tmp_path) == before
