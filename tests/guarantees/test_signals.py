"""Ctrl-C and SIGTERM, really sent: the first ends the run after its step, the second at once, and nothing is lost."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
import time

import pytest

import tiny_run
from metrpo import external
from metrpo.commands import main
from metrpo.console.interrupt import Interruptible, Stopped
from metrpo.console.progress import PlainProgress, Progress
from metrpo.launch import local
from metrpo.run import files
from metrpo.run.episodes import EpisodeLog
from metrpo.run.metrics import read_metrics
from tiny_run import CONFIG, EPISODES, Counted, command_line, differing, result, train

SIGNALS = [(signal.SIGINT, 130), (signal.SIGTERM, 143)]


@pytest.fixture(autouse=True, scope="module")
def _cheap():
    with tiny_run.cheap():
        yield


@pytest.fixture(autouse=True)
def _handlers():
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.getsignal(signal.SIGTERM)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler, "the handlers are put back"
    assert signal.getsignal(signal.SIGTERM) is before[1]
    signal.signal(signal.SIGINT, before[0])


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("uninterrupted") / "run"
    train(CONFIG, run_dir)
    return result(run_dir)


def send(monkeypatch, number, times, iteration, stage):
    """Sends a signal as a stage of an iteration begins; the stage None: with `begin`."""
    at, left = [0], [times]
    begin, show = PlainProgress.begin, PlainProgress.stage

    def sending(now):
        while now == (iteration, stage) and left[0]:
            left[0] -= 1
            os.kill(os.getpid(), number)
            time.sleep(0.001)  # the handler runs here

    def counted_begin(self, iteration, of):
        begin(self, iteration, of)
        at[0] = iteration
        sending((iteration, None))

    def sending_stage(self, name, total=None):
        show(self, name, total)
        sending((at[0], name))

    monkeypatch.setattr(PlainProgress, "begin", counted_begin)
    monkeypatch.setattr(PlainProgress, "stage", sending_stage)


def finished(run_dir):
    return [row["iteration"] for row in read_metrics(run_dir / "metrics.csv")]


def assert_it_goes_on(run_dir, expected):
    """The very command ends the run as if it had never been stopped; no episode that was on disk is played again."""
    assert main.main(command_line(run_dir)) == 0
    assert differing(result(run_dir), expected) == []
    assert Counted.kept == tiny_run.ITERATIONS * EPISODES


@pytest.mark.parametrize(("number", "code"), SIGNALS)
@pytest.mark.parametrize(("stage", "saved"), [(None, 1), ("collect", 1), ("fit", 2), ("improve", 2), ("evaluate", 2)])
def test_the_first_ends_the_run_after_its_step(number, code, stage, saved, tmp_path, expected, monkeypatch, capfd):
    Counted.kept, run_dir = 0, tmp_path / "a run"
    with monkeypatch.context() as patch:
        send(patch, number, 1, 2, stage)
        assert main.main(command_line(run_dir)) == code
    assert finished(run_dir) == list(range(1, saved + 1))
    assert Counted.kept == EPISODES + {None: 0, "collect": 1}.get(stage, EPISODES), "the episode under way is kept"
    err = capfd.readouterr().err
    assert ("stopping after this" in err) == (stage is not None)
    kept = f"metrpo: stopped; {run_dir} keeps every finished iteration and real episode. The same command resumes."
    assert f"{kept}\n\n  {shlex.join(['metrpo', *command_line(run_dir)])}\n" in err
    assert_it_goes_on(run_dir, expected)


@pytest.mark.parametrize("stage", ["collect", "fit", "improve", "evaluate"])
def test_the_second_ends_it_at_once_and_loses_the_step_only(stage, tmp_path, expected, monkeypatch, capfd):
    Counted.kept = 0
    with monkeypatch.context() as patch:
        send(patch, signal.SIGINT, 2, 2, stage)
        assert main.main(command_line(tmp_path / "run")) == 130
    assert finished(tmp_path / "run") == [1]
    assert "The same command resumes." in capfd.readouterr().err
    assert_it_goes_on(tmp_path / "run", expected)


def test_in_the_last_evaluation_nothing_goes_on(tmp_path, expected, monkeypatch, capfd):
    """The iteration is finished and saved: only a part of the record can be missing."""
    run_dir = tmp_path / "run"
    with monkeypatch.context() as patch:
        send(patch, signal.SIGTERM, 1, tiny_run.ITERATIONS, "evaluate")
        assert main.main(command_line(run_dir)) == 143
    err = capfd.readouterr().err
    assert "command resumes" not in err
    command = shlex.join(["metrpo", *command_line(run_dir)])
    again = f"The same command would only write the files that are missing, such as the video.\n\n  {command}\n"
    assert f"metrpo: stopped; {run_dir} is complete: nothing is lost. {again}" in err
    assert differing(result(run_dir), expected) == []
    with monkeypatch.context() as patch:
        send(patch, signal.SIGTERM, 1, tiny_run.ITERATIONS + 1, "collect")
        assert main.main(command_line(run_dir, "--iterations", str(tiny_run.ITERATIONS + 1))) == 143
    assert "The same command resumes." in capfd.readouterr().err, "a larger budget is not spent"


@pytest.mark.parametrize("times", [1, 2])
def test_while_a_checkpoint_is_written(times, tmp_path, expected, monkeypatch):
    fsync, left = os.fsync, [times]

    def interrupted(handle):
        if "iteration-00002.tmp" in os.readlink(f"/proc/self/fd/{handle}"):
            while left[0]:
                left[0] -= 1
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.001)
        fsync(handle)

    Counted.kept = 0
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", interrupted)
        assert main.main(command_line(tmp_path / "run")) == 143
    assert finished(tmp_path / "run") == ([1, 2] if times == 1 else [1])
    assert_it_goes_on(tmp_path / "run", expected)


def test_what_a_shell_lets_run_in_its_background_ignores_ctrl_c(tmp_path, monkeypatch):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    send(monkeypatch, signal.SIGINT, 3, 1, "fit")
    assert main.main(command_line(tmp_path / "run")) == 0
    assert signal.signal(signal.SIGINT, signal.default_int_handler) is signal.SIG_IGN


@pytest.mark.parametrize(("number", "code"), SIGNALS)
def test_the_single_steps_too(number, code, tmp_path, expected, monkeypatch, capfd):
    Counted.kept, run_dir = 0, tmp_path / "run"
    external.begin(CONFIG, run_dir)
    with monkeypatch.context() as patch:
        send(patch, number, 1, 1, "collect")
        assert main.main(["collect", str(run_dir)]) == code
    assert len(EpisodeLog(run_dir).pending()) == 1
    assert f"metrpo collect {run_dir}" in capfd.readouterr().err
    assert main.main(["collect", str(run_dir)]) == 0
    with monkeypatch.context() as patch:
        send(patch, number, 1, 1, "improve")
        assert main.main(["improve", str(run_dir)]) == code
    assert "nothing is left to do.\n" in (err := capfd.readouterr().err)
    assert "metrpo improve" not in err, "given again it would find no episodes"
    assert finished(run_dir) == [1]
    assert_it_goes_on(run_dir, expected)


def test_episodes_that_nobody_keeps_are_no_place_to_stop():
    with Interruptible(Progress(), keeps_episodes=False) as progress:
        progress.begin(1, 2)
        progress.stage("collect")
        os.kill(os.getpid(), signal.SIGTERM)
        progress.update(20)
        progress.stage("improve")
        with pytest.raises(Stopped, match="SIGTERM"):
            progress.end({})


STUBBORN = """
import signal, sys, time
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append(1))
print("ready", flush=True)
while len(asked) < 2:
    time.sleep(0.01)
