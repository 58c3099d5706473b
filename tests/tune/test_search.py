"""Searches: what is typed and refused, a known optimum, steps saved by pruning, and what kills and failures cost."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from metrpo.commands import main, parse
from metrpo.commands.tune import Tune, search_of
from metrpo.config import to_json
from metrpo.console.interrupt import Stopped
from metrpo.errors import ConfigError, MetrpoError, RunDirectoryError, TaskError
from metrpo.launch import processes
from metrpo.run.lock import hold
from metrpo.run.metrics import read_metrics, to_csv
from metrpo.tune import trials as tuning
from metrpo.tune.picture import draw
from metrpo.tune.results import ENOUGH, describe
from metrpo.tune.search import Search, from_file, worth
from metrpo.tune.space import Choices, Range, span_of
from metrpo.tune.study import FILE
from metrpo.tune.trials import tune
from places import ROOT, SUPPORT
from tiny_run import SMALL

SPACE = {"trpo.max_kl": Range(0.001, 1.0, log=True), "ensemble.members": Choices((1, 3, 5))}
STEPS = 6
STRIDE = 13
"""Lines of the journal from one kill to the next; each costs a search. With 1 the test takes minutes."""


def search(trials=8, **other):
    return Search("Swimmer", **{"space": SPACE, "iterations": STEPS, "trials": trials, "seeds": (0,)} | other)


def most(run):
    """What a run can earn: 10 at max_kl = 0.1 with 3 members, less elsewhere; seed 1 earns one more than seed 0."""
    c = run.config
    return 10 - 2 * abs(math.log10(c.trpo.max_kl) + 1) - 3 * (c.ensemble.members != 3) + c.seed


class Killed(BaseException):
    """The process is gone: nothing of it runs any more."""


class Fake:
    """Runs in this process: each look at one is an iteration, in which its return rises to what it can earn."""

    def __init__(self, fails=(), interrupted_at=None):
        self.fails, self.interrupted_at = fails, interrupted_at
        self.looks, self.begun, self.iterations, self.terminated = 0, [], [], []

    def __call__(self, run, out, cores):
        self.begun.append(run)
        return FakeWorker(self, run, out)


class FakeWorker:
    def __init__(self, fake, run, out):
        self.fake, self.run, self.directory, self.code = fake, run, out / run.name, None
        self.directory.mkdir(parents=True, exist_ok=True)
        (self.directory / "config.json").write_text(to_json(run.config))
        self.rows = tuning.rows_of(run, out)

    def poll(self):
        if self.code is not None:
            return self.code
        self.fake.looks += 1
        if self.fake.looks == self.fake.interrupted_at:
            raise KeyboardInterrupt
        if self.run.name.removeprefix("Swimmer/") in self.fake.fails:
            Path(f"{self.directory}.log").write_text("many words\nthe last words\n")
            self.code = 2
            return self.code
        n = len(self.rows) + 1
        self.fake.iterations.append((self.run.name, n))
        self.rows.append({"iteration": n, "real_steps": 100 * n, "return_real": most(self.run) * n / STEPS})
        (self.directory / "metrics.csv").write_text(to_csv(self.rows))
        self.code = 0 if n == STEPS else None
        return self.code

    def terminate(self):
        if self.code is None:
            self.fake.terminated.append(self.run.name)
            self.code = 143

    def wait(self):
        return self.code


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(tuning, "_POLL", 0.0)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # of every line of the journal


def silent(line):
    pass


# ---------------------------------------------------------------- what is searched


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("trpo.max_kl=log 0.003..0.1", Range(0.003, 0.1, log=True)),
        ("trpo.max_kl = 1e-3 .. 1", Range(0.001, 1.0)),
        ("trpo.max_kl=0.25..1 step 0.25", Range(0.25, 1.0, step=0.25)),
        ("validate.patience=10..50", Range(10, 50)),
        ("validate.patience=log 1..64", Range(1, 64, log=True)),
        ("imagine.horizon=10..50 step 20", Range(10, 50, step=20)),
        ("ensemble.members=1,3,5", Choices((1, 3, 5))),
        ("trpo.max_kl=1,0.5", Choices((1.0, 0.5))),
        ("ensemble.hidden=[64],[200,200]", Choices(((64,), (200, 200)))),
        ("imagine.horizon=None,50", Choices((None, 50))),
        ("imagine.sampling=step_rand,model_mean", Choices(("step_rand", "model_mean"))),
    ],
)
def test_ranges_and_choices_are_read_and_said_again(text, found):
    name, read = span_of(text)
    assert read == found
    assert [type(v) for v in read.outermost] == [type(v) for v in found.outermost]
    assert span_of(f"{name}={read}".replace("null", "None")) == (name, found)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trpo.max_kl", "search: expected NAME=A..B, log A..B, .* got 'trpo.max_kl'"),
        ("trpo.max_lk=0.1..1", "unknown setting 'trpo.max_lk'"),
        ("trpo=0.1..1", "expected choices, because it is no number"),
        ("trpo.max_kl.x=0.1..1", "unknown setting"),
        ("trpo.max_kl=0.1..", "expected A..B"),
        ("trpo.max_kl=1...5", "expected A..B"),
        ("trpo.max_kl=1..2..3", "expected A..B"),
        ("trpo.max_kl=ln 1..2", "expected A..B"),
        ("trpo.max_kl=1..0.1", "the lower one first"),
        ("trpo.max_kl=0.1..1e999", "two finite numbers"),
        ("trpo.max_kl=log 0..1", "expected log of numbers above 0"),
        ("trpo.max_kl=log 1..3 step 1", "expected log of numbers above 0 and without a step"),
        ("validate.patience=1.5..5", "expected whole numbers"),
        ("validate.patience=10..50 step 15", "expected a whole number of steps from 10 to 50"),
        ("imagine.sampling=1..5", "expected choices, because it is no number"),
        ("ensemble.members=5", "expected at least two choices"),
        ("ensemble.members=5,5", "each once"),
        ("trpo.max_kl=1,1.0", "each once"),
    ],
)
def test_a_wrong_range_is_named(text, message):
    with pytest.raises(ConfigError, match=message):
        span_of(text)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"space": {"trpo.max_kl": Range(-1.0, 1.0)}}, "trpo.max_kl: expected a finite number > 0, got -1.0"),
        ({"space": {"validate.threshold": Range(0.5, 1.5)}}, "validate.threshold: expected between 0 and 1, got 1.5"),
        ({"space": {"ensemble.members": Choices((1, 0, 5))}}, "ensemble.members: expected at least 1, got 0"),
        ({"space": {"ensemble.members": Choices((1, "many"))}}, "ensemble.members: expected int, got 'many'"),
        ({"space": {"imagine.sampling": Choices(("step_rand", "x"))}}, "imagine.sampling: expected one of"),
        ({"settings": {"trpo.damping": -1.0}}, "trpo.damping: expected a finite number >= 0"),
        ({"settings": {"trpo.max_kl": 0.1}}, "got trpo.max_kl, which is both fixed and searched"),
        ({"space": {"seed": Range(0, 5)}}, "got seed, which has an option"),
        ({"space": {}}, "expected at least one setting"),
        ({"seeds": ()}, "one seed"),
        ({"real_steps": 1000}, "expected iterations or real_steps, got both"),
        ({"iterations": 0}, "iterations: expected at least 1"),
        ({"trials": 0}, "trials: expected a whole number of at least 1"),
        ({"pruner": "mean"}, "pruner: expected one of median, halving, none, got 'mean'"),
        ({"space": {"collect.steps": Range(1000, 3000)}}, "add --pruner none"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is(other, message):
    with pytest.raises(ConfigError, match=message):
        search(**other)
    with pytest.raises(TaskError, match="unknown task 'Swimer'"):
        Search("Swimer", SPACE)


def test_a_file_says_the_same_as_options(tmp_path):
    file = tmp_path / "search.toml"
    file.write_text(
        'task = "Swimmer"\ntrials = 30\nseeds = [0, 2]\nreal_steps = 6000\npruner = "halving"\n'
        '[search]\ntrpo.max_kl = "log 0.003..0.1"\nensemble.hidden = [[8], [16, 16]]\n[set]\nimagine.steps = 500\n'
    )
    typed = ["tune", "--search", "trpo.max_kl=log 0.003..0.1", "--search", "ensemble.hidden=[8],[16,16]"]
    typed += ["--set", "imagine.steps=500", "--trials", "30", "--seeds", "0,2", "--real-steps", "6000"]
    found = from_file(file)
    assert found == search_of(parse.parse([*typed, "--pruner", "halving"]))
    assert found.steps == 4, "1,500 real steps in an iteration"
    (one, two) = found.runs(7, {"trpo.max_kl": 0.01, "ensemble.hidden": (16, 16)})
    assert (one.name, two.name) == ("Swimmer/trial-007/seed-0", "Swimmer/trial-007/seed-2")
    assert (two.config.real_steps, two.config.imagine.steps, two.config.ensemble.hidden) == (6000, 500, (16, 16))


def test_a_long_task_has_as_few_iterations_as_whole_episodes(tmp_path):
    """Pruning begins after a third of a run: counted in iterations of 250 steps, that would be after its end."""
    found = Search("HalfCheetah-v5", {"fit.max_steps": Choices((400, 800))})
    assert (found.base.real_steps, found.steps) == (50_000, 50)
    assert "50,000 real steps each" in describe(found, tmp_path)
    assert dataclasses.replace(found, iterations=7).steps == 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task = [", "expected a TOML file"),
        ('task = "Swimmer"\ntrails = 3', "got trails"),
        ("search.trpo.max_kl = [1, 2]", 'expected a task such as "Swimmer"'),
        ('task = "Swimmer"\nsearch = 3', "tables"),
        ('task = "Swimmer"\nsearch.trpo.max_kl = 3', "search: trpo.max_kl: expected A..B"),
        ('task = "Swimmer"\nseeds = "x"\nsearch.trpo.max_kl = [1, 2]', "seeds: expected"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    file = tmp_path / "search.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        from_file(file)


def test_an_option_beside_a_file_that_holds_it_is_refused():
    default = next(f.default for f in dataclasses.fields(Tune) if f.name == "trials")
    for count in ("3", str(default)):
        with pytest.raises(ConfigError, match=r"trials: expected it in search\.toml alone"):
            parse.parse(["tune", "search.toml", "--trials", count])
    assert parse.parse(["tune", "search.toml", "--jobs", "2"]).jobs == 2


def test_the_objective_by_hand():
    """The mean of the last three of each seed, then over the seeds."""
    seeds = [[{"return_real": float(r)} for r in returns] for returns in ([100, 1, 2, 3], [0, 4, 5, 9])]
    assert worth(seeds) == [2, 6]
    assert worth(seeds, 2) == [50.5, 2]
    assert math.isnan(worth([[{"return_real": None}]])[0])


# ---------------------------------------------------------------- trials


def test_the_optimum_is_found_and_the_preset_is_the_first_trial(tmp_path):
    found = tune(search(20), tmp_path, 1, silent, Fake())
    assert [r.number for r in found.records] == list(range(20))
    assert [r.usual for r in found.records] == [True] + [False] * 19
    assert found.records[0].settings == {"trpo.max_kl": 0.01, "ensemble.members": 5}
    assert found.best.settings["ensemble.members"] == 3
    assert 0.05 < found.best.settings["trpo.max_kl"] < 0.2
    run = found.search.runs(found.best.number, found.best.settings)[0]
    assert found.best.value == pytest.approx(most(run) * 5 / STEPS), "the last three returns are 4, 5 and 6 sixths"
    near = [r.settings["ensemble.members"] == 3 and 0.03 < r.settings["trpo.max_kl"] < 0.3 for r in found.records]
    assert sum(near[6:]) >= 4, "drawn at random, one in nine lies there"
    complete = sum(r.state == "complete" for r in found.records)
    assert (found.importance == {}) == (complete < ENOUGH), f"{complete} are complete"
    whole = tune(search(20, pruner="none"), tmp_path / "whole", 1, silent, Fake())
    assert set(whole.importance) == set(SPACE)
    assert sum(whole.importance.values()) == pytest.approx(1)


def test_pruning_saves_steps_and_costs_no_data(tmp_path):
    fake, all_of_it = Fake(), Fake()
    found = tune(search(12), tmp_path / "pruned", 1, silent, fake)
    whole = tune(search(12, pruner="none"), tmp_path / "whole", 1, silent, all_of_it)
    assert {r.state for r in whole.records} == {"complete"}
    assert len(all_of_it.iterations) == 12 * STEPS
    pruned = [r for r in found.records if r.state == "pruned"]
    assert len(pruned) >= 3
    assert all(r.number >= 4 for r in pruned), "the first four are what others are held against"
    assert len(fake.iterations) == 12 * STEPS - sum(STEPS - r.iterations for r in pruned) < 12 * STEPS - 10
    for r in pruned:
        (run,) = found.search.runs(r.number, r.settings)
        assert run.name in fake.terminated
        rows = read_metrics(tmp_path / "pruned" / run.name / "metrics.csv")
        assert STEPS > len(rows) == r.iterations >= STEPS / 3
        assert r.real_steps == 100 * len(rows)
        assert r.value == pytest.approx(sum(row["return_real"] for row in rows[-3:]) / len(rows[-3:]))
        earlier = [e for e in found.records[: r.number] if e.state == "complete"]
        assert most(run) < max(most(found.search.runs(e.number, e.settings)[0]) for e in earlier)


def test_halving_prunes_too(tmp_path):
    found = tune(search(12, pruner="halving"), tmp_path, 1, silent, Fake())
    assert {r.state for r in found.records} == {"complete", "pruned"}


def test_a_trial_is_worth_the_mean_of_its_parallel_seeds(tmp_path):
    fake = Fake()
    found = tune(search(2, seeds=(0, 1)), tmp_path, 1, silent, fake)
    first = found.records[0]
    low, high = first.returns
    assert high - low == pytest.approx(5 / STEPS)
    assert first.value == pytest.approx((low + high) / 2)
    assert first.real_steps == 2 * 100 * STEPS
    assert [run.seed for run in fake.begun] == [0, 1, 0, 1]
    assert [name for name, _ in fake.iterations[:2]] == ["Swimmer/trial-000/seed-0", "Swimmer/trial-000/seed-1"]


def test_as_many_trials_at_a_time_as_jobs(tmp_path):
    fake = Fake()
    found = tune(search(6, pruner="none"), tmp_path, 3, silent, fake)
    assert [r.number for r in found.records] == list(range(6))
    assert [name[8:17] for name, _ in fake.iterations[:3]] == ["trial-000", "trial-001", "trial-002"]


def outcome(found):
    return [(r.number, r.state, r.value, r.settings, r.returns, r.real_steps) for r in found.records]


class Journal:
    """Dies in the middle of writing one line, as a process may; what is under way is gone without a word."""

    def __init__(self, patch, at):
        from optuna.storages.journal import JournalFileBackend

        self.lines, append = 0, JournalFileBackend.append_logs

        def append_logs(backend, logs):
            self.lines += 1
            if self.lines == at:
                with open(backend._file_path, "ab") as file:
                    file.write(json.dumps(logs[0]).encode()[:40])
                raise Killed
            append(backend, logs)

        patch.setattr(JournalFileBackend, "append_logs", append_logs)
        patch.setattr(tuning._Tuning, "_stop_all", lambda self: None)


def test_killed_in_any_journal_line_the_same_trials_come_out(tmp_path, monkeypatch):
    whole = Fake()
    with monkeypatch.context() as patch:
        journal = Journal(patch, None)
        expected = outcome(tune(search(), tmp_path / "whole", 1, silent, whole))
    assert {state for _, state, *_ in expected} == {"complete", "pruned"}
    for line in range(1, journal.lines + 1, STRIDE):
        out, fake = tmp_path / str(line), Fake()
        with monkeypatch.context() as patch:
            Journal(patch, line)
            with pytest.raises(Killed):
                tune(search(), out, 1, silent, fake)
        assert outcome(tune(search(), out, 1, silent, fake)) == expected, f"killed in line {line} of {journal.lines}"
        assert fake.iterations == whole.iterations, "no iteration is lost, and none made twice"


def test_finished_trials_are_kept_and_more_may_be_asked_for(tmp_path):
    fake = Fake()
    first = outcome(tune(search(3), tmp_path, 1, silent, fake))
    begun = len(fake.begun)
    assert outcome(tune(search(3), tmp_path, 1, silent, fake)) == first
    assert len(fake.begun) == begun
    assert outcome(tune(search(5), tmp_path, 1, silent, fake))[:3] == first
    assert len(fake.begun) == begun + 2


def test_ctrl_c_stops_the_runs_and_the_same_command_goes_on(tmp_path):
    expected = outcome(tune(search(), tmp_path / "whole", 1, silent, Fake()))
    fake, told = Fake(interrupted_at=9), []
    with pytest.raises(KeyboardInterrupt):
        tune(search(), tmp_path / "broken", 1, told.append, fake)
    assert fake.terminated == ["Swimmer/trial-001/seed-0"]
    assert told[-1] == "stopping 1 trial at the end of an iteration; press again to stop at once"
    told.clear()
    assert outcome(tune(search(), tmp_path / "broken", 1, told.append, fake)) == expected
    assert told[0] == "1 of 8 trials are finished, 1 interrupted"


def test_a_trial_that_fails_stops_its_seeds_and_no_other_trial(tmp_path):
    fake, told = Fake(fails=("trial-001/seed-0",)), []
    found = tune(search(4, seeds=(0, 1)), tmp_path, 1, told.append, fake)
    assert [r.state for r in found.records] == ["complete", "failed", "complete", "complete"]
    assert fake.terminated == ["Swimmer/trial-001/seed-1"]
    assert found.failed[0].failure.endswith("the last words")
    assert "exit code 2" in found.failed[0].failure
    assert any("trial 1: FAILED" in line and "the last words" in line for line in told)
    assert found.best.state == "complete"


def test_when_all_fail_it_gives_up(tmp_path):
    fake = Fake(fails=[f"trial-{n:03d}/seed-0" for n in range(8)])
    with pytest.raises(MetrpoError, match="3 trials have failed and none succeeded"):
        tune(search(), tmp_path, 1, silent, fake)
    assert len(fake.begun) == 3


# ---------------------------------------------------------------- what lies there


def test_another_search_is_refused_with_what_differs(tmp_path):
    tune(search(1), tmp_path, 1, silent, Fake())
    before = (tmp_path / FILE).read_bytes()
    for other, message in (
        ({"space": SPACE | {"ensemble.members": Choices((1, 3))}}, "'ensemble.members': '1,3,5'.*now .*'1,3'"),
        ({"iterations": 7}, r"iterations 6 \(now 7\)"),
        ({"seeds": (0, 1)}, r"seeds \[0\] \(now \[0, 1\]\)"),
        ({"settings": {"imagine.steps": 500}}, r"settings \{\} \(now \{'imagine.steps': 500\}\)"),
    ):
        with pytest.raises(RunDirectoryError, match=f"holds another search: .*{message}.*choose another --out"):
            tune(search(1, **other), tmp_path, 1, silent, Fake())
    assert (tmp_path / FILE).read_bytes() == before


def test_only_one_process_searches(tmp_path):
    with hold(tmp_path), pytest.raises(RunDirectoryError, match="in use by another process"):
        tune(search(1), tmp_path, 1, silent, Fake())


@pytest.mark.parametrize(
    "line",
    [
        b"no json",
        b"[1]",
        b'{"op_code": 99, "worker_id": "x"}',
        b'{"op_code": 4, "worker_id": "x", "study_id": 0, "datetime_start": null, "state": 4, "value": null, '
        b'"values": null, "distributions": {"y": "__import__(\'os\').abort()"}, "params": {"y": 1}, "user_attrs": {}, '
        b'"system_attrs": {}, "intermediate_values": {}}',
        b'{"op_code": 0, "op_code": 0}',
        b"\x80\x04\x95 a pickle",
    ],
)
def test_a_damaged_or_hostile_journal_is_refused(tmp_path, line):
    tune(search(1), tmp_path, 1, silent, Fake())
    with open(tmp_path / FILE, "ab") as file:
        file.write(line + b"\n")
    with pytest.raises(RunDirectoryError, match=r"study\.jsonl is damaged"):
        tune(search(2), tmp_path, 1, silent, Fake())


def test_without_optuna_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MetrpoError, match=r"pip install 'metrpo\[tune\]'"):
        tune(search(1), tmp_path, 1, silent, Fake())


# ---------------------------------------------------------------- the command


def command(out, *more):
    words = ["tune", "--search", "trpo.max_kl=log 0.001..1", "--search", "ensemble.members=1,3,5", "--seeds", "0"]
    return [*words, "--iterations", str(STEPS), "--trials", "6", "--jobs", "1", "--out", str(out), *more]


@pytest.fixture
def faked(monkeypatch):
    """The command with runs in this process."""
    fake = Fake()
    monkeypatch.setattr(tuning, "tune", lambda search, out, jobs, tell: tune(search, out, jobs, tell, fake))
    before = signal.getsignal(signal.SIGTERM)
    yield fake
    signal.signal(signal.SIGTERM, before)


def test_tune_ends_with_a_table_a_picture_and_the_best_command(tmp_path, faked, capsys, monkeypatch):
    assert main.main(command(tmp_path)) == 0
    said = capsys.readouterr().out
    assert "6 trials: " in said
    assert "the preset's own" in said
    best = next(line.strip() for line in said.splitlines() if line.startswith("  metrpo train"))
    assert (tmp_path / "tune.png").read_bytes().startswith(b"\x89PNG")
    faked.begun.clear()
    assert main.main(command(tmp_path, "--json")) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert (record["best"]["command"], len(record["trials"]), faked.begun) == (best, 6, [])
    assert "6 of 6 trials are finished" in err
    monkeypatch.setattr("metrpo.run.machine.prepare", lambda *_, **__: None)
    typed = parse.parse(shlex.split(best)[1:])
    chosen = record["trials"][record["best"]["number"]]["settings"]
    assert (typed.trpo.max_kl, typed.ensemble.members) == (chosen["trpo.max_kl"], chosen["ensemble.members"])


def test_a_dry_run_writes_nothing(tmp_path, faked, capsys):
    assert main.main(command(tmp_path / "none", "--dry-run")) == 0
    said = capsys.readouterr().out
    assert "trpo.max_kl = log 0.001..1.0 (the preset has 0.01)" in said
    assert "metrpo train Swimmer --system me-trpo" in said
    assert not (tmp_path / "none").exists()
    assert faked.begun == []


def test_failures_are_in_the_exit_code(tmp_path, faked, capsys):
    faked.fails = ("trial-002/seed-0",)
    assert main.main(command(tmp_path)) == 1
    assert "1 of 6 trials failed" in capsys.readouterr().err


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (Stopped(signal.SIGTERM), 143)])
def test_a_signal_is_in_the_exit_code(tmp_path, faked, monkeypatch, capsys, error, code):
    def stopped(*_):
        raise error

    monkeypatch.setattr(tuning, "tune", stopped)
    assert main.main(command(tmp_path)) == code
    assert "The same command resumes" in capsys.readouterr().err


def test_every_kind_of_setting_is_drawn_and_shown(tmp_path, capsys):
    space = {
        "ensemble.hidden": Choices(((8,), (16, 16))),
        "imagine.horizon": Choices((None, 50)),
        "validate.patience": Range(10, 50, step=20),
        "validate.threshold": Range(0.5, 1.0),
    }
    found = tune(search(6, space=space), tmp_path, 1, silent, Fake(fails=("trial-003/seed-0",)))
    assert found.records[0].settings["ensemble.hidden"] in ((8,), (16, 16))
    assert {r.settings["validate.patience"] for r in found.records} <= {10, 30, 50}
    assert {r.settings["imagine.horizon"] for r in found.records} <= {None, 50}
    assert draw(found, tmp_path / "some.png")
    assert not draw(type(found)(found.search, [], {}), tmp_path / "none.png")
    found.print(Console(width=200))
    assert "16x16" in capsys.readouterr().out
    json.dumps(found.record())


# ---------------------------------------------------------------- real processes

HOLDS = """
import sys, time
from pathlib import Path
from metrpo.run.lock import hold
with hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_run_that_outlived_its_tune_is_stopped_and_taken_over(tmp_path, monkeypatch):
    (run,) = search().runs(0, {"trpo.max_kl": 0.1})
    directory, started = tmp_path / run.name, []
    directory.mkdir(parents=True)

    def begun(run, out, cores):
        started.append((run, out, cores))
        return FakeWorker(Fake(), run, out)

    monkeypatch.setattr(processes, "start", begun)
    for asked in (True, False):
        held = subprocess.Popen([sys.executable, "-c", HOLDS, str(directory)], stdout=subprocess.PIPE, text=True)
        try:
            assert held.stdout.readline() == "held\n"
            orphan = processes.begin(run, tmp_path, (0,))
            assert orphan.poll() is None
            assert started == []
            if asked:
                orphan.terminate()
                assert held.wait(timeout=60) == -signal.SIGTERM
                assert orphan.wait() == 0
            else:
                held.kill()
                held.wait()
                assert orphan.poll() is None, "it goes on in a process of our own"
                assert started == [(run, tmp_path, (0,))]
        finally:
            held.kill()
            held.stdout.close()
            held.wait()


