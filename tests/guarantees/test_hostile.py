"""Nothing that is loaded runs code, crashes, takes memory without bound, or comes in as garbage.

Files are made hostile with a digest that is right, so that what lies behind the checksum is reached too.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

import probe
from helpers import random_episode, random_policy
from metrpo import config as configs
from metrpo import safe_load, training
from metrpo.config import Config
from metrpo.errors import ConfigError, MetrpoError, RunDirectoryError, TaskError
from metrpo.history import History
from metrpo.presets import override
from metrpo.run import lock, newest_checkpoint
from metrpo.run.checkpoint import load_state
from metrpo.run.directory import RunDirectory, stored_config
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import read_arrays, write_arrays
from metrpo.run.loaded_policy import LoadedPolicy
from metrpo.run.metrics import read_metrics, to_csv
from metrpo.run.policy_export import export
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.world import offline_data

CONFIG = override(
    Config("Probe"),
    {"ensemble.members": 2, "ensemble.hidden": (4,), "policy.hidden": (4,), "collect.steps": 20, "deterministic": True},
)
META = "meta.json.npy"


# ---------------------------------------------------------------- files and what reads them


class Loader(NamedTuple):
    """A way for a file into metrpo."""

    name: str
    """Of the file, in its directory."""
    load: Callable[[Path], Any]
    """Reads the file at this path."""
    require_sound: Callable[[Any], None]
    """Fails for what no file may become."""
    signed: bool = False
    """Whether a digest stands at its end."""


def _load_checkpoint(path):
    state, meta = load_state(path, _load_checkpoint.template)
    newest_checkpoint.require_consistent(path, state, meta)
    return state, newest_checkpoint.config_of(path, meta)


def _load_episode(path):
    log = EpisodeLog(path.parent.parent)
    log.layout = History(1, 2, 2)
    return log.pending()


def _sound_state(found):
    for mine, theirs in zip(jax.tree.leaves(found[0]), jax.tree.leaves(_load_checkpoint.template), strict=True):
        assert type(mine) is type(theirs) or isinstance(mine, jax.Array)
        assert np.shape(mine)[1:] == np.shape(theirs)[1:]
        assert np.isfinite(mine).all()
    assert type(found[1]) is Config


def _sound_policy(policy: LoadedPolicy):
    assert all(np.isfinite(array).all() for layer in policy.layers for array in layer)
    with np.errstate(all="ignore"):
        assert policy(np.zeros(policy.info.observation_size)).shape == (policy.info.action_size,)


def _sound_episodes(episodes):
    for episode in episodes:
        steps = len(episode.rewards)
        assert (episode.states.shape, episode.actions.shape) == ((steps + 1, 2), (steps, 2))
        assert steps
        assert type(episode.terminated) is bool
        assert episode.states.dtype in (np.float32, np.float64)  # files from before states were float64
        assert episode.actions.dtype == episode.rewards.dtype == np.float32
        assert all(np.isfinite(array).all() for array in episode[:3])


def _sound_config(config):
    assert configs.from_json(configs.to_json(config)) == config


def _sound_rows(rows):
    assert all(value is None or type(value) in (int, float) for row in rows for value in row.values())


LOADERS = {
    "checkpoint": Loader("iteration-00000.npz", _load_checkpoint, _sound_state, signed=True),
    "policy": Loader("policy.npz", load_policy, _sound_policy, signed=True),
    "episode": Loader("00000000.npz", _load_episode, _sound_episodes, signed=True),
    "logged data": Loader("log.npz", lambda path: offline_data.load(path, probe.PROBE), _sound_episodes),
    "config": Loader("config.json", lambda path: stored_config(path.parent), _sound_config),
    "run": Loader("run.json", lock._check_or_describe, lambda none: None),
    "metrics": Loader("metrics.csv", read_metrics, _sound_rows),
}
ARCHIVES = ("checkpoint", "policy", "episode", "logged data")
SIGNED = ("checkpoint", "policy", "episode")


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """One sound file for every loader, by its name: bytes."""
    place = tmp_path_factory.mktemp("sound")
    with probe.registered():
        _load_checkpoint.template = training.init(CONFIG)
        with RunDirectory(place / "run", CONFIG) as run:
            run.load(_load_checkpoint.template)
            run.begin(_load_checkpoint.template)
            run.episodes.append(random_episode(np.random.default_rng(0), 5, 2, 2))
    save_policy(place, random_policy(0, 2, 2, (4,)), "Probe", Learned(3, 60, -1.5))
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(7, 2)), rng.uniform(-1, 1, size=(6, 2))
    arrays = {"states": states[:-1], "next_states": states[1:], "actions": actions, "rewards": np.arange(6.0)}
    np.savez_compressed(place / "log.npz", **arrays, terminated=np.zeros(6, bool))
    rows = [{"iteration": n, "real_steps": 20 * n, "gap": float("nan"), "wall_seconds": None} for n in range(1, 4)]
    (place / "metrics.csv").write_text(to_csv(rows))
    found = {
        "checkpoint": place / "run" / "checkpoints" / "iteration-00000.npz",
        "policy": place / "policy.npz",
        "episode": place / "run" / "episodes" / "00000000.npz",
        "logged data": place / "log.npz",
        "config": place / "run" / "config.json",
        "run": place / "run" / "run.json",
        "metrics": place / "metrics.csv",
    }
    return {name: path.read_bytes() for name, path in found.items()}


@pytest.fixture
def there(tmp_path):
    """Where a loader looks for its file."""
    (tmp_path / "episodes").mkdir()
    return lambda kind: tmp_path / ("episodes" if kind == "episode" else "") / LOADERS[kind].name


def sign(content):
    return content[:-64] + hashlib.sha256(content[:-64]).hexdigest().encode()


def members_of(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members, kind, compress=False):
    """The members as an archive of this kind, whatever they are; `members` may be pairs."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for name, content in members.items() if isinstance(members, dict) else members:
            archive.writestr(zipfile.ZipInfo(name), content, archive.compression)
        archive.comment = b"0" * 64 if LOADERS[kind].signed else b""
    return sign(out.getvalue()) if LOADERS[kind].signed else out.getvalue()


