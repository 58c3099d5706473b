"""Full, read-only and broken disks: a message that says what to do, what is there stays, and the run goes on after."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import subprocess

import pytest

import tiny_run
from faults import Disk
from metrpo import append_episode
from metrpo.commands import main
from metrpo.errors import MetrpoError
from metrpo.run.episodes import EpisodeLog
from metrpo.run.metrics import read_metrics
from tiny_run import CONFIG, EPISODES, ITERATIONS, Counted, by_steps, by_train, command_line, differing, drive, result

FAULTS = [errno.ENOSPC, errno.EROFS, errno.EIO]
names = errno.errorcode.get


@pytest.fixture(autouse=True, scope="module")
def _cheap():
    with tiny_run.cheap():
        yield


@pytest.fixture(scope="module", params=[by_train, by_steps], ids=["train", "steps"])
def uninterrupted(request, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("uninterrupted") / "new" / "run"
    (operations,) = drive(request.param, run_dir, [])
    return request.param, len(operations), result(run_dir)


def one_failure(uninterrupted, run_dir, fault, n, caplog):
    """The disk fails at operation n and works again later; the command that failed is given again."""
    commands, _, expected = uninterrupted
    run_dir.parents[1].mkdir(parents=True, exist_ok=True)
    Counted.kept, failed = 0, []
    given = commands(run_dir)
    command = next(given)
    caplog.clear()
    with Disk(run_dir.parents[1], n, fault) as disk:
        while command is not None:
            try:
                command()
            except MetrpoError as error:  # nothing else: no traceback
                failed.append(str(error))
                break
            command = next(given, None)
    where = f"{names(fault)} at {disk.done[n - 1]}"
    for text in failed:
        assert os.strerror(fault) in text, where
        assert "choose a writable" in text or "choose another" in text, where
    # What did not fail has told what it goes on without, or the rest of the run needed nothing more from the disk.
    assert failed or "training continues" in caplog.text or disk.count - n < 10, where
    while command is not None:
        command()
        command = next(given, None)
    tiny_run.train(CONFIG, run_dir)  # a curve that was left out is drawn when the run is opened again
    assert differing(result(run_dir), expected) == [], where
    assert Counted.kept <= ITERATIONS * EPISODES, where
    return bool(failed)


@pytest.mark.parametrize("fault", FAULTS, ids=names)
def test_a_disk_that_fails_in_one_operation_of_forty(uninterrupted, fault, tmp_path, caplog):
    numbers = range(7 + 13 * FAULTS.index(fault), uninterrupted[1], 40)
    failed = [one_failure(uninterrupted, tmp_path / str(n) / "new" / "run", fault, n, caplog) for n in numbers]
    assert sum(failed) > 0.6 * len(numbers) > 3


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("fault", FAULTS, ids=names)
def test_a_disk_that_fails_in_every_operation(uninterrupted, fault, tmp_path, caplog):
    for n in range(1, uninterrupted[1] + 1):
        one_failure(uninterrupted, tmp_path / str(n) / "new" / "run", fault, n, caplog)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("expected") / "run"
    tiny_run.train(CONFIG, run_dir)
    return result(run_dir)


@contextlib.contextmanager
def largest_file(size):
    """The kernel lets no file grow beyond `size` bytes: really written, really refused (EFBIG)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_told(err, run_dir, reason):
    assert f"metrpo: cannot write {run_dir}/" in err
    assert f"{reason}; make room or choose a writable directory\n" in err
    kept = f"metrpo: stopped; {run_dir} keeps every finished iteration and real episode. The same command resumes."
    assert f"{kept}\n\n  metrpo train Probe --run-dir {run_dir}" in err


def test_the_kernel_refuses_to_write_more(tmp_path, expected, capsys):
    run_dir, Counted.kept = tmp_path / "run", 0
    with largest_file(len(expected["checkpoints/iteration-00002.npz"]) - 1):
        assert main.main(command_line(run_dir)) == 2
    assert_told(capsys.readouterr().err, run_dir, os.strerror(errno.EFBIG))
    assert [row["iteration"] for row in read_metrics(run_dir / "metrics.csv")] == [1]
    assert len(EpisodeLog(run_dir).pending()) == 2 * EPISODES, "those of the iteration that could not be saved too"
    assert main.main(command_line(run_dir)) == 0
    assert differing(result(run_dir), expected) == []
    assert Counted.kept == ITERATIONS * EPISODES


@pytest.fixture
def small_disk(tmp_path):
    """A file system of its own, and a function that mounts it anew with other options."""
    disk = tmp_path / "disk"
    disk.mkdir()

    def mount(*options):
        return subprocess.run(["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", disk], capture_output=True)

    if mount("size=48k").returncode != 0:
        pytest.skip("only root may mount")
    yield disk, lambda *options: subprocess.run(["mount", "-o", ",".join(("remount", *options)), disk], check=True)
    subprocess.run(["umount", disk], check=True)


def test_a_disk_that_is_really_full(small_disk, expected, capsys):
    disk, remount = small_disk
    run_dir, Counted.kept = disk / "run", 0
    assert main.main(command_line(run_dir)) == 2
    assert_told(capsys.readouterr().err, run_dir, os.strerror(errno.ENOSPC))
    before = result(run_dir)
    assert main.main(command_line(run_dir)) == 2
    assert result(run_dir) == before
    remount("size=10m")
    assert main.main(command_line(run_dir)) == 0
    assert differing(result(run_dir), expected) == []
    assert Counted.kept == ITERATIONS * EPISODES


def test_a_disk_that_is_really_read_only(small_disk, expected, capsys):
    disk, remount = small_disk
    run_dir = disk / "run"
    remount("size=10m")
    assert main.main(command_line(run_dir, "--iterations", "2")) == 0
    remount("ro")
    before = result(run_dir)
    for command in (command_line(run_dir), ["collect", str(run_dir)], ["improve", str(run_dir)]):
        assert main.main(command) == 2
        err = capsys.readouterr().err
        assert f"metrpo: cannot write in {run_dir}: Read-only file system; choose a writable directory" in err
    with pytest.raises(MetrpoError, match=r"cannot write .*Read-only file system"):
        append_episode(run_dir, [[0, 0], [0, 0]], [[0, 0]], [0.0], terminated=False)
    assert result(run_dir) == before
    remount("rw")
    assert main.main(command_line(run_dir)) == 0
    # That iteration's checkpoint names the budget of then.
    assert differing(result(run_dir), expected) == ["checkpoints/iteration-00002.npz"]