@pytest.mark.timeout(1800)  # seconds on a free core; a machine that does other work needs longer
@pytest.mark.slow
def test_killed_with_its_run_tune_goes_on_from_the_checkpoint(tmp_path):
    out = tmp_path / "out"
    fixed = {name: value for name, value in SMALL.items() if name != "iterations"}
    file = tmp_path / "search.toml"
    file.write_text(
        f'task = "{SUPPORT / "probe.py"}:PROBE"\ntrials = 1\nseeds = 0\niterations = 3\n[search]\n'
        'trpo.max_kl = "log 0.001..0.1"\n[set]\n'
        + "".join(f"{name} = {json.dumps(value)}\n" for name, value in fixed.items())
    )

    def start():
        words = [sys.executable, "-m", "metrpo", "tune", str(file), "--jobs", "1", "--out", str(out), "--json"]
        return subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(SUPPORT)})

    first = start()
    while not list(out.glob("*/trial-000/seed-0/metrics.csv")) and first.poll() is None:
        time.sleep(0.05)
    first.kill()
    first.communicate()
    assert first.returncode == -signal.SIGKILL
    (lock,) = out.glob("*/trial-000/seed-0/.lock")
    os.kill(int(lock.read_text()), signal.SIGKILL)
    assert len(read_metrics(lock.with_name("metrics.csv"))) < 3
    second = start()
    record = json.loads(second.communicate(timeout=500)[0])
    assert second.returncode == 0
    (trial,) = record["trials"]
    assert (trial["number"], trial["state"], trial["iterations"]) == (0, "complete", 3)
    (run,) = out.glob("*/trial-000/seed-0")
    rows = read_metrics(run / "metrics.csv")
    assert [row["iteration"] for row in rows] == [1, 2, 3]
    assert trial["value"] == pytest.approx(sum(row["return_real"] for row in rows) / 3)
    said = [line[:13] for line in run.with_suffix(".log").read_text().splitlines() if " real steps " in line]
    made = [line for line in said if line.startswith("iteration")]
    # The kill may come between an iteration's last file and its line.
    assert made in ([f"iteration {n}/3" for n in (1, 2, 3)], [f"iteration {n}/3" for n in (2, 3)]), "one was made again"
    page = tmp_path / "page.html"
    for words in (["report", str(out), "--out", str(page)], ["watch", str(out), "--once"]):
        assert main.main(words) == 0
    assert "trial-000" in page.read_text()
    assert main.main(["plot", str(out), "--out", str(tmp_path / "curves.png")]) == 0