def npy(array, allow_pickle=False):
    out = io.BytesIO()
    np.lib.format.write_array(out, np.asanyarray(array), allow_pickle=allow_pickle)
    return out.getvalue()


def header(text, data=b""):
    line = text.encode() + b" " * (117 - len(text)) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(line)) + line + data


def refused(kind, path, match=None):
    """Loads the file, which must be refused by its name; returns the message."""
    with pytest.raises(MetrpoError, match=match) as error:
        LOADERS[kind].load(path)
    assert path.name in str(error.value)
    assert len(str(error.value)) < 3000
    return str(error.value)


# ---------------------------------------------------------------- nothing runs


class Payload:
    """Unpickled, it leaves a file behind."""

    def __init__(self, sentinel):
        self.sentinel = sentinel

    def __reduce__(self):
        return (open, (str(self.sentinel), "w"))


_HEARD: list[str] | None = None


def _listen(name: str, arguments: tuple) -> None:
    if _HEARD is not None and name in (
        *(
            "pickle.find_class",
            "compile",
            "os.system",
            "os.exec",
            "os.posix_spawn",
            "subprocess.Popen",
            "ctypes.dlopen",
        ),
        *("socket.connect", "os.remove", "os.rename", "shutil.rmtree"),
    ):
        _HEARD.append(f"{name} {arguments!r}"[:200])


sys.addaudithook(_listen)  # it cannot be taken away again, so that it does nothing unless asked


class watched:
    """Fails when the interpreter was asked to run, unpickle, compile or delete anything within the block."""

    def __enter__(self):
        global _HEARD
        _HEARD = []

    def __exit__(self, *_):
        global _HEARD
        heard, _HEARD = _HEARD, None
        assert heard == []


def test_the_watch_hears_what_it_is_for(tmp_path):
    with pytest.raises(AssertionError, match=r"pickle\.find_class"), watched():
        pickle.loads(pickle.dumps(Payload(tmp_path / "sentinel"))).close()
    with pytest.raises(AssertionError, match="compile"), watched():
        eval("1 + 1")


def pickles(sentinel):
    payload = np.array([Payload(sentinel)], dtype=object)
    raw = pickle.dumps(Payload(sentinel))
    return {
        "an array of objects": npy(payload, allow_pickle=True),
        "a pickle": raw,
        "numbers that are a pickle": header("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", raw),
        "a type that is code": header(
            f"{{'descr': __import__('os').system('touch {sentinel}'), 'fortran_order': False, 'shape': (1,), }}", raw
        ),
        "a structured type with objects": header(
            "{'descr': [('a', '<f4'), ('b', '|O')], 'fortran_order': False, 'shape': (1,), }", raw
        ),
    }


@pytest.mark.parametrize("kind", ARCHIVES)
def test_no_pickle_is_ever_loaded(kind, sound, there, tmp_path):
    path, sentinel = there(kind), tmp_path / "sentinel"
    members = members_of(sound[kind])
    for payload in pickles(sentinel).values():
        for name in members:
            path.write_bytes(archive_of({**members, name: payload}, kind))
            with watched():
                refused(kind, path)
        path.write_bytes(archive_of({**members, "extra.npy": payload}, kind))
        with watched():
            try:
                LOADERS[kind].require_sound(LOADERS[kind].load(path))
            except MetrpoError as error:
                assert path.name in str(error)  # noqa: PT017 (a log may hold arrays that nobody reads)
    path.write_bytes(pickles(sentinel)["a pickle"])
    with watched():
        refused(kind, path)
    assert not sentinel.exists()


