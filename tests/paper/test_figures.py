"""The paper's figures: the tables of runs, what runs them, their numbers and pictures."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from metrpo.commands import parse
from metrpo.config import Config, to_json
from metrpo.errors import ConfigError
from metrpo.launch import dispatch as running
from metrpo.launch import local
from metrpo.launch.backend import Means
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import has_spent, standing
from metrpo.paper import pictures
from metrpo.paper.figures import FIGURES, PAPER_SECONDS, SCALES, run_of, runs_of
from metrpo.paper.pictures import draw
from metrpo.paper.publish import publish
from metrpo.paper.summary import curves_of, mean_curve, summarise
from metrpo.presets import preset
from metrpo.run import machine
from metrpo.run.metrics import read_metrics, to_csv
from metrpo.systems import SYSTEMS
from metrpo.world.registry import tasks

RUN = RunSpec("Swimmer", "k-1", 0, (("iterations", 3),), "fast")


def write(out, run, returns, steps=1000, imagined=None, seconds=60.0):
    """The metrics of a run with these returns, one iteration each."""
    rows = [
        {
            "iteration": i + 1,
            "real_steps": steps * (i + 1),
            "return_real": float(r),
            "return_imagined": float(r if imagined is None else imagined[i]),
            "wall_seconds": seconds * (i + 1),
        }
        for i, r in enumerate(returns)
    ]
    directory = Path(out) / run.name
    directory.mkdir(parents=True)
    (directory / "metrics.csv").write_text(to_csv(rows))
    (directory / "config.json").write_text(to_json(run.config))


def runs(system, seeds, task="Swimmer", iterations=3):
    return [RunSpec(task, system, seed, (("iterations", iterations),), "fast") for seed in range(seeds)]


# ---------------------------------------------------------------- the tables


OURS = {"actor-critic"}
"""Systems that the paper does not have."""


def test_every_system_is_in_a_figure_and_every_figure_has_some():
    named = {system for figure in FIGURES.values() for system in figure.systems.values()}
    assert named == set(SYSTEMS) - OURS
    for figure in FIGURES.values():
        assert set(figure.tasks) <= set(tasks())
        assert len(set(figure.systems.values())) == len(figure.systems)
    for scale in SCALES.values():
        assert set(scale.tasks) <= set(tasks())
        assert {s for row in scale.iterations.values() for s in row} <= set(SYSTEMS) | {"*"}
        assert set(scale.iterations) <= set(tasks()) | {"*"}
        assert set(scale.seeds) <= set(SYSTEMS) | {"*"}
    assert set(PAPER_SECONDS) == set(FIGURES["wall-clock"].tasks)


def test_smoke_runs_every_system_once():
    found = runs_of("all", "smoke")
    assert sorted(r.system for r in found) == sorted(set(SYSTEMS) - OURS)


def test_the_paper_scale_is_the_papers_settings():
    for run in runs_of("all", "paper"):
        assert run.config == preset(run.task, "paper", run.system, seed=run.seed)
    assert {r.task for r in runs_of("comparison", "paper")} == set(FIGURES["comparison"].tasks)


def test_figures_share_runs_and_the_first_seeds_come_first():
    found = runs_of("all", "laptop")
    assert len(found) == len(set(found))
    assert [r.seed for r in found] == sorted(r.seed for r in found)
    one = runs_of("ensemble-size", "laptop", ("Swimmer",), seeds=1)
    assert [r.name for r in one] == [f"Swimmer/{s}/seed-0" for s in ("me-trpo", "k-1", "k-10", "k-20")]
    assert set(one) <= set(found)


def test_a_scale_says_how_many_seeds_and_iterations_a_system_has():
    found = runs_of("all", "laptop")

    def seeds(task, system):
        return [r.seed for r in found if (r.task, r.system) == (task, system)]

    assert seeds("Hopper", "me-trpo") == [0, 1, 2, 3, 4]
    assert seeds("Hopper", "svg-1") == [0, 1]
    assert seeds("Hopper", "k-20") == [0, 1, 2]

    def iterations(task, system):
        return run_of("laptop", task, system, 0).config.iterations

    assert iterations("Hopper", "k-1") == 15  # any task, any system
    assert iterations("Snake", "k-1") == 10  # this task, any system
    assert iterations("Snake", "trpo") == 200  # any task, this system: not Snake's 10
    assert iterations("Swimmer", "trpo") == 60  # this task, this system
    assert iterations("HalfCheetah", "me-trpo") == 20
    assert len(runs_of("comparison", "laptop", ("Ant",), seeds=1)) == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sampling", "huge"), "scale: expected one of smoke, laptop, paper, got 'huge'"),
        (("speed", "smoke"), "figure: expected one of all, comparison, .*, got 'speed'"),
        (("sampling", "smoke", ("Hopper",)), "tasks: expected some of Ant, HalfCheetah, Swimmer, got Hopper"),
    ],
)
def test_what_is_unknown_is_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        runs_of(*arguments)


@pytest.mark.parametrize("scale", list(SCALES))
def test_the_command_of_a_run_is_its_config(scale, monkeypatch):
    """`metrpo train ...` with these arguments trains exactly this; every task once, and all settings."""
    monkeypatch.setattr(machine, "prepare", lambda *_: None)
    runs = runs_of("all", scale, seeds=1)
    settings = {(run.system, run.preset, run.overrides): run for run in runs}
    for run in {run.name: run for run in [*settings.values(), *{run.task: run for run in runs}.values()]}.values():
        parsed = parse.parse(["train", *run.arguments])
        assert Config(**{f.name: getattr(parsed, f.name) for f in dataclasses.fields(Config)}) == run.config


# ---------------------------------------------------------------- running them

TRAIN = """
import pathlib, sys, time
directory, iterations, code = pathlib.Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
time.sleep(float(sys.argv[4]))
lines = ["iteration,real_steps,return_real"] + [f"{i + 1},{10 * (i + 1)},1.5" for i in range(iterations)]
(directory / "metrics.csv").write_text("\\n".join(lines) + "\\n")
print("what went wrong")
sys.exit(code)
"""


@pytest.fixture
def trained(monkeypatch):
    """Stands in for `metrpo train`: {run: (iterations it gets to, exit code, seconds)}; and the runs begun."""
    outcomes, begun = {}, []

    def command(run, directory):
        begun.append(run)
        words = outcomes.get(run, (run.config.iterations, 0, 0))
        return [sys.executable, "-c", TRAIN, str(directory), *map(str, words)]

    monkeypatch.setattr(local, "_command", command)
    monkeypatch.setattr(local, "_POLL", 0.02)
    return outcomes, begun


def test_only_what_is_missing_is_run(tmp_path, trained):
    _, begun = trained
    told = []
    first, second, third = runs("k-1", 3)
    write(tmp_path, first, [1, 2, 3])
    write(tmp_path, second, [1, 2])
    assert running.dispatch([first, second, third], tmp_path, Means(jobs=2), told.append) == []
    assert begun == [second, third]
    assert told[:2] == ["1 of 3 runs are finished; 2 to go", "2 at a time on this machine"]
    assert sum("return 1.5" in line for line in told) == 2
    begun.clear()
    assert running.dispatch([first, second, third], tmp_path, Means(jobs=2), told.append) == []
    assert begun == []


def test_a_failed_run_stops_no_other_and_leaves_last_words(tmp_path, trained):
    outcomes, begun = trained
    all_runs = runs("k-1", 4)
    outcomes[all_runs[0]] = (1, 2, 0)
    outcomes[all_runs[1]] = (2, 0, 0)  # ends without an error, but short of its budget
    told = []
    assert set(running.dispatch(all_runs, tmp_path, Means(jobs=1), told.append)) == set(all_runs[:2])
    assert begun == all_runs
    text = "\n".join(told)
    assert "Swimmer/k-1/seed-0: FAILED" in text
    assert "exit code 2" in text
    assert "what went wrong" in text
    assert "[4/4] Swimmer/k-1/seed-3" in text


MEET = """
import pathlib, sys, time
mine, other = map(pathlib.Path, sys.argv[1:])
(mine / "began").touch()
for _ in range(1200):
    if (other / "began").exists():
        break
    time.sleep(0.05)
