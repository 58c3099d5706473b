"""The dataset: whole episodes, 2:1, oldest out first."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import random_episode, random_transitions
from metrpo.config import CollectConfig
from metrpo.history import History
from metrpo.types import Episode
from metrpo.world import dataset as datasets

CONFIG = CollectConfig()


def numbered_episodes(lengths, first=0):
    """Episodes whose every state begins with [episode, step], and whose actions hold the same."""
    episodes = []
    for number, length in enumerate(lengths, first):
        steps = np.arange(length + 1)
        states = np.stack([np.full(length + 1, number), steps, 0.5 * steps**2], axis=1).astype(np.float32)
        actions = states[:-1, :2]
        episodes.append(Episode(states, actions, np.zeros(length, np.float32), False))
    return episodes


def split_of(dataset):
    """The episodes in either set, as {number: steps in order}."""
    out = []
    for t in (dataset.train, dataset.validation):
        numbers = t.states[:, 0].astype(int)
        out.append({n: t.states[numbers == n, 1].astype(int).tolist() for n in dict.fromkeys(numbers.tolist())})
    return out


@given(st.lists(st.integers(1, 6), min_size=2, max_size=30), st.integers(0, 2**31 - 1), st.floats(0.05, 0.95))
@settings(max_examples=60, deadline=None)
def test_whole_episodes_are_split_by_the_share(lengths, seed, fraction):
    config = CollectConfig(validation_fraction=fraction)
    rng = np.random.default_rng(seed)
    dataset = datasets.add(datasets.empty(3, 2), numbered_episodes(lengths), config, rng)
    train, validation = split_of(dataset)
    assert not train.keys() & validation.keys()
    for number, steps in (train | validation).items():
        assert steps == list(range(lengths[number]))
    assert len(train) + len(validation) == len(lengths)
    assert len(train) >= 1
    assert len(validation) >= 1
    assert abs(len(validation) - fraction * len(lengths)) <= 1
    assert dataset.train.size == len(dataset.train.states) == sum(lengths[n] for n in train)
    assert dataset.validation.size == sum(lengths[n] for n in validation)


def test_the_default_split_is_two_to_one():
    dataset = datasets.add(datasets.empty(3, 2), numbered_episodes([10] * 15), CONFIG, np.random.default_rng(0))
    assert (dataset.train.size, dataset.validation.size) == (100, 50)


@pytest.mark.parametrize(
    ("fraction", "count", "held_out"), [(0.5, 12, 6), (0.75, 12, 9), (0.99, 12, 11), (0.01, 12, 1)]
)
def test_the_share_is_that_of_the_episodes_but_for_one_on_either_side(fraction, count, held_out):
    config = CollectConfig(validation_fraction=fraction)
    dataset = datasets.add(datasets.empty(3, 2), numbered_episodes([2] * count), config, np.random.default_rng(0))
    assert [len(episodes) for episodes in split_of(dataset)] == [count - held_out, held_out]


def test_an_empty_dataset_has_a_column_for_each_thing_to_be_predicted():
    for learned in (0, 1, 2):
        nothing = datasets.empty(3, 2, 3 + learned)
        for t in (nothing.train, nothing.validation):
            assert [x.shape for x in t[:3]] == [(0, 3), (0, 2), (0, 3 + learned)]
            assert t.size == 0


def test_which_episodes_are_held_out_is_drawn():
    drawn = set()
    for seed in range(30):
        dataset = datasets.add(datasets.empty(3, 2), numbered_episodes([2] * 6), CONFIG, np.random.default_rng(seed))
        drawn |= split_of(dataset)[1].keys()
    assert drawn == set(range(6))


def test_deltas_are_exact_differences_and_rows_belong_together():
    rng = np.random.default_rng(0)
    episodes = [random_episode(rng, n) for n in (3, 5, 4)]
    # A far position that moves a little: what is stored is the difference of the stored states, to the last bit.
    episodes.append(episodes[0]._replace(states=(1000 + 0.001 * episodes[0].states).astype(np.float32)))
    dataset = datasets.add(datasets.empty(4, 2), episodes, CONFIG, np.random.default_rng(1))
    rows = {}
    for e in episodes:
        for s, a, s2 in zip(e.states[:-1], e.actions, e.states[1:], strict=True):
            rows[s.tobytes()] = (a, s2.astype(np.float64) - s.astype(np.float64))
    for t in (dataset.train, dataset.validation):
        for s, a, delta in zip(t.states, t.actions, t.deltas, strict=True):
            np.testing.assert_array_equal(a, rows[s.tobytes()][0])
            np.testing.assert_array_equal(delta, rows[s.tobytes()][1].astype(np.float32))
        assert {x.dtype for x in t[:3]} == {np.dtype(np.float32)}


@given(st.integers(1, 12), st.integers(1, 12), st.booleans())
@settings(max_examples=60, deadline=None)
def test_pieces_put_together_are_the_episode(length, longest, terminated):
    (episode,) = numbered_episodes([length])
    episode = episode._replace(rewards=np.arange(length, dtype=np.float32), terminated=terminated)
    parts = datasets.pieces(episode, longest)
    assert [len(p.rewards) for p in parts[:-1]] == [longest] * (len(parts) - 1)
    assert 1 <= len(parts[-1].rewards) <= longest
    for p in parts:
        assert len(p.states) == len(p.actions) + 1 == len(p.rewards) + 1
    for name in ("states", "actions", "rewards"):
        starts = np.concatenate([getattr(p, name)[: len(p.rewards)] for p in parts])
        np.testing.assert_array_equal(starts, getattr(episode, name)[:length])
    for one, following in pairwise(parts):
        np.testing.assert_array_equal(one.states[-1], following.states[0])
    np.testing.assert_array_equal(parts[-1].states[-1], episode.states[-1])
    assert [p.terminated for p in parts] == [False] * (len(parts) - 1) + [terminated]


def test_pieces_are_what_is_split_and_only_whole_episodes_are_started_from():
    config = CollectConfig(validation_fraction=0.5, piece=4)
    dataset = datasets.add(datasets.empty(3, 2), numbered_episodes([10, 8]), config, np.random.default_rng(0))
    train, validation = split_of(dataset)
    assert sum(map(len, validation.values())) in (6, 8), "two of five pieces"
    steps = sorted((n, step) for split in (train, validation) for n, found in split.items() for step in found)
    assert steps == [(0, i) for i in range(10)] + [(1, i) for i in range(8)]
    np.testing.assert_array_equal(dataset.starts[:, :2], [[0, 0], [1, 0]])
    assert set(train) & set(validation), "an episode has pieces on either side"


def test_no_transition_leads_from_one_episode_into_the_next():
    dataset = datasets.add(datasets.empty(3, 2), numbered_episodes([4, 3, 5]), CONFIG, np.random.default_rng(0))
    for t in (dataset.train, dataset.validation):
        assert np.all(t.deltas[:, 0] == 0), "the number of the episode never changes"
        assert np.all(t.deltas[:, 1] == 1), "the step always advances by one"


def test_the_oldest_go_first():
    config = CollectConfig(max_train=25, max_validation=12)
    dataset, rng = datasets.empty(3, 2), np.random.default_rng(0)
    history = [[], []]
    for round_ in range(4):
        before = [set(s) for s in split_of(dataset)]
        dataset = datasets.add(dataset, numbered_episodes([5] * 3, first=3 * round_), config, rng)
        for i, (now, old) in enumerate(zip(split_of(dataset), before, strict=True)):
            history[i] += [(n, s) for n in now if n not in old for s in range(5)]
        assert dataset.train.size == min(10 * (round_ + 1), 25)
        assert dataset.validation.size == min(5 * (round_ + 1), 12)
    for t, rows in zip((dataset.train, dataset.validation), history, strict=True):
        assert [tuple(r) for r in t.states[:, :2].astype(int).tolist()] == rows[-t.size :]
        np.testing.assert_array_equal(t.actions, t.states[:, :2])
        np.testing.assert_array_equal(t.deltas[:, 2], t.states[:, 1] + 0.5)


def test_all_first_states_are_kept_as_starts_in_order():
    dataset, rng = datasets.empty(3, 2), np.random.default_rng(0)
    for first in (0, 4):
        dataset = datasets.add(dataset, numbered_episodes([3, 2, 2, 1], first), CollectConfig(max_train=1), rng)
    np.testing.assert_array_equal(dataset.starts, [[n, 0, 0] for n in range(8)])


def test_a_single_first_episode_serves_for_both_and_a_single_later_one_trains():
    rng = np.random.default_rng(0)
    dataset = datasets.add(datasets.empty(3, 2), numbered_episodes([4]), CONFIG, rng)
    assert split_of(dataset) == [{0: [0, 1, 2, 3]}, {0: [0, 1, 2, 3]}]
    dataset = datasets.add(dataset, numbered_episodes([2], first=1), CONFIG, rng)
    assert split_of(dataset) == [{0: [0, 1, 2, 3], 1: [0, 1]}, {0: [0, 1, 2, 3]}]


def test_add_leaves_the_old_dataset_alone():
    rng = np.random.default_rng(0)
    old = datasets.add(datasets.empty(3, 2), numbered_episodes([4, 4, 4]), CONFIG, rng)
    copies = [np.copy(x) for x in (*old.train, *old.validation, old.starts)]
    datasets.add(old, numbered_episodes([4, 4, 4], first=3), CONFIG, rng)
    for now, before in zip((*old.train, *old.validation, old.starts), copies, strict=True):
        np.testing.assert_array_equal(now, before)


@pytest.mark.parametrize("size", [0, 1, 7, 10])
def test_capacity_pads_with_rows_that_the_size_excludes(size):
    small = random_transitions(np.random.default_rng(0), 10)._replace(size=size)
    small = small._replace(**{name: getattr(small, name)[:size] for name in ("states", "actions", "deltas")})
    padded = datasets.with_capacity(small, 10)
    assert int(padded.size) == size
    for now, before in zip(padded[:3], small[:3], strict=True):
        assert now.shape == (10, before.shape[1])
        assert now.dtype == np.float32
        np.testing.assert_array_equal(now[:size], before)
        assert not np.any(now[size:])


@pytest.mark.parametrize(
    ("size", "most", "rows"), [(0, 99, 5), (5, 99, 5), (6, 99, 10), (11, 99, 20), (6, 7, 7), (5, 3, 3)]
)
def test_room_for_little_is_made_at_once_and_then_doubled(monkeypatch, size, most, rows):
    monkeypatch.setattr(datasets, "ROOM", 5 * 4 * (4 + 2 + 4) + 39)  # bytes of five transitions, and not of six
    small = random_transitions(np.random.default_rng(0), min(size, most))
    assert len(datasets.with_capacity(small, most).states) == rows


def test_a_transition_wider_than_the_room_has_a_row_of_its_own(monkeypatch):
    monkeypatch.setattr(datasets, "ROOM", 1)
    assert len(datasets.with_capacity(random_transitions(np.random.default_rng(0), 1), 99).states) == 1


def test_there_is_room_for_what_the_widest_robot_gives_and_for_no_gibibyte():
    assert 200_000 * 4 * (348 + 17 + 348) <= datasets.ROOM < 1 << 30


def test_states_far_from_zero_are_counted_from_where_the_first_data_lie():
    rng = np.random.default_rng(0)
    offset = np.array([1e8, 50.0, -3000.0])

    def episodes(around):
        plain = [random_episode(rng, 6, state_size=3) for _ in range(4)]
        return [e._replace(states=around + rng.normal(size=(7, 3))) for e in plain]

    first, second = episodes(offset), episodes(2 * offset)
    dataset = datasets.add(datasets.empty(3, 2), first, CONFIG, np.random.default_rng(1))
    mean = np.concatenate([e.states for e in first]).mean(axis=0)
    np.testing.assert_allclose(dataset.origin, [mean[0], 0, mean[2]], rtol=1e-12)
    for episode in first:
        near = episode.states - dataset.origin
        near[:, 1] = near[:, 1].astype(np.float32)  # what has no origin is rounded before it is subtracted
        kept = [t for t in (dataset.train, dataset.validation) if (t.actions == episode.actions[0]).all(axis=1).any()]
        at = int(np.argmax((kept[0].actions == episode.actions[0]).all(axis=1)))
        np.testing.assert_array_equal(kept[0].states[at : at + 6], near[:-1].astype(np.float32))
        np.testing.assert_array_equal(kept[0].deltas[at : at + 6], np.diff(near, axis=0).astype(np.float32))
    later = datasets.add(dataset, second, CONFIG, np.random.default_rng(1))
    np.testing.assert_array_equal(later.origin, dataset.origin)


def test_what_a_history_carries_over_is_the_same_number_in_the_next_row_however_far_from_zero():
    """A copy that had a mean of its own for its origin would jump as it is shifted."""
    layout, rng = History(3, 2, 1), np.random.default_rng(0)
    observed = np.array([1e8, 0.0]) + np.cumsum(rng.normal(size=(31, 2)), axis=0)
    actions = rng.uniform(0.999, 1, (30, 1)).astype(
        np.float32
    )  # far from 0 by themselves, and never counted from there
    episode = Episode(layout.along(observed, actions), actions, np.zeros(30, np.float32), False)
    nothing = datasets.empty(layout.state_size, 1, 2)
    rows = datasets.add(nothing, [episode], CONFIG, rng, carried=layout.carried)
    assert rows.origin[0] == rows.origin[2] == rows.origin[4] == pytest.approx(observed[:, 0].mean(), rel=1e-7)
    assert not rows.origin[[1, 3, 5, 6, 7]].any()
    states, deltas = rows.train.states, rows.train.deltas
    assert deltas.shape == (30, 2)
    now = np.concatenate([states, rows.train.actions], axis=1)
    np.testing.assert_array_equal(states[1:, 2:], now[:-1, list(layout.carried)])
    np.testing.assert_allclose(states[1:, :2], states[:-1, :2] + deltas[:-1], atol=1e-5)


def test_no_episodes_add_nothing():
    dataset = datasets.add(datasets.empty(3, 2), [], CONFIG, np.random.default_rng(0))
    assert (dataset.train.size, dataset.validation.size, len(dataset.starts)) == (0, 0, 0)
    assert not dataset.origin.any()


def test_without_an_origin_states_are_those_of_float32():
    rng = np.random.default_rng(0)
    episode = random_episode(rng, 6)._replace(states=50 + rng.normal(size=(7, 4)))
    rows = datasets.append(datasets.empty(4, 2).train, [episode], 99)
    rounded = episode.states.astype(np.float32)
    np.testing.assert_array_equal(rows.states, rounded[:-1])
    np.testing.assert_array_equal(rows.deltas, np.diff(rounded, axis=0))
