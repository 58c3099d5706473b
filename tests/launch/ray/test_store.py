"""Runs on machines without a common disk, without Ray: what is sent, in what order, and what is taken from whom."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from metrpo.errors import RunDirectoryError
from metrpo.launch.ray import store, sync, worker
from metrpo.launch.ray.store import Changes, Store, Superseded
from metrpo.launch.ray.sync import Copy
from metrpo.launch.ray.worker import Ended, Order
from metrpo.run import lock

RUN = "Task/k-1/seed-0"


def put(directory, files):
    for name, content in files.items():
        path = directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(".new.tmp").write_text(content)
        path.with_name(".new.tmp").replace(path)


def there(directory):
    return {str(p.relative_to(directory)): p.read_text() for p in directory.rglob("*") if p.is_file()}


def changes(files=(), gone=(), log=b"", log_start=0):
    return Changes(tuple(files), tuple(gone), log, log_start)


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def kept(out):
    found = Store(str(out))
    yield found
    for held in found._locks.values():
        held.close()


# ---------------------------------------------------------------- the driver's machine


def test_an_attempt_begins_with_all_the_files_that_are_there(kept, out):
    files = {"run.json": "{}", "checkpoints/iteration-00001.npz": "state", "notes.txt": "mine"}
    put(out / RUN, files | {".lock": "", "episodes/.from-run.tmp.npz": "half", ".hidden/file": ""})
    (out / RUN / "a-pipe").unlink(missing_ok=True)
    os.mkfifo(out / RUN / "a-pipe")
    assert kept.begin(RUN) == (1, {name: content.encode() for name, content in files.items()})
    assert kept.begin("Task/k-1/seed-1") == (1, {})
    assert kept.begin(RUN)[0] == 2


def test_changes_are_written_in_their_order_and_deletions_last(kept, out, monkeypatch):
    put(out / RUN, {"checkpoints/1": "old", "metrics.csv": "old"})
    attempt, _ = kept.begin(RUN)
    done = []
    write, unlink = store.atomic_write, Path.unlink
    monkeypatch.setattr(store, "atomic_write", lambda path, content: done.append(path.name) or write(path, content))
    monkeypatch.setattr(Path, "unlink", lambda path, **how: done.append(f"not {path.name}") or unlink(path, **how))
    kept.take(RUN, attempt, changes([("checkpoints/2", b"b"), ("metrics.csv", b"new")], ["checkpoints/1", "never"]))
    assert done == ["2", "metrics.csv", "not 1", "not never"]
    assert there(out / RUN) == {"checkpoints/2": "b", "metrics.csv": "new", ".lock": str(os.getpid())}


def test_a_log_goes_on_where_it_ended_and_twice_the_same_is_once(kept, out):
    attempt, _ = kept.begin(RUN)
    for _ in range(2):
        kept.take(RUN, attempt, changes(log=b"one "))
    kept.take(RUN, attempt, changes(log=b"two ", log_start=4))
    attempt, _ = kept.begin(RUN)
    for _ in range(2):
        kept.take(RUN, attempt, changes(log=b"three"))
    assert (out / f"{RUN}.log").read_text() == "one two three"


def test_an_older_attempt_is_refused_and_holds_nothing(kept, out):
    first, _ = kept.begin(RUN)
    second, _ = kept.begin(RUN)
    kept.take(RUN, second, changes([("metrics.csv", b"second")]))
    with pytest.raises(Superseded, match=r"seed-0: attempt 2 continues it; attempt 1 ends"):
        kept.take(RUN, first, changes([("metrics.csv", b"first")], log=b"first"))
    with pytest.raises(Superseded):
        kept.take("Task/k-1/seed-1", 1, changes())
    assert (out / RUN / "metrics.csv").read_text() == "second"
    assert not (out / f"{RUN}.log").exists()
    kept.end(RUN, first)
    with pytest.raises(lock.DirectoryInUse):
        lock.hold(out / RUN)
    kept.end(RUN, second)
    kept.end(RUN, second)
    lock.hold(out / RUN).close()


def test_a_run_that_another_process_holds_is_not_given_away(kept, out):
    (out / RUN).mkdir(parents=True)
    held = lock.hold(out / RUN)
    with pytest.raises(lock.DirectoryInUse):
        kept.begin(RUN)
    held.close()
    assert kept.begin(RUN)[0] == 1


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "a/../../x", "a//x", "", ".", ".lock", "episodes/.tmp", "a\0b"])
def test_names_outside_of_the_run_directory_are_refused(kept, out, name):
    attempt, _ = kept.begin(RUN)
    before = there(out)
    for wrong in (changes([("run.json", b""), (name, b"")], log=b"words"), changes([("run.json", b"")], [name])):
        with pytest.raises(RunDirectoryError, match="expected the name of a file below"):
            kept.take(RUN, attempt, wrong)
    assert there(out) == before


@pytest.mark.parametrize("run", ["../x", "/tmp/x", "a/../../x", "", "."])
def test_runs_outside_of_the_folder_are_refused(kept, run):
    with pytest.raises(RunDirectoryError, match="expected the name of a run below"):
        kept.begin(run)


def test_a_folder_of_a_task_in_a_file_may_begin_with_a_dot(kept, out):
    kept.begin("..-mine.py-TASK/k-1/seed-0")
    assert (out / "..-mine.py-TASK/k-1/seed-0").is_dir()


def test_what_cannot_be_written_is_said_and_the_old_file_stays(kept, out, monkeypatch):
    attempt, _ = kept.begin(RUN)
    kept.take(RUN, attempt, changes([("a", b"old"), ("metrics.csv", b"old")]))
    replace = os.replace

    def full(source, target):
        if Path(target).name == "metrics.csv":
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(RunDirectoryError, match=r"cannot write .*metrics.csv: No space left"):
        kept.take(RUN, attempt, changes([("a", b"new"), ("metrics.csv", b"new")], ["a"]))
    assert there(out / RUN) == {"a": "new", "metrics.csv": "old", ".lock": str(os.getpid())}
    out.joinpath("Task").rename(out / "Tisk")
    (out / "Task").touch()
    with pytest.raises(RunDirectoryError, match="cannot write"):
        kept.begin("Task/k-1/seed-9")


# ---------------------------------------------------------------- the machine that works


class Listener:
    """A store that only listens."""

    def __init__(self, files=()):
        self.files, self.taken, self.busy, self.ended = dict(files), [], 0, []

    def begin(self, run):
        if self.busy:
            self.busy -= 1
            raise lock.DirectoryInUse("busy")
        return 7, self.files

    def take(self, run, attempt, changes):
        assert (run, attempt) == (RUN, 7)
        self.taken.append(changes)

    def end(self, run, attempt):
        self.ended.append((run, attempt))


@pytest.fixture
def node(tmp_path):
    (tmp_path / "log").touch()
    return tmp_path / "node"


def test_what_has_changed_is_sent_once_metrics_last(node, tmp_path):
    listener = Listener({"run.json": b"{}", "checkpoints/iteration-00001.npz": b"1", "metrics.csv": b"1"})
    copy = Copy(listener, RUN, node, tmp_path / "log")
    assert there(node) == {"run.json": "{}", "checkpoints/iteration-00001.npz": "1", "metrics.csv": "1"}
    copy.send()
    assert listener.taken == [], "they have come from there"
    new = {
        "policy.npz": "2",
        "metrics.csv": "2",
        "events/out": "2",
        "checkpoints/iteration-00002.npz": "2",
        "episodes/00000003.npz": "2",
        "config.json": "2",
        ".lock": "2",
        "episodes/.from-run.tmp.npz": "2",
    }
    put(node, new)
    (node / "checkpoints/iteration-00001.npz").unlink()
    (tmp_path / "log").write_text("two\n")
    copy.send()
    names = [
        "config.json",
        "episodes/00000003.npz",
        "checkpoints/iteration-00002.npz",
        "events/out",
        "policy.npz",
        "metrics.csv",
    ]
    gone = ["checkpoints/iteration-00001.npz"]
    assert listener.taken == [changes([(name, b"2") for name in names], gone, b"two\n", 0)]
    copy.send()
    assert len(listener.taken) == 1
    with open(tmp_path / "log", "a") as log:
        log.write("three\n")
    copy.send()
    assert listener.taken[1:] == [changes(log=b"three\n", log_start=4)]
    put(node, {"policy.npz": "3"})  # as long as before
    copy.send()
    assert listener.taken[2:] == [changes([("policy.npz", b"3")], log_start=10)]


def test_first_come_the_files_that_say_what_a_run_directory_is():
    names = ["metrics.csv", "a", "checkpoints/1", "run.json", "episodes/2", "config.json", "z", "diagnostics.csv"]
    order = ["run.json", "config.json", "episodes/2", "checkpoints/1", "a", "diagnostics.csv", "z", "metrics.csv"]
    assert sorted(names, key=sync.rank) == order


@pytest.mark.parametrize("happens", ["written", "deleted", "new"])
def test_nothing_is_sent_while_the_run_is_writing(node, tmp_path, monkeypatch, happens):
    listener = Listener()
    copy = Copy(listener, RUN, node, tmp_path / "log")
    put(node, {"checkpoints/1": "1", "metrics.csv": "1"})
    look = sync.marks

    def looked(directory):
        found = look(directory)
        if happens == "deleted":
            (node / "checkpoints/1").unlink()
        else:
            put(node, {"metrics.csv": "2"} if happens == "written" else {"checkpoints/2": "2"})
        monkeypatch.setattr(sync, "marks", look)
        return found

    monkeypatch.setattr(sync, "marks", looked)
    copy.send()
    assert listener.taken == []
    copy.send()
    assert {name: content.decode() for name, content in listener.taken[0].files} == there(node)


def test_what_was_not_taken_is_sent_again(node, tmp_path, monkeypatch):
    listener = Listener()
    copy = Copy(listener, RUN, node, tmp_path / "log")
    put(node, {"metrics.csv": "1"})
    (tmp_path / "log").write_text("words")

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(listener, "take", interrupted)
        with pytest.raises(KeyboardInterrupt):
            copy.send()
    copy.send()
    assert listener.taken == [changes([("metrics.csv", b"1")], log=b"words")]


def test_a_run_works_in_a_folder_of_its_own(out, tmp_path, monkeypatch):
    listener = Listener({"run.json": b"{}"})
    listener.busy = 1
    order = Order(("train", "--run-dir", str(out / RUN)), str(out / RUN), str(out / "log"), "/nowhere", {}, 1, 0.0)

    def attend(here, look):
        directory = Path(here.directory)
        assert there(directory) == {"run.json": "{}"}
        assert here.words == ("train", "--run-dir", here.directory)
        assert here.directory.endswith(f"/{RUN}")
        assert not directory.is_relative_to(tmp_path)
        assert directory.is_relative_to(here.folder), "the command's folder is not there"
        Path(here.log).write_text("said")
        put(directory, {"metrics.csv": "1"})
        look()
        attend.directory = directory
        return Ended(0, (), 1.0)

    monkeypatch.setattr(worker, "attend", attend)
    monkeypatch.setattr(sync, "_POLL", 0.001)
    assert sync.attend(order, RUN, listener) == Ended(0, (), 1.0)
    assert listener.taken == [changes([("metrics.csv", b"1")], log=b"said")]
    assert listener.ended == [(RUN, 7)]
    assert not attend.directory.exists()
    assert not out.exists()
    listener.busy = 1000
    monkeypatch.setattr(worker, "PATIENCE", 0.05)
    with pytest.raises(lock.DirectoryInUse):
        sync.attend(order, RUN, listener)


def test_its_log_comes_back_from_a_process_that_fails(kept, out, tmp_path):
    words = ("train", "Swimer", "--run-dir", str(out / RUN))
    order = Order(words, str(out / RUN), "/nowhere/log", str(tmp_path), {}, 1, 0.0)
    assert sync.attend(order, RUN, kept).code == 2
    log = (out / f"{RUN}.log").read_text()
    assert log.startswith("metrpo: on ")
    assert "unknown task 'Swimer'" in log
    lock.hold(out / RUN).close()


def test_a_run_whose_files_are_not_taken_is_killed(monkeypatch):
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"])

    def look():
        raise Superseded("another goes on")

    with pytest.raises(Superseded):
        worker._wait(process, look)
    assert process.returncode == -9


def test_the_last_look_follows_the_end_and_survives_interruption():
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    left, looked = [KeyboardInterrupt], []

    def look():
        if left:
            raise left.pop()
        looked.append(process.poll())

    assert worker._wait(process, look) == 0
    assert looked == [0]


def test_what_the_store_raises_is_raised_on_the_other_machine(kept, out, monkeypatch):
    class TaskError(Exception):
        def __init__(self, cause):
            self.cause = cause

    def get(call):
        try:
            return call()
        except Exception as error:
            raise TaskError(error) from error

    ray = SimpleNamespace(get=get, exceptions=SimpleNamespace(RayTaskError=TaskError))
    monkeypatch.setitem(sys.modules, "ray", ray)

    def method(name):
        return SimpleNamespace(remote=lambda *arguments: lambda: getattr(kept, name)(*arguments))

    actor = sync.RayActor(SimpleNamespace(begin=method("begin"), take=method("take"), end=method("end")))
    assert actor.begin(RUN) == (1, {})
    actor.take(RUN, 1, changes([("metrics.csv", b"1")]))
    assert (out / RUN / "metrics.csv").read_text() == "1"
    with pytest.raises(Superseded):
        actor.take(RUN, 0, changes())
    actor.end(RUN, 1)
    lock.hold(out / RUN).close()