else:
    sys.exit("the other run did not begin while this one ran")
(mine / "metrics.csv").write_text("iteration,real_steps,return_real\\n3,30,1.5\\n")
"""


def test_as_many_at_a_time_as_jobs(tmp_path, monkeypatch):
    """Each of two runs waits for the other."""
    pair = runs("k-1", 2)
    there = {run: tmp_path / run.name for run in pair}

    def command(run, directory):
        return [sys.executable, "-c", MEET, str(there[run]), str(there[pair[run is pair[0]]])]

    monkeypatch.setattr(local, "_command", command)
    monkeypatch.setattr(local, "_POLL", 0.02)
    assert running.dispatch(pair, tmp_path, Means(jobs=2), lambda line: None) == []


def test_stopping_ends_the_runs_too(tmp_path, trained, monkeypatch):
    outcomes, begun = trained
    run = RUN
    outcomes[run] = (3, 0, 60)
    processes = []
    start = subprocess.Popen

    def remembered(*arguments, **options):
        processes.append(start(*arguments, **options))
        threading.Timer(0.3, signal.raise_signal, [signal.SIGINT]).start()
        return processes[-1]

    monkeypatch.setattr(local.subprocess, "Popen", remembered)
    # A shell that starts the tests in the background has Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            running.dispatch([run], tmp_path, Means(jobs=1), lambda line: None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert processes[0].poll() == -signal.SIGTERM
    assert begun == [run]


def test_cores_are_shared_without_overlap(monkeypatch):
    monkeypatch.setattr(local.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert local.shares_of_cores(2) == [(0, 1, 2, 3), (4, 5, 6, 7)]
    assert local.shares_of_cores(8) == [(n,) for n in range(8)]
    assert local.shares_of_cores(10)[8:] == [(0,), (1,)]
    assert local.shares_of_cores(2, 3) == [(0, 1, 2), (3, 4, 5)]
    assert local.shares_of_cores(1, 9) == [tuple(range(8))]


def test_more_cores_for_each_are_fewer_runs_at_a_time(tmp_path, trained, monkeypatch):
    monkeypatch.setattr(local.machine, "cores", lambda: 8)
    for means, jobs in ((Means(), 8), (Means(cpus=3), 2), (Means(cpus=9), 1), (Means(cpus=3, jobs=5), 5)):
        told = []
        assert local.run_locally([], tmp_path, means, told.append) == []
        assert told == [f"{jobs} at a time on this machine"]


def test_other_settings_on_disk_are_found(tmp_path):
    write(tmp_path, RUN, [1, 2, 3])
    assert running.differences(RUN, tmp_path) == {}
    other = dataclasses.replace(RUN, overrides=(("iterations", 3), ("trpo.max_kl", 0.5)))
    assert running.differences(other, tmp_path) == {"trpo.max_kl": (RUN.config.trpo.max_kl, 0.5)}


# ---------------------------------------------------------------- numbers and pictures


def test_numbers_of_a_figure_by_hand(tmp_path):
    ours, one = runs("me-trpo", 2, iterations=4), runs("k-1", 2, iterations=2)
    write(tmp_path, ours[0], [0, 10, 20, 20])
    write(tmp_path, ours[1], [0, 20, 20, 20])
    write(tmp_path, one[0], [0, 4])
    write(tmp_path, one[1], [20, 20])
    first, second = summarise("ensemble-size", [*ours, *one], tmp_path)
    assert (first["system"], second["system"]) == ("5 models", "1 model")
    assert first["last"] == [20, 20]
    assert second["real_steps"] == second["common_steps"] == first["common_steps"] == 2000
    assert first["real_steps"] == 4000
    assert first["at_common"] == [10, 20]
    assert second["at_common"] == [4, 20]
    assert first["at_common_iqm"] == [15, 10, 20]
    np.testing.assert_allclose(first["average"], [5, 10])
    np.testing.assert_allclose(second["average"], [2, 20])
    # 10 > 4, 20 > 4, 20 = 20 (half), 10 < 20; averages: both > 2, both < 20.
    assert second["first_better"] == [2.5 / 4, 0.5]
    assert first["first_better"] == [0.5, 0.5]
    assert first["level"] == 19
    assert first["steps"] == pytest.approx(2800), "the mean goes from 15 at 2,000 to 20 at 3,000"
    assert np.isnan(second["steps"]), "the mean ends at 12"
    assert first["ratio"] == 1


def test_nothing_is_compared_without_the_first_system(tmp_path):
    (run,) = runs("k-1", 1)
    write(tmp_path, run, [1, 2, 3])
    (record,) = summarise("ensemble-size", [run], tmp_path)
    assert "first_better" not in record
    assert record["last"] == [3]


def test_progress_counts_to_the_budget_that_is_given():
    row = {"iteration": 3, "real_steps": 9000, "return_real": 1.25}
    (run, *_) = runs("k-1", 1)
    steps = dataclasses.replace(run, overrides=(("real_steps", 60_000),))
    assert standing(steps, [row]) == "iteration 3, 9,000 of 60,000 real steps, return 1.2"
    few = dataclasses.replace(run, overrides=(("iterations", 7),))
    assert standing(few, [row]) == "iteration 3/7, 9,000 real steps, return 1.2"
    robots = row | {"return_real": None, "return_collected": 4.0}
    assert standing(few, [robots]).endswith("collected 4.0")
    assert [has_spent(steps, [row | {"real_steps": n}]) for n in (59_999, 60_000)] == [False, True]
    logged = dataclasses.replace(run, overrides=(("real_steps", 0), ("iterations", 4), ("data", "a.npz")))
    assert [has_spent(logged, [row | {"iteration": n}]) for n in (1, 4)] == [False, True], "learns from a log"


def test_the_mean_curve_is_over_what_all_seeds_have_measured(tmp_path):
    a, b, c = runs("k-1", 3)
    write(tmp_path, a, [0, 1, 2])
    write(tmp_path, b, [2, 3, 4])
    write(tmp_path, c, [4, 5])
    (curves,) = curves_of("ensemble-size", [a, b, c], tmp_path)
    for log in (False, True):
        steps, mean, low, high = mean_curve(curves, "return_real", log)
        assert (steps[0], steps[-1]) == pytest.approx((1000, 2000))
        # Straight as it is drawn: on a logarithmic axis a doubling is the whole way from 2 to 3.
        line = 2 + np.log2(steps / 1000) if log else 1 + steps / 1000
        np.testing.assert_allclose(mean, line, atol=1e-6)
        assert np.all(low < mean)
        assert np.all(mean < high)
        assert np.all(high <= 4 + steps)


@pytest.mark.parametrize("name", list(FIGURES))
def test_every_figure_is_drawn_from_what_there_is(tmp_path, name):
    everything = [r for r in runs_of(name, "laptop") if r.system != "svg-1"]
    assert not draw(name, everything, tmp_path, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
    for i, run in enumerate(everything[1:]):
        write(tmp_path, run, np.arange(3 + i % 4), imagined=np.arange(3 + i % 4) * 5)
    assert draw(name, everything, tmp_path, tmp_path / "some.png")
    assert (tmp_path / "some.png").read_bytes().startswith(b"\x89PNG")


def test_what_the_first_models_promise_flattens_no_panel(tmp_path, monkeypatch):
    """A row for each task, a column for each system; what lies outside is said in words."""
    drawn = []
    monkeypatch.setattr(pictures, "png_of", lambda picture: drawn.append(picture) or b"")
    two = runs("k-1", 2)
    write(tmp_path, two[0], [0, 50, 100], imagined=[3000, 120, 110])
    write(tmp_path, two[1], [10, 60, 90], imagined=[70, 100, 100])
    (other,) = runs("me-trpo", 1, task="Ant")
    write(tmp_path, other, [0, 50, 100], imagined=[30, 120, 110])
    draw("overfitting", [*two, other], tmp_path, tmp_path / "o.png")
    axes = {a.get_title(): a for a in drawn[0].axes if a.get_title()}
    assert list(axes) == ["Swimmer, 1 model", "Ant, 5 models"]
    assert axes["Swimmer, 1 model"].get_ylim() == (-6, 126)
    assert [t.get_text() for t in axes["Swimmer, 1 model"].texts] == ["outside, after the first phase: 3,000"]
    assert not axes["Ant, 5 models"].texts


def test_publishing_names_what_is_missing_and_shows_every_seed(tmp_path):
    a, b, c = runs("me-trpo", 3)
    write(tmp_path, a, [0, 1, 2])
    write(tmp_path, c, [0, 3])
    other = dataclasses.replace(a, overrides=(*a.overrides, ("trpo.max_kl", 0.5)))
    told = []
    write(tmp_path, RunSpec("Ant", "me-trpo", 0, (), "fast"), [7])
    numbers = publish(["ensemble-size", "sampling"], "laptop", (), [other, b], tmp_path, told.append)
    assert numbers["ensemble-size"][0]["last"] == [2, 3], "seed 2 was not asked for, but is there"
    assert numbers["ensemble-size"][1]["task"] == "Ant", "nor was this task"
    assert json.loads((tmp_path / "figures" / "ensemble-size.json").read_text())[0]["seeds"] == 2
    only = publish(["ensemble-size"], "laptop", ("Ant",), [], tmp_path, lambda line: None)
    assert [record["task"] for record in only["ensemble-size"]] == ["Ant"]
    table = (tmp_path / "figures" / "sampling.md").read_text()
    assert "| Swimmer | step_rand | 2,000 | 2.5 (2.0, 3.0) |" in table
    text = "\n".join(told)
    assert "not begun: Swimmer/me-trpo/seed-1\n" in text
    assert "Swimmer/me-trpo/seed-2: not finished, 2,000 real steps so far" in text
    was = a.config.trpo.max_kl
    assert f"made with other settings: Swimmer/me-trpo/seed-0: trpo.max_kl {was} (today 0.5)" in text


def test_runs_that_miss_the_same_are_told_of_together(tmp_path):
    there, told = runs("k-1", 3), []
    for run in there:
        write(tmp_path, run, [1, 2, 3])
    asked = [dataclasses.replace(run, overrides=(*run.overrides, ("trpo.max_kl", 0.5))) for run in there]
    publish(["optimizers"], "laptop", (), [*asked, *runs("bptt", 9)], tmp_path, told.append)
    name, now = "Swimmer/k-1/seed-", f"trpo.max_kl {there[0].config.trpo.max_kl} (today 0.5)"
    assert f"made with other settings: {name}0, {name}1, {name}2: {now}" in told
    assert "not begun: Swimmer/bptt/seed-0, Swimmer/bptt/seed-1, Swimmer/bptt/seed-2, 6 more" in told


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_smoke_runs_every_system_and_draws_every_figure(tmp_path):
    """The command itself; without Stable-Baselines3 its two systems fail, and nothing else does."""
    done = subprocess.run(
        [sys.executable, "-m", "metrpo", "reproduce", "all", "--scale", "smoke", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
    )
    failed = {line.split(":")[0].split("] ")[1] for line in done.stdout.splitlines() if "FAILED" in line}
    try:
        import stable_baselines3  # noqa: F401
    except ImportError:
        assert failed == {"Swimmer/ppo/seed-0", "Swimmer/ddpg/seed-0"}, done.stdout
    else:
        assert not failed, done.stdout
        assert done.returncode == 0
    for run in runs_of("all", "smoke"):
        if run.name not in failed:
            assert read_metrics(tmp_path / run.name / "metrics.csv")[-1]["iteration"] == 2
    assert {p.stem for p in (tmp_path / "figures").glob("*.png")} == set(FIGURES)
