"""A checkpoint comes back exactly as it was, or not at all."""

import os
import re
import zipfile
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from metrpo.errors import RunDirectoryError
from metrpo.run import files
from metrpo.run.checkpoint import load_state, save_state
from metrpo.run.files import DamagedFile, atomic_write, read_arrays, write_arrays


class Inner(NamedTuple):
    layers: tuple
    scale: Any


class State(NamedTuple):
    iteration: int
    rate: float
    done: bool
    inner: Inner
    data: Any
    nothing: None = None


def a_state(n: int = 3) -> State:
    layers = ((np.arange(6, dtype=np.float32).reshape(2, 3), np.zeros(3, np.float32)),)
    return State(7, 0.1, True, Inner(layers, jnp.float32(2.5)), np.arange(n, dtype=np.int64))


def assert_equal(ours: Any, theirs: Any) -> None:
    assert type(ours) is type(theirs)
    if isinstance(ours, tuple):
        assert len(ours) == len(theirs)
        for a, b in zip(ours, theirs, strict=True):
            assert_equal(a, b)
    elif hasattr(ours, "dtype"):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
        assert np.asarray(ours).tobytes() == np.asarray(theirs).tobytes()
    else:
        assert ours == theirs


def test_round_trip_keeps_types_and_lets_shapes_grow(tmp_path):
    path = tmp_path / "a.npz"
    save_state(path, a_state(9), {"iteration": 7, "rows": [{"x": 0.1, "y": float("nan")}]})
    state, meta = load_state(path, a_state(3))
    assert_equal(state, a_state(9))
    assert meta["iteration"] == 7
    assert meta["rows"][0]["x"] == 0.1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz"]


numbers = st.sampled_from([np.float32, np.float64, np.int32, np.int64, np.uint32, np.bool_])
arrays = hnp.arrays(numbers, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))


@given(st.dictionaries(st.text("abz_.[]", min_size=1, max_size=5), arrays, max_size=4), st.integers(-(2**40), 2**40))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip_of_any_arrays(tmp_path, tree, number):
    path = tmp_path / "b.npz"
    state = {"tree": tree, "number": number}
    save_state(path, state, {})
    loaded, _ = load_state(path, state)
    assert loaded["number"] == number
    assert loaded["tree"].keys() == tree.keys()
    for name, array in tree.items():
        assert_equal(loaded["tree"][name], array)


def test_the_same_state_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        save_state(tmp_path / f"{name}.npz", a_state(), {"iteration": 1})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_numpy_alone_reads_it_without_pickle(tmp_path):
    save_state(tmp_path / "a.npz", a_state(), {})
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert ".inner.layers[0][0]" in archive.files
        assert archive[".iteration"] == 7