# ---------------------------------------------------------------- the committed search


def test_the_committed_search_is_what_its_page_says(tmp_path):
    page = (ROOT / "docs" / "tuning.md").read_text()
    line = next(part for part in page.split("```") if "--out results/tune" in part).replace("\\\n", " ")
    asked = search_of(parse.parse(shlex.split(line)[1:]))
    shutil.copy(ROOT / "results" / "tune" / FILE, tmp_path)
    found = tune(asked, tmp_path, 1, silent, Fake())
    assert (len(found.records), sum(r.state == "pruned" for r in found.records)) == (8, 2)
    for r in found.records:
        rows = [tuning.rows_of(run, ROOT / "results" / "tune") for run in asked.runs(r.number, r.settings)]
        assert r.real_steps == sum(one[-1]["real_steps"] for one in rows)
        if r.state == "pruned":
            assert f"{r.value:.0f}" in page
            continue
        assert worth(rows) == r.returns
        returns = ", ".join(f"{value:.1f}" for value in r.returns)
        assert re.search(rf"\| {r.number}\D* \| {r.value:.1f} \| {returns} \|", page)
    assert f"{64_000 - sum(r.real_steps for r in found.records):,} of 64,000" in page
    for trial in ("trial-003", "trial-000"):
        again = sorted((ROOT / "results" / "tune-again" / "Pendulum-v1" / trial).glob("seed-*/metrics.csv"))
        each = worth([read_metrics(path) for path in again])
        assert f"{sum(each) / 3:.1f} ({', '.join(f'{value:.1f}' for value in each)})" in page
