"""Each tracker logs a run's rows on this machine, without a network, and goes on with the run that it had begun."""

import json
import os
import sys

import pytest

from metrpo.commands import main
from metrpo.config import Config
from metrpo.errors import ConfigError
from metrpo.run.about import about
from metrpo.trackers import TRACKERS, trackers

CONFIG = Config("Swimmer", seed=3)


def row(iteration):
    gap = float("nan") if iteration == 1 else 0.5
    return {"iteration": iteration, "real_steps": 100 * iteration, "return_real": iteration / 2, "gap": gap, "x": None}


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    """A run directory, and a home and a working folder that hold nothing else."""
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith(("WANDB_", "MLFLOW_", "TRACKIO_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    folder = tmp_path / "runs" / "swim"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text('{"format": 1}')
    return folder


def track(name, run_dir, first, last):
    """What a training does that begins after iteration `first` and ends with `last`."""
    (tracker,) = trackers([name, name])
    tracker.on_begin(CONFIG, run_dir, [row(i + 1) for i in range(first)])
    for i in range(first, last):
        tracker.on_iteration(row(i + 1))
    tracker.on_end()
    return about(run_dir).get(f"tracked_by_{name}")


@pytest.mark.filterwarnings("ignore")
def test_mlflow_logs_where_it_does_by_itself_and_goes_on(run_dir):
    """Without a variable of MLflow's, as a user who has only read `--track mlflow` has it."""
    mlflow = pytest.importorskip("mlflow")
    found = track("mlflow", run_dir, 0, 2)
    assert track("mlflow", run_dir, 2, 4) == found
    client = mlflow.MlflowClient()
    assert [(m.step, m.value) for m in client.get_metric_history(found, "return_real")] == [
        (1, 0.5), (2, 1.0), (3, 1.5), (4, 2.0),
    ]  # fmt: skip
    assert [m.step for m in client.get_metric_history(found, "gap")] == [2, 3, 4], "no NaN"
    run = client.get_run(found)
    assert (run.data.params["seed"], run.info.run_name, run.info.status) == ("3", "swim", "FINISHED")
    assert (run_dir.parent.parent / "mlflow.db").exists()


@pytest.mark.filterwarnings("ignore")
def test_trackio_logs_to_this_machine_and_goes_on(run_dir, monkeypatch):
    monkeypatch.setenv("TRACKIO_DIR", str(run_dir.parent / "trackio"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    trackio = pytest.importorskip("trackio")
    found = track("trackio", run_dir, 0, 2)
    assert track("trackio", run_dir, 2, 3) == found == "swim"
    from trackio.sqlite_storage import SQLiteStorage

    logs = SQLiteStorage.get_logs("metrpo", "swim")
    assert [(log["step"], log["return_real"]) for log in logs] == [(1, 0.5), (2, 1.0), (3, 1.5)]
    assert trackio is sys.modules["trackio"]


@pytest.mark.filterwarnings("ignore")
def test_wandb_logs_offline_into_the_run_directory(run_dir, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    found = track("wandb", run_dir, 0, 2)
    assert track("wandb", run_dir, 2, 3) == found
    files = sorted((run_dir / "wandb").glob(f"offline-run-*-{found}"))
    assert files
    written = b"".join(path.read_bytes() for folder in files for path in folder.glob("*.wandb"))
    assert b"return_real" in written
    monkeypatch.setenv("WANDB_DIR", str(run_dir / "elsewhere"))
    (run_dir / "elsewhere").mkdir()
    track("wandb", run_dir, 3, 4)
    assert list((run_dir / "elsewhere" / "wandb").glob("offline-run-*"))
    wandb.teardown()


def test_tensorboard_needs_a_writer_only_without_a_run_directory(run_dir, tmp_path):
    track("tensorboard", run_dir, 0, 1)
    assert not (tmp_path / "runs" / "events").exists()
    (tracker,) = trackers(["tensorboard"])
    tracker.on_begin(CONFIG, None, [])
    tracker.on_iteration(row(1))
    tracker.on_end()
    (events,) = (tmp_path / "runs" / "events" / "Swimmer-seed3").iterdir()
    assert b"return_real" in events.read_bytes()


def test_tracking_that_begins_late_has_the_earlier_rows(run_dir, monkeypatch):
    logged = []
    from metrpo.trackers.common import Tracker

    class Late(Tracker):
        name = "late"

        def start(self, title, settings, run_dir, earlier):
            logged.append((title, settings["ensemble.hidden"], earlier))
            return "an id"

        def log(self, numbers, iteration):
            logged.append((iteration, numbers))

    Late().on_begin(CONFIG, run_dir, [row(1), row(2)])
    Late().on_begin(CONFIG, run_dir, [row(1), row(2)])
    assert [entry[0] for entry in logged] == ["swim", 1, 2, "swim"]
    assert (logged[0][1:], logged[3][2]) == (([1024, 1024], None), "an id")
    assert json.loads((run_dir / "run.json").read_text()) == {"format": 1, "tracked_by_late": "an id"}


def test_a_missing_package_and_an_unknown_name_are_said_at_once(monkeypatch, capsys):
    with pytest.raises(ConfigError, match="track: expected some of wandb, mlflow, trackio, tensorboard, got 'neptune'"):
        trackers(["neptune"])
    for name, (package, _) in TRACKERS.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigError, match=rf"track: no package {package}: pip install 'metrpo\[{name}\]'"):
            trackers([name])
    assert main.main(["train", "Swimmer", "--track", "wandb"]) == 2
    assert "no package wandb" in capsys.readouterr().err