def test_an_exported_policy_runs_nothing_of_its_weights(tmp_path, sound):
    """The module's arrays are base64 under a digest: no archive, no pickle, and damage is an ImportError."""
    (tmp_path / "policy.npz").write_bytes(sound["policy"])
    source = export(tmp_path).read_text()
    start = source.index('_layers("""\n') + len('_layers("""\n')
    end = source.index('"""', start)
    imports = re.findall(r"^ *(?:import|from) .*", source, re.MULTILINE)
    # The third is the docstring's example.
    assert imports == [
        "    from policy import act, control, reset  # or whatever this file is called",
        "import base64",
        "import hashlib",
        "import numpy as np",
    ]
    payload = base64.b64encode(pickle.dumps(Payload(tmp_path / "sentinel"))).decode()
    for bad in (payload, "", "!", source[start : end - 6], "A" * 400):
        (tmp_path / "damaged.py").write_text(source[:start] + bad + source[end:])
        ran = subprocess.run(
            [sys.executable, "-I", tmp_path / "damaged.py"], capture_output=True, text=True, check=False
        )
        assert "ImportError: the embedded weights are damaged" in ran.stderr
    assert not (tmp_path / "sentinel").exists()


def test_onnx_and_pickles_are_never_read():
    """ONNX is written only; the source calls neither its loader nor pickle, NumPy's loader, eval or exec."""
    forbidden = re.compile(
        r"\bonnx\.load|\bpickle\.\w|import pickle|np\.load\(|\beval\(|\bexec\(|marshal|shelve|joblib"
    )
    source = Path(safe_load.__file__).parent
    found = [
        f"{path.relative_to(source)}: {line.strip()}"
        for path in sorted(source.rglob("*.py"))
        if "bench" not in path.parts
        for line in path.read_text().splitlines()
        if forbidden.search(line)
    ]
    assert found == []


# ---------------------------------------------------------------- archives that are not what they claim


def in_central(content, name, offset, value):
    """The archive with a field of a member's entry in the list of members changed."""
    at = content.rindex(b"PK\x01\x02", 0, content.rindex(name.encode()))
    return content[: at + offset] + value + content[at + offset + len(value) :]


def everywhere(content, offsets, value):
    """Changes a field in every member's local header and entry: offsets in (local, central)."""
    bad = bytearray(content)
    for signature, offset in zip((b"PK\x03\x04", b"PK\x01\x02"), offsets, strict=True):
        for match in re.finditer(re.escape(signature), content):
            bad[match.start() + offset : match.start() + offset + len(value)] = value
    return bytes(bad)


def huge(shape="(1000000000, 1000)"):
    return header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}", bytes(48))


def bombs(members, kind):
    """Archives that are to be refused: what is wrong, and the bytes."""
    first = next(name for name in members if name != META)
    good = archive_of(members, kind)
    re_signed = sign if LOADERS[kind].signed else bytes
    with_one = lambda content: archive_of({**members, first: content}, kind)  # noqa: E731
    return {
        "a shape beyond the bytes": with_one(huge()),
        "a shape beyond any memory": with_one(huge("(99999999999999999999, 99999999999999999999)")),
        "a shape whose product overflows": with_one(huge("(4294967296, 4294967296)")),
        "a negative shape": with_one(huge("(-1,)")),
        "a shape of many axes": with_one(huge("(" + "1, " * 40 + "12)")),
        "a shape that is too small": with_one(huge("(1,)")),
        "a header that never ends": with_one(b"\x93NUMPY\x02\x00" + b"\xff\xff\xff\x7f" + b"{" * 100),
        "a header of brackets": with_one(header("(" * 110)),
        "another version": with_one(b"\x93NUMPY\x09\x00" + members[first][8:]),
        "text": with_one(npy(np.array(["ab", "c"]))),
        "dates": with_one(npy(np.array(["2020-01-01"], "M8[D]"))),
        "a structure": with_one(npy(np.zeros(2, [("a", "<f4")]))),
        "raw bytes": with_one(npy(np.zeros(2, "V4"))),
        "no array": with_one(b"hello"),
        "nothing": with_one(b""),
        "an absolute name": archive_of({**members, "/etc/passwd.npy": npy(0)}, kind),
        "a name above": archive_of({**members, "../../up.npy": npy(0)}, kind),
        "a name above, of Windows": archive_of({**members, "..\\up.npy": npy(0)}, kind),
        "a drive": archive_of({**members, "c:up.npy": npy(0)}, kind),
        "a program": archive_of({**members, "setup.py": b"raise SystemExit"}, kind),
        "a folder": archive_of({**members, "folder/": b""}, kind),
        "a name twice": _twice(members, first, kind),
        "encrypted": re_signed(everywhere(good, (6, 8), b"\x01\x00")),
        "another compression": re_signed(everywhere(good, (8, 10), b"\x0e\x00")),
        "a size beyond the file": re_signed(in_central(good, first, 20, struct.pack("<II", 2**31, 2**31))),
        "an offset beyond the file": re_signed(in_central(good, first, 42, struct.pack("<I", 2**31))),
        "the list of members elsewhere": re_signed(_end(good, 16, struct.pack("<I", 2**31))),
        "a list of members of 4 GB": re_signed(_end(good, 12, struct.pack("<I", 2**32 - 2))),
        "a list of many members": _many(kind),
        "cut within": re_signed(good[:200] + good[300:]),
        "arrays that expand": _expanding(members, first, kind),
    }


