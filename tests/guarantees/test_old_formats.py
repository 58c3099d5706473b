"""A directory of format 1, as the code of commit 44a0ecc wrote it, goes on today; other formats are refused by name.

`format-1` was made by that commit's `train` with `CONFIG`, without what is derived (curve, events).
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

import probe
from metrpo import external, training
from metrpo.errors import RunDirectoryError
from metrpo.presets import override, preset
from metrpo.run import derived_files, files
from metrpo.run import directory as directories
from metrpo.run.directory import stored_config
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import DamagedFile, read_arrays, write_arrays
from metrpo.run.metrics import read_metrics
from metrpo.run.policy_file import load_policy
from metrpo.types import Episode
from places import GUARANTEES

OLD = GUARANTEES / "format-1"
AS_IT_WAS = {
    "advantage.baseline": "linear",
    "advantage.gae_lambda": 1.0,
    "collect.max_std": 3.0,
    "collect.std_power": 1.0,
    "collect.noise_correlation": 0.0,
    "collect.parameter_noise": 3.0,
    "ensemble.delta_std_floor": 1e-4,
    "ensemble.std_floor": 0.1,
    "imagine.steps": 30_000,
    "policy.initial_std": 2.0,
    "policy.mean_penalty": 0.0,
    "policy.min_std": 0.0,
    "policy.normalise": False,
    "trpo.max_kl": 0.03,
    "validate.patience": 50,
    "validate.real_episodes": 0,
}
"""The preset's values at that commit that are others today."""
SWIMMER = override(preset("Swimmer"), AS_IT_WAS)
CONFIG = override(dataclasses.replace(SWIMMER, task="Probe", iterations=2), probe.BRIEF)


@pytest.fixture(autouse=True)
def _probe_is_a_task(monkeypatch):
    monkeypatch.setattr(derived_files, "draw_curve", lambda *_: None)
    with probe.registered():
        yield


@pytest.fixture
def run_dir(tmp_path):
    return shutil.copytree(OLD, tmp_path / "run")


def test_the_committed_directory_is_as_that_commit_wrote_it():
    assert sum(path.stat().st_size for path in OLD.rglob("*") if path.is_file()) < 150_000
    assert not (OLD / "episodes").exists(), "it did not have them yet"
    for path in OLD.rglob("*.npz"):
        assert read_arrays(path)[1]["format"] == 1
        with zipfile.ZipFile(path) as archive:
            assert archive.testzip() is None
    assert "members_reset" not in read_metrics(OLD / "metrics.csv")[0]


def test_its_settings_policy_and_metrics_are_read(run_dir):
    assert stored_config(run_dir) == CONFIG
    policy = load_policy(run_dir)
    assert (policy.info.task, policy.info.iteration, policy.info.real_steps) == ("Probe", 2, 120)
    state, _ = read_arrays(run_dir / "checkpoints" / "iteration-00002.npz")
    np.testing.assert_array_equal(policy.layers[0][0], state[".policy.layers[0][0]"])
    assert [row["real_steps"] for row in read_metrics(run_dir / "metrics.csv")] == [60, 120]


def test_it_is_resumed_to_a_further_iteration(run_dir):
    before = read_metrics(run_dir / "metrics.csv")
    state = training.train(dataclasses.replace(CONFIG, iterations=3), run_dir)
    assert (state.iteration, state.real_steps) == (3, 180)
    assert state.dataset.train.size + state.dataset.validation.size == 180, "what it had learned from is still there"
    rows = read_metrics(run_dir / "metrics.csv")
    assert [row["iteration"] for row in rows] == [1, 2, 3]
    for row, old in zip(rows, before, strict=False):
        assert {name: row[name] for name in old} == pytest.approx(old, nan_ok=True)
    assert load_policy(run_dir).info.iteration == 3
    assert len(EpisodeLog(run_dir).pending()) == 3, "its episodes are kept as today's are"
    again = training.train(dataclasses.replace(CONFIG, iterations=3), run_dir)
    assert again.iteration == 3


def test_a_damaged_checkpoint_of_it_costs_one_iteration(run_dir, caplog):
    newest = run_dir / "checkpoints" / "iteration-00002.npz"
    newest.write_bytes(newest.read_bytes()[:-1])
    with directories.RunDirectory(run_dir, CONFIG) as run:
        state = run.load(training.init(CONFIG))
    assert state.iteration == 1
    assert "iteration-00002.npz is damaged" in caplog.text


def of_format_2(path: Path) -> None:
    """Writes the file anew as a later version might."""
    if path.suffix == ".json":
        path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 2, "metrpo": "2.0"}))
        return
    arrays, meta = read_arrays(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "FORMAT", 2)
        write_arrays(path, arrays, meta | {"format": 2, "metrpo": "2.0"})


def resume(run_dir):
    with directories.RunDirectory(run_dir, CONFIG) as run:
        run.load(training.init(CONFIG))
        run.episodes.pending()


@pytest.mark.parametrize(
    ("name", "use"),
    [
        ("run.json", resume),
        ("run.json", external.improve),
        ("checkpoints/iteration-00002.npz", resume),
        ("checkpoints/iteration-00002.npz", external.improve),
        ("policy.npz", load_policy),
        ("episodes/00000000.npz", resume),
        ("episodes/00000000.npz", external.improve),
    ],
)
def test_a_file_of_format_2_is_refused_by_name_and_left_alone(run_dir, name, use):
    states, actions, rewards = probe.rollout(probe.PROBE, 0, lambda t, s: -s)
    EpisodeLog(run_dir).append(Episode(*(np.asarray(x, np.float32) for x in (states, actions, rewards)), False))
    path = run_dir / name
    of_format_2(path)
    before = path.read_bytes()
    with pytest.raises(
        RunDirectoryError, match=rf"{path.name} has format 2 \(written by metrpo 2\.0\).* reads format 1"
    ) as e:
        use(run_dir)
    assert not isinstance(e.value, DamagedFile), "it is not damaged, so that nothing falls back on an older file"
    assert path.read_bytes() == before


@pytest.mark.parametrize("found", [2, 0, "1", 1.0, True, None, [1]])
def test_a_format_is_the_number_one_and_nothing_like_it(run_dir, found):
    about = json.loads((run_dir / "run.json").read_text())
    (run_dir / "run.json").write_text(json.dumps(about | {"format": found}))
    with pytest.raises(RunDirectoryError, match=r"run\.json has format"):
        resume(run_dir)


def test_a_policy_json_of_format_2_is_derived_and_written_anew(run_dir):
    of_format_2(run_dir / "policy.json")
    resume(run_dir)
    assert json.loads((run_dir / "policy.json").read_text())["format"] == 1
