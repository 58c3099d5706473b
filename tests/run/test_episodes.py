"""Real episodes on disk: whole, in order, none twice, none lost, whoever writes them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import random_episode, random_policy
from metrpo.errors import RunDirectoryError, TaskError
from metrpo.run.episodes import EpisodeLog, append_episode
from metrpo.run.files import DamagedFile
from metrpo.run.policy_file import Learned, save_policy


def episodes(count, seed=0):
    rng = np.random.default_rng(seed)
    return [random_episode(rng, int(rng.integers(1, 9)), terminated=bool(rng.integers(2))) for _ in range(count)]


def same(some, others):
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(one, other, strict=True))
        assert type(other.terminated) is bool


def names(run_dir):
    return sorted(p.name for p in (run_dir / "episodes").iterdir())


@pytest.fixture
def run_dir(tmp_path):
    """A directory with a policy for states [4] and actions [2]."""
    save_policy(tmp_path, random_policy(), "Somewhere", Learned(0, 0, None))
    return tmp_path


def test_what_was_appended_is_pending_in_order_and_as_it_was(tmp_path):
    log, some = EpisodeLog(tmp_path), episodes(12)
    assert log.pending() == []
    for episode in some:
        log.append(episode)
    same(some, log.pending())
    same(some, EpisodeLog(tmp_path).pending())
    assert names(tmp_path) == [f"{n:08d}.npz" for n in range(12)]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from(["mine", "another's", "learn"]), max_size=12))
def test_every_episode_is_learned_from_once(tmp_path_factory, deeds):
    run_dir = tmp_path_factory.mktemp("run")
    mine, another, stock = EpisodeLog(run_dir), EpisodeLog(run_dir), iter(episodes(12))
    given_out, learned, waiting = [], [], []
    for deed in deeds:
        if deed == "learn":  # as the loop does: read, learn, and say so
            pending = mine.pending()
            same(waiting, pending)
            learned, waiting = learned + pending, []
            before = mine.taken
            mine.start(after=mine.read)
            mine.forget(before)
        else:
            given_out.append(next(stock))
            waiting.append(given_out[-1])
            (mine if deed == "mine" else another).append(given_out[-1])
    same(given_out, learned + mine.pending())


def test_an_episode_during_improvement_waits_for_the_next(tmp_path):
    log, (first, second) = EpisodeLog(tmp_path), episodes(2)
    log.append(first)
    same([first], log.pending())
    EpisodeLog(tmp_path).append(second)
    log.start(after=log.read)
    same([second], log.pending())


def test_two_programs_may_append_at_once(run_dir):
    code = """
import sys
import numpy as np
import metrpo
for i in range(25):
    at = np.full((2, 4), 100 * int(sys.argv[2]) + i)
    metrpo.append_episode(sys.argv[1], at, [[0.0, 0.5]], [1.0], False)
assert "jax" not in sys.modules, "a robot needs NumPy only"
"""
    writers = [subprocess.Popen([sys.executable, "-c", code, str(run_dir), str(n)]) for n in range(3)]
    assert [w.wait() for w in writers] == [0, 0, 0]
    found = [int(e.states[0, 0]) for e in EpisodeLog(run_dir).pending()]
    assert sorted(found) == [100 * n + i for n in range(3) for i in range(25)]
    for n in range(3):
        assert [x % 100 for x in found if x // 100 == n] == list(range(25)), "in the order of each writer"
    assert len(names(run_dir)) == 75, "nothing else is left"


def test_forgetting_leaves_the_later_ones(tmp_path):
    log = EpisodeLog(tmp_path)
    for episode in episodes(5):
        log.append(episode)
    log.forget(before=3)
    assert names(tmp_path) == ["00000003.npz", "00000004.npz"]
    log.append(episodes(1)[0])
    assert names(tmp_path)[-1] == "00000005.npz", "numbers are never used again"
    log.start(after=6)
    log.forget(before=6)
    assert EpisodeLog(tmp_path).append(episodes(1)[0]).name == "00000006.npz", "not even when nobody waits"


def test_a_damaged_episode_is_named(tmp_path):
    path = EpisodeLog(tmp_path).append(episodes(1)[0])
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DamagedFile, match=r"00000000\.npz is damaged"):
        EpisodeLog(tmp_path).pending()


def test_a_full_disk_is_an_error_and_leaves_no_part(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    log = EpisodeLog(tmp_path)
    log.append(episodes(1)[0])
    with monkeypatch.context() as patch:
        patch.setattr("os.link", full)
        with pytest.raises(RunDirectoryError, match=r"cannot write .*00000001\.npz: No space left"):
            log.append(episodes(1)[0])
    assert names(tmp_path) == ["00000000.npz"]


GOOD = {"states": np.zeros((4, 4)), "actions": np.zeros((3, 2)), "rewards": np.zeros(3)}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"states": np.zeros((3, 4))}, r"states: expected \[4, 4\], got shape \[3, 4\]"),
        ({"states": np.zeros((4, 5))}, r"states: expected \[4, 4\], got shape \[4, 5\]"),
        ({"actions": np.zeros((3, 1))}, r"actions: expected \[3, 2\], got shape \[3, 1\]"),
        ({"actions": np.full((3, 2), 1.5)}, r"actions: expected numbers in \[-1, 1\], got 1\.5"),
        ({"rewards": np.zeros((3, 1))}, r"rewards: expected \[3\], got shape \[3, 1\]"),
        ({"rewards": [0.0, np.nan, 0.0]}, "rewards: expected finite numbers"),
        ({"terminated": np.zeros(3, bool)}, "terminated: expected one truth value, got 3 of them"),
        ({"states": np.full((4, 4), np.inf)}, "states: expected finite numbers"),
        ({"states": np.zeros((1, 4)), "actions": np.zeros((0, 2)), "rewards": []}, "expected at least one step"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(run_dir, wrong, message):
    with pytest.raises(TaskError, match=message):
        append_episode(run_dir, **{"terminated": False, **GOOD, **wrong})
    assert EpisodeLog(run_dir).pending() == []
    append_episode(run_dir, **GOOD, terminated=True)
    assert EpisodeLog(run_dir).pending()[0].terminated is True


def test_a_directory_without_a_run_is_refused(tmp_path):
    with pytest.raises(RunDirectoryError, match="holds no policy"):
        append_episode(tmp_path, **GOOD, terminated=False)