def _twice(members, first, kind):
    with pytest.warns(UserWarning, match="Duplicate name"):
        return archive_of([*members.items(), (first, members[first])], kind)


def _end(content, offset, value):
    at = content.rindex(b"PK\x05\x06")
    return content[: at + offset] + value + content[at + offset + len(value) :]


def _many(kind):
    """A list of 100,000 members, all the same one, which no file of ours has."""
    entry = archive_of({"a.npy": b""}, kind)
    local, central = entry.index(b"PK\x03\x04"), entry.index(b"PK\x01\x02")
    one = entry[central : entry.index(b"PK\x05\x06")]
    listed = b"".join(one.replace(b"a.npy", b"%05x" % n) for n in range(100_000))
    end = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, 65535, 65535, len(listed), central - local, 64)
    out = entry[local:central] + listed + end + b"0" * 64
    return sign(out)


def _expanding(members, first, kind):
    """A thousand zeros for every byte, in a stream of 2 GB; the header agrees with it."""
    size = 2 * safe_load.LARGEST_EXPANSION
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            if name != first:
                archive.writestr(name, content)
        info = zipfile.ZipInfo(first)
        info.compress_type = zipfile.ZIP_DEFLATED
        with archive.open(info, "w", force_zip64=True) as member:
            member.write(header(f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({size},), }}"))
            member.write(bytes(1 << 20))  # the rest is claimed only
        info.file_size = size + 128
        archive.comment = b"0" * 64 if LOADERS[kind].signed else b""
    return sign(out.getvalue()) if LOADERS[kind].signed else out.getvalue()


BOMBS = list(bombs({"a.npy": npy(np.zeros(12, np.float32)), META: npy(np.zeros(2, np.uint8))}, "policy"))


REASONS = {
    "a shape beyond the bytes": r"claims the shape \[1000000000, 1000\] of float32, which does not fit its 48 bytes",
    "a shape whose product overflows": "claims the shape",
    "a shape that is too small": "claims the shape",
    "an absolute name": "is no name of an array",
    "a name above": "is no name of an array",
    "a name above, of Windows": "is no name of an array",
    "a drive": "is no name of an array",
    "a program": "is no name of an array",
    "a name twice": "is there twice",
    "encrypted": "is encrypted",
    "another compression": "compressed in a way",
    "text": "expected numbers of shape .* got <U2",
    "a list of many members": "list of members is too long",
    "arrays that expand": "expand to|compressed in a way",
}


class bounded:
    """Fails when the block takes more than `most` bytes of memory at once, or more than some seconds."""

    def __init__(self, most=64 << 20, seconds=30.0):
        self.most, self.seconds = most, seconds

    def __enter__(self):
        self.began = time.monotonic()
        tracemalloc.start()

    def __exit__(self, *_):
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < self.most, f"{peak:,} bytes"
        assert time.monotonic() - self.began < self.seconds


@pytest.mark.parametrize("kind", ARCHIVES)
def test_no_archive_gets_more_than_it_holds(kind, sound, there):
    path = there(kind)
    path.write_bytes(sound[kind])
    LOADERS[kind].require_sound(LOADERS[kind].load(path))
    found = bombs(members_of(sound[kind]), kind)
    assert list(found) == BOMBS
    for what, content in found.items():
        path.write_bytes(content)
        with bounded(), watched():
            refused(kind, path, REASONS.get(what))


def test_a_log_may_be_compressed_and_ours_are_not(sound, there):
    for kind in ARCHIVES:
        path = there(kind)
        path.write_bytes(archive_of(members_of(sound[kind]), kind, compress=True))
        if kind == "logged data":
            assert len(offline_data.load(path, probe.PROBE)) == 1
        else:
            refused(kind, path, "compressed in a way that is not read")