def test_truncated_at_any_length_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    save_state(path, a_state(), {})
    whole = path.read_bytes()
    for length in [0, 1, 22, 63, 64, 65, *range(100, len(whole), 97), len(whole) - 65, len(whole) - 64, len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(DamagedFile, match=r"a\.npz is damaged"):
            load_state(path, a_state())


@given(st.data())
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_one_flipped_bit_anywhere_is_refused(tmp_path, data):
    path = tmp_path / "a.npz"
    save_state(path, a_state(), {})
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    with pytest.raises(DamagedFile):
        load_state(path, a_state())


def test_an_archive_written_by_other_hands_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    save_state(path, a_state(), {})
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
        comment = old.comment
    with zipfile.ZipFile(path, "w") as new:
        for name, content in members.items():
            new.writestr(name, content)
        new.comment = comment
    with pytest.raises(DamagedFile):
        load_state(path, a_state())


@pytest.mark.parametrize(
    ("template", "what"),
    [
        (a_state()._replace(nothing=3), r"lacks \.nothing"),
        (a_state()._replace(data=None), r"unknown \.data"),
        (a_state()._replace(data=np.zeros(3, np.float32)), r"\.data as int64 of rank 1 instead of float32 of rank 1"),
        (a_state()._replace(data=np.zeros((3, 1), np.int64)), r"rank 1 instead of int64 of rank 2"),
    ],
)
def test_another_structure_is_refused(tmp_path, template, what):
    path = tmp_path / "a.npz"
    save_state(path, a_state(), {})
    with pytest.raises(RunDirectoryError, match=what) as error:
        load_state(path, template)
    assert not isinstance(error.value, DamagedFile)


@pytest.mark.parametrize(
    ("leaf", "what"),
    [
        (np.zeros((9, 4), np.float32), r"has \['x'\] of shape \[2, 3\] instead of \['n', 4\]"),
        (np.zeros((2, 2), np.float32), r"has \['x'\] of shape \[2, 3\] instead of \['n', 2\]"),
        (jnp.zeros((9, 3)), r"has \['x'\] of shape \[2, 3\] instead of \[9, 3\]"),
        (jnp.zeros((2, 4)), r"has \['x'\] of shape \[2, 3\] instead of \[2, 4\]"),
    ],
)
def test_only_numpy_arrays_may_have_another_number_of_rows(tmp_path, leaf, what):
    path = tmp_path / "a.npz"
    save_state(path, {"x": np.ones((2, 3), np.float32)}, {})
    loaded, _ = load_state(path, {"x": np.zeros((9, 3), np.float32)})
    np.testing.assert_array_equal(loaded["x"], np.ones((2, 3)))
    with pytest.raises(RunDirectoryError, match=what):
        load_state(path, {"x": leaf})


@pytest.mark.parametrize(("wrong", "more"), [(1, ""), (3, ""), (4, " and 1 more"), (7, " and 4 more")])
def test_three_differences_are_named_and_the_others_counted(tmp_path, wrong, more):
    path = tmp_path / "a.npz"
    saved = {f"x{i}": np.zeros(2, np.float32) for i in range(8)}
    save_state(path, saved, {})
    template = {name: x.astype(np.float64) if i < wrong else x for i, (name, x) in enumerate(saved.items())}
    with pytest.raises(RunDirectoryError, match="does not fit this run: it has") as error:
        load_state(path, template)
    named = [f"it has ['x{i}'] as float32 of rank 1 instead of float64 of rank 1" for i in range(min(wrong, 3))]
    assert f" {'; '.join(named)}{more}; choose another directory (--run-dir)" in str(error.value)
    assert "use that version" not in str(error.value), "this version wrote it"


def test_a_task_of_another_size_is_no_other_version(tmp_path):
    path = tmp_path / "a.npz"
    save_state(path, {"x": np.zeros((2, 3), np.float32), "y": jnp.zeros(4)}, {})
    with pytest.raises(RunDirectoryError, match="size of the task's observations or actions has changed") as error:
        load_state(path, {"x": np.zeros((2, 5), np.float32), "y": jnp.zeros(4)})
    assert "['x'] of shape [2, 3] instead of ['n', 5]" in str(error.value)
    assert not re.search("use that version|expected 2 arrays", str(error.value))


@pytest.mark.parametrize("of", ["7.0", "0.0.1"])
def test_another_version_is_named_where_it_wrote_other_arrays(tmp_path, monkeypatch, of):
    path = tmp_path / "a.npz"
    with monkeypatch.context() as patch:
        patch.setattr(files, "metrpo_version", lambda: of)
        save_state(path, {"x": np.zeros(2)}, {})
    with pytest.raises(
        RunDirectoryError, match=rf"lacks \['y'\]; it has unknown .* by metrpo '{of}': use that version"
    ):
        load_state(path, {"y": np.zeros(2)})


@pytest.mark.parametrize(
    "saved",
    [
        {"x": np.zeros((2, 3), np.float32), "y": np.zeros(2, np.float32), "more": np.zeros(2)},
        {"x": np.zeros((2, 3), np.float32), "y": np.zeros(2)},
    ],
)
def test_what_is_not_only_of_another_size_is_not_blamed_on_the_task(tmp_path, saved):
    path = tmp_path / "a.npz"
    save_state(path, saved, {})
    with pytest.raises(RunDirectoryError, match=r"\['x'\] of shape \[2, 3\]") as error:
        load_state(path, {"x": np.zeros((2, 5), np.float32), "y": np.zeros(2, np.float32)})
    assert "The size of the task" not in str(error.value)


def test_another_format_is_refused_by_name(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    monkeypatch.setattr(files, "FORMAT", 99)
    save_state(path, a_state(), {})
    monkeypatch.undo()
    with pytest.raises(RunDirectoryError, match=r"has format 99 .* reads format 1"):
        load_state(path, a_state())


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RunDirectoryError, match=r"cannot read .*none\.npz"):
        read_arrays(tmp_path / "none.npz")


def test_objects_are_never_pickled(tmp_path):
    with pytest.raises(TypeError, match="dtype object"):
        write_arrays(tmp_path / "a.npz", {"x": np.array([{}], dtype=object)}, {})
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, step):
    path = tmp_path / "a.txt"
    atomic_write(path, "old")

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(RunDirectoryError, match=r"cannot write .*a\.txt: No space left on device"):
        atomic_write(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_nothing_is_renamed_before_it_is_on_disk(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, name=name, real=real: (calls.append(name), real(*a))[1])
    atomic_write(tmp_path / "a.txt", "text")
    assert calls == ["fsync", "replace", "fsync"]
