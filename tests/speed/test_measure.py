"""`metrpo bench`: operations counted by hand, ratios and shares within a round, and what a script reads."""

from __future__ import annotations

import json
import subprocess

import pytest

from metrpo.commands.main import main
from metrpo.presets import override, preset
from metrpo.speed import measure, ours, peers


def test_operations_are_those_of_the_layers():
    assert ours.operations("1024") == 2 * (24 * 1024 + 1024 * 1024 + 1024 * 18)
    assert ours.operations("200x4") == 2 * (24 * 200 + 3 * 200 * 200 + 200 * 18)


def test_every_work_of_a_peer_has_a_counterpart():
    works = ours.works()
    for offered in peers.WORK.values():
        for theirs in offered:
            assert measure.counterpart(theirs, works) in works
    assert measure.counterpart("fit-1024-bfloat16", works) == "fit-1024-bfloat16"
    assert measure.counterpart("trpo-value", works) == "trpo"


class FakeWorker:
    """A peer that takes 3 s, then 6 s, then 12 s."""

    def __init__(self, name):
        self.name, self.seconds = name, iter([3.0, 6.0, 12.0])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def measure(self, work, repeat):
        ORDER.append(f"{self.name} {work}")
        return [next(self.seconds)] * repeat


ORDER: list[str] = []


def scripted(name, seconds):
    seconds = iter(seconds)

    def run():
        ORDER.append(name)
        return next(seconds)

    return run


@pytest.fixture
def fake(monkeypatch):
    ORDER.clear()
    # The machine slows down from round to round; ours and the peer alike.
    table = {
        "products": lambda: ours.Work(scripted("products", [1.0, 2.0, 4.0]), 8e9),
        "fit-1024": lambda: ours.Work(scripted("fit-1024", [2.0, 4.0, 8.0]), 4e9, "products", 100.0),
    }
    monkeypatch.setattr(ours, "works", lambda: table)
    monkeypatch.setattr(measure, "TURN", 0.0)
    monkeypatch.setattr(peers, "WORK", {"slowlib": ("fit-1024",)})
    monkeypatch.setattr(peers, "PEERS", ("slowlib",))
    monkeypatch.setattr(peers, "PeerWorker", FakeWorker)
    monkeypatch.setattr(peers, "is_installed", lambda: True)


@pytest.mark.parametrize(
    ("takes", "expected", "repetitions"),
    # The first finds the caches cold; what is longer than a turn is done once.
    [([0.5, 0.25, 0.125, 0.375], 0.25, 4), ([1.2], 1.2, 1), ([0.9, 0.2], 0.2, 2)],
)
def test_short_work_is_repeated_and_the_first_time_not_counted(takes, expected, repetitions, monkeypatch):
    clock, done = [0.0], []
    monkeypatch.setattr(measure.time, "perf_counter", lambda: clock[0])

    def run():
        done.append(takes[len(done)])
        clock[0] += done[-1]
        return done[-1]

    assert measure._turn(run) == pytest.approx(expected)
    assert len(done) == repetitions


def test_shares_and_ratios_are_taken_within_a_round(fake):
    measured = measure.bench(True, 3, False)
    rate, mine, theirs = measured.timings
    assert ORDER[:3] == ["products", "fit-1024", "slowlib fit-1024"]
    assert len(ORDER) == 9
    assert (rate.seconds, rate.gigaflops, rate.share) == (2.0, 4.0, None)
    assert (mine.seconds, mine.gigaflops, mine.per_second) == (4.0, 1.0, 25.0)
    assert mine.share == pytest.approx(0.25)  # half the operations in twice the time, in every round
    assert (theirs.who, theirs.seconds, theirs.ratio) == ("slowlib", 6.0, 1.5)
    text = measured.text()
    assert "25 %" in text
    assert "1.50" in text


def test_the_command_prints_what_a_script_reads(fake, capsys):
    assert main(["bench", "--peers", "--rounds", "3", "--no-iterations", "--json"]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["machine"]["cores"] >= 1
    assert [t["name"] for t in record["timings"]] == ["products", "fit-1024", "fit-1024"]
    assert record["timings"][2]["ratio"] == 1.5
    assert record["iterations"] is None
    assert "round 3 of 3" in err


def test_a_wrong_number_of_rounds_is_named(capsys):
    assert main(["bench", "--rounds", "0"]) == 2
    assert "rounds: expected at least 1, got 0" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["trpo-1-cg", "baseline", "collect", "imagine-200x4", "validate-200x2"])
def test_real_work_runs_and_takes_time(name):
    assert 0 < ours.works()[name]().run() < 60


@pytest.mark.slow
def test_iterations_are_timed_and_their_compilations_counted(monkeypatch):
    small = {
        "iterations": 3,
        "collect.steps": 200,
        "ensemble.hidden": (4,),
        "ensemble.members": 2,
        "fit.max_steps": 5,
        "imagine.steps": 400,
        "validate.starts": 2,
        "validate.max_updates": 5,
        "evaluation_episodes": 1,
    }
    monkeypatch.setattr(ours, "small_iteration", lambda: override(preset("Swimmer"), small))
    monkeypatch.setattr(measure, "_start_to_imagined", lambda: 1.5)
    measured = measure._iterations(lambda text: None)
    assert len(measured.seconds) == 3
    assert measured.compilations[0] > 5
    assert measured.compilations[2] == 0
    assert all(0 < share < 1 for share in measured.outside)
    text = measure.BenchReport({}, [], measured).text()
    assert "compilations: " in text
    assert "compile cache warm: 1.5 s" in text


def test_a_process_ends_with_its_first_imagined_steps(tmp_path):
    small = ["--collect.steps", "200", "--ensemble.hidden", "4", "--fit.max-steps", "5", "--imagine.steps", "400"]
    command = [*measure.UNTIL_IMAGINED, "Pendulum-v1", "--run-dir", str(tmp_path / "run"), *small]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "imagined" in done.stdout, done.stderr
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "run" / "policy.npz").exists(), "an iteration that was not finished"