def test_a_compressed_log_expands_to_a_stated_limit(sound, there, monkeypatch):
    path = there("logged data")
    arrays = {name.removesuffix(".npy"): np.zeros((70_000, 2)) for name in members_of(sound["logged data"])}
    arrays |= {"rewards": np.zeros(70_000), "terminated": np.zeros(70_000)}
    np.savez_compressed(path, **arrays)
    assert path.stat().st_size < 50_000 < sum(a.nbytes for a in arrays.values())
    assert len(offline_data.load(path, probe.PROBE)) == 1
    monkeypatch.setattr(safe_load, "LARGEST_EXPANSION", 1 << 20)
    with bounded(8 << 20):
        refused("logged data", path, "expand to .* save it without compression")


@pytest.mark.parametrize("kind", LOADERS)
def test_what_is_no_ordinary_file_is_refused_at_once(kind, there):
    path = there(kind)
    path.mkdir()
    with bounded():
        refused(kind, path)
    path.rmdir()
    os.mkfifo(path)
    with bounded(seconds=5):
        refused(kind, path, "pipe or a device")
    path.unlink()
    path.symlink_to("/dev/zero")
    with bounded(seconds=5):
        refused(kind, path, "pipe or a device")
    path.unlink()
    if kind != "run":  # one that leads nowhere is none, and is written
        path.symlink_to(path.name)
        with bounded():
            refused(kind, path)
        path.unlink()
    with open(path, "wb") as file:
        file.truncate(20 << 30)  # takes no room on the disk
    with bounded(seconds=5):
        refused(kind, path, "expected at most")


def test_a_damaged_file_of_any_size_takes_no_memory(there):
    path = there("checkpoint")
    with open(path, "wb") as file:
        file.truncate(300 << 20)
    with bounded(8 << 20):
        refused("checkpoint", path, "is damaged")


# ---------------------------------------------------------------- numbers that may not be


def rewritten(content, place, change):
    """A sound file of ours with its arrays or meta changed, and all digests right."""
    path = place / "changed.npz"
    path.write_bytes(content)
    arrays, meta = read_arrays(path)
    change(arrays, meta)
    write_arrays(path, arrays, meta)
    return path.read_bytes()


def sets(**values):
    """Arrays of these names get these values, at their first place."""

    def change(arrays, _):
        for name, value in values.items():
            arrays[name] = np.array(arrays[name])
            arrays[name].reshape(-1)[0] = value

    return change


def replaces(**values):
    return lambda arrays, _: arrays.update(values)


def says(**values):
    return lambda _, meta: meta.update(values)


def info(**values):
    return lambda _, meta: meta["policy"].update(values)


