"""What a callback hears, what one that fails costs, and what a program that trains shows."""

import io
import logging
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import metrpo
from blank_run import CONFIG, a_row, a_state
from helpers import random_episode
from metrpo import training
from metrpo.callbacks import Callback
from metrpo.console import progress
from metrpo.console.progress import SILENT, LiveProgress, PlainProgress
from metrpo.run.metrics import read_metrics

pytestmark = pytest.mark.usefixtures("plain_curve")


@pytest.fixture(autouse=True)
def _blank(monkeypatch):
    """A method that plays an episode in each iteration and learns nothing."""

    def step(config, task, state, shown, log):
        log.append(random_episode(np.random.default_rng(state.iteration), 5, 3, 2))
        assert log.failures() == {}
        log.pending()
        return a_state(state.iteration + 1), a_row(state.iteration + 1)

    blank = SimpleNamespace(init=lambda config, task: a_state(), step=step)
    monkeypatch.setattr(training, "import_module", lambda name: blank)
    monkeypatch.setattr(training, "are_kept", lambda *_: True)


class Heard(Callback):
    def __init__(self):
        self.all = []

    def on_begin(self, config, run_dir, rows):
        self.all.append(("begin", config.task, run_dir, len(rows)))

    def on_episode(self, episode):
        self.all.append(("episode", len(episode.rewards)))

    def on_checkpoint(self, checkpoint):
        assert checkpoint.is_file()
        self.all.append(("checkpoint", checkpoint.name))

    def on_iteration(self, row):
        self.all.append(("iteration", row["iteration"], row["real_steps"]))

    def on_end(self):
        self.all.append(("end",))


def iteration(i):
    return [("episode", 5), ("checkpoint", f"iteration-{i:05d}.npz"), ("iteration", i, 100 * i)]


def test_a_callback_hears_of_episodes_rows_and_checkpoints(tmp_path):
    heard, again = Heard(), Heard()
    training.train(CONFIG, tmp_path, SILENT, [heard])
    assert heard.all == [
        ("begin", "Swimmer", tmp_path, 0),
        *[told for i in range(1, 6) for told in iteration(i)],
        ("end",),
    ]
    training.train(CONFIG, tmp_path, SILENT, [again])
    assert again.all == [("begin", "Swimmer", tmp_path, 5), ("end",)]
    bare = Heard()
    training.train(CONFIG, None, SILENT, [bare])
    assert bare.all[:3] == [("begin", "Swimmer", None, 0), ("episode", 5), ("iteration", 1, 100)]


@pytest.mark.parametrize("name", ["on_begin", "on_episode", "on_checkpoint", "on_iteration", "on_end"])
def test_a_callback_that_fails_is_warned_of_once_and_costs_nothing(name, tmp_path, caplog):
    class Broken(Heard):
        pass

    def fail(self, *_):
        self.all.append(name)
        raise OSError("no network")

    setattr(Broken, name, fail)
    broken, heard = Broken(), Heard()
    with caplog.at_level(logging.WARNING):
        training.train(CONFIG, tmp_path, SILENT, [broken, heard])
    assert broken.all.count(name) == 1, "called no more"
    assert [r.getMessage() for r in caplog.records] == [
        "Broken failed and is not called again (OSError: no network); training continues"
    ]
    assert len(read_metrics(tmp_path / "metrics.csv")) == 5
    assert heard.all[-1] == ("end",)


def test_a_run_that_breaks_off_ends_its_callbacks(tmp_path, monkeypatch):
    heard = Heard()
    monkeypatch.setattr(heard, "on_iteration", lambda row: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        training.train(CONFIG, tmp_path, SILENT, [heard])
    assert heard.all[-1] == ("end",)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_program_shows_progress_in_a_terminal_and_a_notebook_only(tmp_path, monkeypatch, capsys):
    def shown():
        return progress.library_progress()

    assert shown() is SILENT
    training.train(CONFIG, tmp_path)
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(sys, "stdout", Terminal())
    assert isinstance(shown()._shown, LiveProgress)
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    for name, kind in (("ZMQInteractiveShell", PlainProgress), ("TerminalInteractiveShell", None)):
        shell = type(name, (), {})()
        monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda shell=shell: shell))
        monkeypatch.setattr(progress.importlib.util, "find_spec", lambda name: None)
        assert shown() is SILENT if kind is None else isinstance(shown()._shown, kind)


def test_the_version_is_the_installed_one():
    from importlib.metadata import version

    assert metrpo.__version__ == version("metrpo")
    code = "import metrpo, sys; metrpo.__version__; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"