"""


def test_several_runs_are_asked_twice():
    process = subprocess.Popen([sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    process.stdout.close()
    told = []
    child = local._Child(None, process, (), 0.0)
    threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        local._stop([child], told.append)
    assert process.poll() == 0
    assert told == ["stopping 1 run at the end of an iteration; press again to stop at once"]


def ends_so(run_dir, number, code, words, environment):
    line = tiny_run.process_line(run_dir, "--device", "cpu", *words)
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        while not process.stdout.readline().endswith("fit\n"):
            assert process.poll() is None
        process.send_signal(number)
        _, err = process.communicate(timeout=350)
    assert process.returncode == code
    assert "metrpo: stopping after this iteration; press again to stop at once" in err
    assert "The same command resumes.\n\n  metrpo train Probe --run-dir" in err
    assert finished(run_dir) == [1]


@pytest.mark.parametrize(("number", "code"), SIGNALS)
def test_a_process_ends_so(number, code, tmp_path):
    """Asked while it fits, which takes a while with so many steps."""
    words = [f"--fit.{name}=2_000" for name in ("max-steps", "max-passes", "patience")]
    ends_so(tmp_path / "run", number, code, words, None)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("number", "code"), SIGNALS)
def test_a_process_that_compiles_ends_so(number, code, tmp_path):
    """The cache is empty, and the flags are the command's own, as users have them."""
    own = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    ends_so(tmp_path / "run", number, code, [], own | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")})