f4 = np.float32


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("policy", sets(w0=np.nan), "expected finite weights"),
        ("policy", sets(log_std=np.inf), "expected finite weights"),
        ("policy", replaces(w0=np.zeros((2, 4))), "w0: expected float32, got float64"),
        ("policy", replaces(w0=np.zeros((4, 2), f4)), "expected weights and biases of shapes"),
        ("policy", replaces(w7=np.zeros((4, 2), f4)), "expected weights and biases of shapes"),
        ("policy", lambda arrays, _: arrays.pop("b1"), "expected weights and biases of shapes"),
        ("policy", info(hidden=[10**9]), "expected weights and biases of shapes"),
        ("policy", info(hidden=[1] * 100_000), "expected weights and biases of shapes"),
        ("policy", info(hidden="4"), "hidden: expected a list"),
        ("policy", info(hidden=[True]), "hidden: expected a list"),
        ("policy", info(observation_size=2.0), "observation_size: expected a whole number"),
        ("policy", info(action_size=-2), "action_size: expected a whole number"),
        ("policy", info(task=["x"]), "task: expected a name"),
        ("policy", info(iteration={"a": [[]]}), "iteration: expected a number"),
        ("policy", info(activation="relu"), "activation: expected 'tanh'"),
        ("policy", info(colour="red"), "expected the fields that this version knows"),
        ("policy", says(policy=None), "is no policy: it lacks task"),
        ("policy", says(policy=[1]), "is no policy: it lacks task"),
        ("episode", sets(states=np.nan), "states: expected finite numbers"),
        ("episode", sets(rewards=-np.inf), "rewards: expected finite numbers"),
        ("episode", replaces(rewards=np.zeros(5)), "rewards: expected finite numbers of float32, got float64"),
        ("episode", replaces(states=np.zeros((5, 2), f4)), r"states: expected shape \[6, 2\], got \[5, 2\]"),
        ("episode", replaces(actions=np.zeros((5, 3), f4)), r"actions: expected shape \[5, 2\], got \[5, 3\]"),
        ("episode", replaces(terminated=np.zeros(3, bool)), r"terminated: expected shape \[\], got \[3\]"),
        ("episode", replaces(terminated=f4(2)), "terminated: expected"),
        ("episode", lambda arrays, _: arrays.pop("actions"), "expected states, actions, rewards, terminated"),
        (
            "episode",
            replaces(states=np.zeros((1, 2), f4), actions=np.zeros((0, 2), f4), rewards=np.zeros(0, f4)),
            "expected shape",
        ),
        ("checkpoint", sets(**{".policy.layers[0][0]": np.nan}), "expected finite numbers"),
        ("checkpoint", sets(**{".networks[0][0]": np.inf}), "expected finite numbers"),
        (
            "checkpoint",
            replaces(**{".policy.layers[0][0]": np.zeros((3, 4), f4)}),
            r"of shape \[3, 4\] instead of \[2, 4",
        ),
        ("checkpoint", replaces(**{".dataset.starts": np.zeros((0, 3), f4)}), r"of shape \[0, 3\] instead of \['n', 2"),
        ("checkpoint", replaces(**{".iteration": np.int64(3)}), r"renamed\): expected iteration 0, got 3"),
        ("checkpoint", replaces(**{".iteration": np.float64(0)}), "instead of int64"),
        ("checkpoint", replaces(**{".real_steps": np.int64(-1)}), "expected counts"),
        ("checkpoint", says(rows=None), "expected a list of rows"),
        ("checkpoint", says(rows=[3]), "expected a list of rows"),
        ("checkpoint", says(rows=[{"iteration": 1, "real_steps": 3, "wall_seconds": 0}]), "a row for each of 0"),
        ("checkpoint", says(rows=[{"iteration": "1"}]), "expected numbers in every row"),
        ("checkpoint", says(rows=[{"gap": 1.0}]), "expected the columns iteration"),
        ("checkpoint", says(episodes=-1), "expected counts"),
        ("checkpoint", says(episodes="many"), "expected counts"),
        ("checkpoint", says(config=None), "does not fit this version"),
        ("checkpoint", says(config="{}"), "does not fit this version"),
        ("checkpoint", says(metrpo=[["x"] * 10**5], config="["), "does not fit this version"),
    ],
)
def test_a_file_signed_by_other_hands_is_held_to_what_it_must_be(kind, change, message, sound, there, tmp_path):
    path = there(kind)
    path.write_bytes(rewritten(sound[kind], tmp_path, change))
    refused(kind, path, message)


