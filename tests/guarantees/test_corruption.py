"""Whatever happens to the files of a run: its state is a sound one, byte for byte, or an error names the file.

Each trial damages a copy of one real run, opens it as every command does, and looks at what comes out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import probe
from metrpo import training
from metrpo.errors import MetrpoError
from metrpo.presets import override, preset
from metrpo.run import derived_files
from metrpo.run.directory import RunDirectory, stored_config
from metrpo.run.episodes import append_episode
from metrpo.run.policy_file import load_policy

CONFIG = override(dataclasses.replace(preset("Swimmer"), task="Probe", iterations=3), probe.BRIEF)
NEWEST, PREVIOUS = "checkpoints/iteration-00003.npz", "checkpoints/iteration-00002.npz"
FILES = 17
POLICIES = ("policy.npz", "best/policy.npz")
DERIVED = ("metrics.csv", "diagnostics.csv", "policy.npz", "policy.json", "curve.png")


class Found(NamedTuple):
    """What came out of a run directory."""

    state: list[bytes]
    episodes: list[bytes]
    warnings: list[str]


class Real(NamedTuple):
    """A run, another one of the same task, and what is to come out."""

    path: Path
    other: Path
    files: tuple[str, ...]
    template: Any
    by_checkpoint: dict[str, Found]

    def __repr__(self):
        return "real"


@pytest.fixture(scope="module", autouse=True)
def _quick():
    """The probe is a task, pictures are quick to draw, and nothing waits for the disk."""
    with probe.registered(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(derived_files, "draw_curve", lambda rows, path, *_: path.write_text(f"{len(rows)} iterations"))
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="module")
def real(tmp_path_factory, _quick):
    path, other = (tmp_path_factory.mktemp("real") / name for name in ("run", "other"))
    for run_dir, seed in ((path, 0), (other, 1)):
        training.train(dataclasses.replace(CONFIG, seed=seed), run_dir)
        for number in range(2):
            states, actions, rewards = probe.rollout(probe.PROBE, 10 * seed + number, lambda t, s: -s)
            append_episode(run_dir, states, actions, rewards, terminated=False)
    template = training.init(CONFIG)
    newest = look(path, template)
    without = shutil.copytree(path, path.with_name("without"))
    (without / NEWEST).unlink()
    previous = look(without, template)
    assert (len(newest.episodes), len(previous.episodes)) == (2, 5)
    files = tuple(sorted(str(p.relative_to(path)) for p in path.rglob("*") if p.is_file() and p.name != ".lock"))
    assert {NEWEST, PREVIOUS, "run.json", "config.json", *DERIVED} <= set(files)
    assert len(files) == FILES, files
    theirs = shutil.copytree(other, other.with_name("theirs"))
    newest_of_theirs = look(theirs, template)
    (theirs / NEWEST).unlink()
    theirs = newest_of_theirs._replace(episodes=look(theirs, template).episodes)
    return Real(path, other, files, template, {NEWEST: newest, PREVIOUS: previous, "another run's": theirs})


class _Heard(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record):
        self.messages.append(record.getMessage())


def look(run_dir, template):
    """Opens a run as every command does."""
    heard, log = _Heard(), logging.getLogger("metrpo")
    log.addHandler(heard)
    try:
        with RunDirectory(run_dir, stored_config(run_dir)) as run:
            state = run.load(template)
            assert state is not None, "a run with checkpoints or metrics is never taken for a fresh one"
            assert jax.tree.structure(state) == jax.tree.structure(template)
            episodes = run.episodes.pending()
    finally:
        log.removeHandler(heard)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    waiting = [b"|".join(np.asarray(array).tobytes() for array in episode) for episode in episodes]
    return Found([leaf.tobytes() for leaf in leaves], waiting, heard.messages)


class Damage(NamedTuple):
    """What is done to one file."""

    file: str
    deed: str
    number: int
    """Where, which bits, or which other file: reduced to what there is."""


DEEDS = ("truncate", "flip", "flip many", "zeros", "empty", "delete", "swap", "another run's", "directory", "append")


def apply(damage, run_dir, real):
    path, n = run_dir / damage.file, damage.number
    content = path.read_bytes() if path.is_file() else b""
    rng = np.random.default_rng(n)
    if damage.deed == "delete":
        path.unlink(missing_ok=True)
    elif damage.deed == "directory":
        path.unlink(missing_ok=True)
        path.mkdir()
    elif damage.deed == "swap":
        other = run_dir / real.files[n % len(real.files)]
        if path.is_file() and other.is_file():
            path.write_bytes(other.read_bytes())
            other.write_bytes(content)
            return [damage.file, str(other.relative_to(run_dir))]
    elif damage.deed == "another run's":
        theirs = [p for p in real.other.rglob(path.name if "events" not in damage.file else "events*") if p.is_file()]
        path.write_bytes(theirs[0].read_bytes())
    elif content:
        bad = bytearray(content)
        at = n % len(content)
        if damage.deed == "truncate":
            bad = bad[:at]
        elif damage.deed == "flip":
            bad[at] ^= 1 << n % 8
        elif damage.deed == "flip many":
            for i in rng.integers(len(bad), size=20):
                bad[i] ^= 1 << int(rng.integers(8))
        elif damage.deed == "zeros":  # a block that was never written
            bad[at : at + 512] = bytes(len(bad[at : at + 512]))
        elif damage.deed == "append":
            bad += rng.bytes(1 + n % 600)
        else:
            bad = bytearray()
        path.write_bytes(bad)
    return [damage.file]


def trial(real, damages):
    """Damages a copy of the run and holds what comes out against what may."""
    run_dir = real.path.with_name("trial")
    shutil.rmtree(run_dir, ignore_errors=True)
    shutil.copytree(real.path, run_dir)
    damaged = [
        name for damage in damages if not (run_dir / damage.file).is_dir() for name in apply(damage, run_dir, real)
    ]
    changed = {
        n for n in damaged if not (run_dir / n).is_file() or (run_dir / n).read_bytes() != (real.path / n).read_bytes()
    }
    try:
        found = look(run_dir, real.template)
    except MetrpoError as error:
        # A checkpoint that is gone is missed by those who are left: metrics.csv, or the iteration it should have had.
        named = any(Path(name).name in str(error) for name in changed)
        if not named and not ("has lost its checkpoints" in str(error) and {NEWEST, PREVIOUS} <= changed):
            pytest.fail(f"{changed} not named: {error}")
        return
    used = next((name for name in (NEWEST, PREVIOUS) if found.state == real.by_checkpoint[name].state), None)
    if {"config.json", NEWEST} <= changed and found.state == real.by_checkpoint["another run's"].state:
        return  # settings and state of one run: that is what the directory holds now
    assert used is not None, "garbage was loaded"
    told = "\n".join(found.warnings)
    if used == PREVIOUS:
        assert NEWEST in changed
        # Where it was deleted, metrics.csv alone says that there was one.
        assert Path(NEWEST).name in told or "metrics.csv" in changed
    lost = [name for name in changed if name.startswith("episodes/")]
    expected = real.by_checkpoint[used].episodes
    theirs = real.by_checkpoint["another run's"].episodes
    assert [e for e in found.episodes if e not in expected + theirs] == [], "sound episodes only, if in another order"
    if len(found.episodes) != len(expected):
        # Only files that are not there can be gone on without; one in the middle is missed, the last cannot be.
        assert lost
        last = max(name for name in real.files if name.startswith("episodes/"))
        assert "real episodes" in told or last in lost
    # What is derived is there again.
    original = contents_of(real, used)
    for name, content in original.items():
        path = run_dir / name
        if path.is_dir():
            assert name == "curve.png", "what cannot be written is an error, but for a picture"
            assert "no learning curve any more" in told
        else:
            assert path.read_bytes() == content, f"{name} was not written anew"
    # The best policy may be older than any checkpoint.
    sound = [(run / name).read_bytes() for run in (real.path, real.other) for name in POLICIES]
    best = run_dir / "best" / "policy.npz"
    with contextlib.suppress(MetrpoError):
        load_policy(best)
        assert best.read_bytes() in sound, "garbage was loaded"
    if "TensorBoard" not in told:
        assert len([p for p in (run_dir / "events").glob("events*") if p.stat().st_size]) == 1


def contents_of(real, used):
    where = real.path if used == NEWEST else real.path.with_name("without")
    return {name: (where / name).read_bytes() for name in (*DERIVED, "config.json")}


def _trials(count, most):
    one = st.tuples(st.integers(0, FILES - 1), st.sampled_from(DEEDS), st.integers(0, 2**31 - 1))
    quiet = settings(max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    return lambda test: quiet(given(damages=st.lists(one, min_size=1, max_size=most))(test))


@_trials(40, most=2)
def test_damaged_files_cost_an_iteration_at_most_or_are_named(real, damages):
    trial(real, [Damage(real.files[file], deed, number) for file, deed, number in damages])


@pytest.mark.slow
@_trials(2000, most=4)
def test_thousands_of_damaged_files_cost_an_iteration_at_most(real, damages):
    trial(real, [Damage(real.files[file], deed, number) for file, deed, number in damages])


@pytest.mark.parametrize("deed", DEEDS)
def test_every_file_on_its_own(real, deed):
    for name in real.files:
        for number in (0, 7_919_321, 2**31 - 1):
            trial(real, [Damage(name, deed, number)])


def test_a_renamed_checkpoint_is_not_taken_for_another_iteration(real):
    """The older one under the newer one's name: its iteration is collected again, and not counted twice."""
    trial(real, [])
    run_dir = shutil.copytree(real.path, real.path.with_name("renamed"))
    shutil.copy(run_dir / PREVIOUS, run_dir / NEWEST)
    found = look(run_dir, real.template)
    assert found.state == real.by_checkpoint[PREVIOUS].state
    assert "iteration-00003.npz is damaged (renamed): expected iteration 3, got 2" in found.warnings[0]