META_TEXTS = {
    "no JSON": b"hello",
    "no text": b"\xff\xfe\x00",
    "no object": b"[1]",
    "nothing": b"",
    "deep": b'{"format": 1, "a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "a number too long": b'{"format": ' + b"1" * 5000 + b"}",
    "twice": b'{"format": 2, "format": 1, "metrpo": "0"}',
    "no format": b"{}",
    "another format": b'{"format": 2}',
    "a format that is true": b'{"format": true}',
    "more after it": b'{"format": 1} {"format": 1}',
}


@pytest.mark.parametrize("what", META_TEXTS)
@pytest.mark.parametrize("kind", SIGNED)
def test_the_text_in_an_archive_is_one_object_of_this_format(kind, what, sound, there):
    path = there(kind)
    meta = npy(np.frombuffer(META_TEXTS[what], np.uint8))
    path.write_bytes(archive_of({**members_of(sound[kind]), META: meta}, kind))
    with bounded():
        refused(kind, path)


def test_the_text_in_an_archive_is_there_and_is_text(sound, there):
    for kind in SIGNED:
        path, members = there(kind), members_of(sound[kind])
        path.write_bytes(archive_of({name: content for name, content in members.items() if name != META}, kind))
        refused(kind, path, r"expected meta\.json")
        path.write_bytes(archive_of({**members, META: npy(np.zeros(3))}, kind))
        refused(kind, path, r"expected meta\.json")


# ---------------------------------------------------------------- JSON and tables


def hostile_json(good):
    text = good.decode()
    return {
        "empty": b"",
        "cut": good[: len(good) // 2],
        "zeros": bytes(len(good)),
        "deep lists": b"[" * 1_000_000,
        "deep objects": b'{"a":' * 100_000,
        "deep and closed": b"[" * 900 + b"]" * 900,
        "deep within": text.replace("1", "[" * 900 + "]" * 900, 1).encode(),
        "a long number": text.replace("1", "1" * 5000, 1).encode(),
        "a number beyond 64 bits": text.replace("1", "1" * 400, 1).encode(),
        "NaN": text.replace("1", "NaN", 1).encode(),
        "infinity": text.replace("1", "-Infinity", 1).encode(),
        "twice": text.replace("{", '{"task": "x", "task": "x", "format": 1, "format": 1,', 1).encode(),
        "UTF-16": text.encode("utf-16"),
        "a byte-order mark": b"\xef\xbb\xbf" + good,
        "Latin": text.replace('"', '"\xe9', 1).encode("latin-1"),
        "a list": b"[1, 2]",
        "pairs": b'[["format", 1]]',
        "a number": b"3",
        "null": b"null",
        "long": b'"' + b"x" * (65 << 20) + b'"',
        "many unknown names": b"{" + b",".join(b'"%d": 0' % n for n in range(100_000)) + b"}",
    }


@pytest.mark.parametrize("kind", ["config", "run"])
def test_hostile_json_is_refused(kind, sound, there):
    path = there(kind)
    configs.from_json(sound["config"].decode())  # whatever is imported or compiled once, our own annotations say
    for what, content in hostile_json(sound[kind]).items():
        path.write_bytes(content)
        if kind == "run" and what in ("NaN", "infinity", "many unknown names", "deep within"):
            continue  # of run.json the format alone counts, which some of these leave as it was
        with bounded(400 << 20), watched():
            refused(kind, path)


def test_a_config_is_refused_as_a_config_error_too(sound):
    for content in hostile_json(sound["config"]).values():
        with pytest.raises(ConfigError) as error:
            configs.from_json(content.decode(errors="replace"))
        assert len(str(error.value)) < 3000


def test_numbers_of_a_config_have_a_size(sound):
    with pytest.raises(ConfigError, match=r"config\.iterations: expected less than 2\^63"):
        configs.from_json(json.dumps(json.loads(sound["config"]) | {"iterations": 2**63}))


@pytest.mark.parametrize(
    "content",
    [
        b"iteration,real_steps\n1\n",
        b"iteration,real_steps\n1,2,3\n",
        b"iteration,iteration\n1,2\n",
        b"iteration\nmany\n",
        b"iteration\n" + b"1" * 5000 + b"\n",
        b"iteration\n" + b"1" * 200_000 + b"\n",
        b'iteration\n"1\n',
        b"\xff\xfe\n",
        b"iteration\n\x00\n",
        b"iteration\n[1]\n",
    ],
)
def test_a_table_that_is_none_is_refused(content, there):
    path = there("metrics")
    path.write_bytes(content)
    with bounded():
        refused("metrics", path, "expected a table of numbers|cannot read")


def test_a_fresh_directory_whose_metrics_are_damaged_is_refused(tmp_path, sound):
    """Without checkpoints they say how much is lost; damaged, they are named."""
    with probe.registered(), RunDirectory(tmp_path / "run", CONFIG) as run:
        (tmp_path / "run" / "metrics.csv").write_bytes(b"\xff")
        with pytest.raises(RunDirectoryError, match=r"metrics\.csv"):
            run.load(_load_checkpoint.template)


@pytest.mark.parametrize(
    "name", ["iteration-٠٠٠٠٠٣.npz", "iteration-99999999999999999999999.npz", "iteration-00003.npz.npz"]
)
def test_names_that_are_no_checkpoint_are_none(name, tmp_path):
    with probe.registered(), RunDirectory(tmp_path, CONFIG) as run:
        run.load(_load_checkpoint.template)
        run.begin(_load_checkpoint.template)
        (tmp_path / "checkpoints" / name).write_bytes(b"")
        assert run.load(_load_checkpoint.template).iteration == 0


def test_checkpoints_are_in_the_order_of_their_numbers(tmp_path, sound):
    with probe.registered(), RunDirectory(tmp_path, CONFIG) as run:
        for number in (99_999, 100_000, 9):
            (tmp_path / "checkpoints").mkdir(exist_ok=True)
            (tmp_path / "checkpoints" / f"iteration-{number:05d}.npz").write_bytes(b"")
        assert [int(path.stem[10:]) for path in newest_checkpoint.checkpoints(run.path)] == [9, 99_999, 100_000]


@pytest.mark.parametrize("name", ["000000000.npz", "٠٠٠٠٠٠٠٠.npz", "9" * 30 + ".npz"])
def test_an_episode_has_one_name_and_counts_once(name, tmp_path, sound):
    log = EpisodeLog(tmp_path)
    log.append(random_episode(np.random.default_rng(0), 5, 2, 2))
    shutil.copy(tmp_path / "episodes" / "00000000.npz", tmp_path / "episodes" / name)
    assert len(log.pending()) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rewards": np.float64(3)}, "expected numbers of shape"),
        ({"states": np.full((6, 2), 1e300)}, "states: expected finite numbers"),
        ({"actions": np.zeros((6, 2), complex)}, "actions: expected numbers of shape .* got complex128"),
    ],
)
def test_a_log_holds_what_float32_holds(changes, message, sound, there):
    path = there("logged data")
    with np.load(io.BytesIO(sound["logged data"])) as archive:
        np.savez(path, **{**archive, **changes})
    with pytest.raises(TaskError, match=message):
        offline_data.load(path, probe.PROBE)


# ---------------------------------------------------------------- the fuzzer

INTERESTING = (
    *(b"\x00", b"\xff", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\xff" * 8),
    *(b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07", b"../", b"meta.json.npy"),
    *(b"\x93NUMPY\x01\x00", b"|O", b"<f8", b"True", b"(9999999999,)"),
    *(b"NaN", b"-Infinity", b"1e999", b"null", b"-1", b"9" * 400, b"\\u0000", b"\\ud800", b'{"format": 1}'),
    *(b"{", b"[", b"]", b"}", b'"', b",", b":", b"\n"),
)
INPUTS = {"checkpoint": 8_000, "policy": 22_000, "episode": 18_000, "logged data": 20_000, "config": 14_000,
          "run": 10_000, "metrics": 12_000}  # fmt: skip
"""Of the slow test: 104,000."""


def mutated(content, rng):
    """The bytes with one to four small or large changes."""
    bad = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        size, at = len(bad), int(rng.integers(len(bad) + 1))
        deed = int(rng.integers(7))
        length = int(rng.integers(1, 1 + max(1, size // 4)))
        if deed == 0 and size:
            bad[at % size] ^= 1 << int(rng.integers(8))
        elif deed == 1:
            value = INTERESTING[int(rng.integers(len(INTERESTING)))]
            bad[at : at + len(value)] = value
        elif deed == 2:
            bad[at:at] = INTERESTING[int(rng.integers(len(INTERESTING)))]
        elif deed == 3:
            del bad[at : at + length]
        elif deed == 4:
            bad[at:at] = bad[:length]
        elif deed == 5:
            bad[at : at + length] = rng.bytes(length)
        else:
            field = [struct.pack("<H", 0), struct.pack("<I", int(rng.integers(2**32))), struct.pack("<Q", 2**63)]
            value = field[int(rng.integers(3))]
            bad[at : at + len(value)] = value
    return bytes(bad)


def hostile(content, kind, rng):
    """Hostile bytes of a kind: an archive's with its digest made right, or its members with their checksums too."""
    if kind not in ARCHIVES:
        return mutated(content, rng)
    signed = LOADERS[kind].signed
    if rng.integers(4) == 0:
        bad = mutated(content[:-64] if signed else content, rng)
        return sign(bad + bytes(64)) if signed else bad
    members = members_of(content)
    names = list(members)
    for _ in range(int(rng.integers(1, 3))):
        name = META if signed and rng.integers(3) == 0 else names[int(rng.integers(len(names)))]
        start = 128 if rng.integers(2) else 0  # the array alone, or its header too
        members[name] = members[name][:start] + mutated(members[name][start:], rng)
    return archive_of(members, kind, compress=bool(rng.integers(2)) and not signed)


def fuzz(kind, content, path, count, seed, sentinel):
    """Loads `count` hostile files: each one comes to nothing but a `MetrpoError`, or to something sound."""
    rng, loader, accepted = np.random.default_rng(seed), LOADERS[kind], 0
    path.write_bytes(content)
    loader.require_sound(loader.load(path))
    with watched(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("metrpo.run.episodes._log.warning", lambda *_: None)
        for number in range(count):
            bad = hostile(content, kind, rng)
            path.write_bytes(bad)
            try:
                found = loader.load(path)
            except MetrpoError as error:
                if path.name not in str(error):
                    pytest.fail(f"{kind} {seed} {number}: {error} does not name the file")
                continue
            except BaseException as error:
                pytest.fail(f"{kind} {seed} {number}: {type(error).__name__}: {error}\n{bad[:300]!r}")
            accepted += 1
            loader.require_sound(found)
    assert not sentinel.exists()
    return accepted


@pytest.mark.parametrize("kind", LOADERS)
def test_hostile_bytes_are_refused_or_sound(kind, sound, there, tmp_path):
    count = INPUTS[kind] // 20
    with bounded(200 << 20, seconds=110):
        accepted = fuzz(kind, sound[kind], there(kind), count, 0, tmp_path / "sentinel")
    assert accepted < count, "some are refused"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", LOADERS)
def test_a_hundred_thousand_hostile_inputs_are_refused_or_sound(kind, sound, there, tmp_path):
    assert sum(INPUTS.values()) >= 100_000
    fuzz(kind, sound[kind], there(kind), INPUTS[kind], 1, tmp_path / "sentinel")