def test_an_episode_under_anothers_number_is_refused(real):
    """It would be learned from twice, and the one that waits would be lost."""
    run_dir = shutil.copytree(real.path, real.path.with_name("swapped"))
    learned, *_, waiting = sorted((run_dir / "episodes").iterdir())
    waiting.write_bytes(learned.read_bytes())
    with pytest.raises(MetrpoError, match=rf"{waiting.name} was renamed: expected episode {int(waiting.stem)}"):
        look(run_dir, real.template)


def test_a_lost_episode_is_missed(real):
    run_dir = shutil.copytree(real.path, real.path.with_name("lost"))
    first, last = sorted((run_dir / "episodes").iterdir())[-2:]
    first.unlink()
    found = look(run_dir, real.template)
    assert len(found.episodes) == 1
    assert "1 real episodes between" in found.warnings[-1]
    assert last.exists()


def test_what_is_derived_is_written_anew_and_nothing_else(real):
    run_dir = shutil.copytree(real.path, real.path.with_name("derived"))
    for name in DERIVED:
        (run_dir / name).write_bytes(b"\x00garbage")
    shutil.rmtree(run_dir / "events")
    look(run_dir, real.template)
    for name in DERIVED:
        assert (run_dir / name).read_bytes() == (real.path / name).read_bytes()
    assert list((run_dir / "events").iterdir())
