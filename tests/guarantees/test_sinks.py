"""What only shows a run (curve, TensorBoard, video, screen) may raise, hang or go: the run stays the same."""

from __future__ import annotations

import resource
import shutil
import struct
import subprocess
import sys
import threading
import time

import pytest
from tensorboardX.proto.event_pb2 import Event

import tiny_run
from metrpo.commands import main
from metrpo.console import progress
from metrpo.console.progress import Progress, TolerantProgress
from metrpo.run import derived_files
from metrpo.run.metrics import Events, read_metrics
from tiny_run import CONFIG, ITERATIONS, command_line, differing, process_line, result, train


@pytest.fixture(autouse=True, scope="module")
def _cheap():
    with tiny_run.cheap():
        yield


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("expected") / "run"
    train(CONFIG, run_dir)
    return result(run_dir)


def steps_shown(run_dir):
    """The steps of what TensorBoard shows as `iteration`."""
    shown = []
    for path in (run_dir / "events").glob("events.out.tfevents.*"):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + length])
            shown += [event.step for value in event.summary.value if value.tag == "iteration"]
            data = data[16 + length :]
    return shown


ALL_STEPS = [80, 160, 240]


def raises(*_):
    raise RuntimeError("no fonts")


def hangs(*_):
    threading.Event().wait()


@pytest.mark.parametrize(
    ("owner", "name", "what", "costs"),
    [
        (derived_files, "draw_curve", "learning curve", ["curve.png"]),
        (derived_files, "Events", "TensorBoard events", []),
        (Events, "add", "TensorBoard events", []),
        (Events, "_write", "TensorBoard events", []),
    ],
    ids=["curve", "events begin", "events add", "events write"],
)
@pytest.mark.parametrize("breaks", [raises, hangs])
def test_what_breaks_costs_only_itself(owner, name, what, costs, breaks, tmp_path, expected, monkeypatch, caplog):
    monkeypatch.setattr(derived_files, "_PATIENCE", 0.2)
    before = time.monotonic()
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, breaks)
        train(CONFIG, tmp_path)
    assert time.monotonic() - before < 20
    why = {raises: "RuntimeError: no fonts", hangs: "TimeoutError: not finished within 0.2 s"}[breaks]
    assert [r.getMessage() for r in caplog.records] == [f"no {what} any more ({why}); training continues"]
    assert differing(result(tmp_path), expected) == costs
    train(CONFIG, tmp_path)  # once it works again
    assert differing(result(tmp_path), expected) == []
    assert steps_shown(tmp_path) == ALL_STEPS


def test_what_takes_long_but_ends_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(
        derived_files, "draw_curve", lambda rows, path, title, *_: (time.sleep(0.3), path.write_text("done"))
    )
    train(CONFIG, tmp_path)
    assert (tmp_path / "curve.png").read_text() == "done"


def test_tensorboards_directory_may_go_at_any_time(tmp_path, expected, monkeypatch, caplog):
    draw = derived_files.draw_curve

    def sweeping(rows, path, title, yardsticks):
        shutil.rmtree(tmp_path / "events", ignore_errors=True)
        draw(rows, path, title, yardsticks)

    monkeypatch.setattr(derived_files, "draw_curve", sweeping)
    train(CONFIG, tmp_path)
    assert differing(result(tmp_path), expected) == []
    assert steps_shown(tmp_path) == ALL_STEPS, "it comes back whole"
    assert caplog.text == ""


def test_a_full_disk_does_not_stop_tensorboards_writer_for_ever(tmp_path):
    rows = [{f"a{i}": 0.5 for i in range(30)} | {"real_steps": step} for step in range(20)]
    events = Events(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    failed = 0
    try:
        for row in rows:
            try:
                events.add(row)
            except OSError:
                failed += 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert failed > 15


def test_a_video_that_breaks_costs_only_itself(tmp_path, expected, monkeypatch, capsys):
    monkeypatch.setattr("metrpo.evaluation.render", raises)
    line = [word for word in command_line(tmp_path / "run") if word != "--no-video"]
    assert main.main(line) == 0
    assert "video    none (RuntimeError: no fonts)" in capsys.readouterr().out
    assert differing(result(tmp_path / "run"), expected) == []


class Broken(Progress):
    """Fails in one of its methods."""

    def __init__(self, name):
        setattr(self, name, raises)


@pytest.mark.parametrize("name", ["begin", "stage", "update", "end", "close"])
def test_a_display_that_breaks_costs_only_itself(name, tmp_path, expected, caplog):
    train(CONFIG, tmp_path, TolerantProgress(Broken(name)))
    assert differing(result(tmp_path), expected) == []
    message = "progress is not shown any more (RuntimeError: no fonts); training continues"
    assert [r.getMessage() for r in caplog.records] == [message]


def test_output_that_can_be_written_is_left_alone(capfd):
    progress.mute_broken_output()
    print("still here")
    assert capfd.readouterr().out == "still here\n"


def shell(run_dir, how):
    """The run in a shell, with its output led elsewhere."""
    words = " ".join(f"'{word}'" for word in process_line(run_dir, "--device", "cpu"))
    return subprocess.Popen(
        ["bash", "-c", how.format(words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


WARNING = "metrpo: progress is not shown any more ({}); training continues\n"
OUTPUTS = {
    "head": ("{} | head -1; exit ${{PIPESTATUS[0]}}", WARNING.format("BrokenPipeError: [Errno 32] Broken pipe")),
    "both": ("{} 2>&1 | head -1; exit ${{PIPESTATUS[0]}}", ""),
    "full": ("{} > /dev/full", WARNING.format("OSError: [Errno 28] No space left on device")),
    "closed": ("{} >&-", ""),
}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_processes_whose_output_goes_nowhere(tmp_path):
    """`metrpo train ... | head -1`, a log on a full disk, no stdout: each run ends well, and is complete."""
    started = {name: shell(tmp_path / name, how) for name, (how, _) in OUTPUTS.items()}
    ended = {name: (*process.communicate(timeout=500), process.returncode) for name, process in started.items()}
    checkpoints = {}
    for name, (out, err, code) in ended.items():
        assert (name, err, code) == (name, OUTPUTS[name][1], 0)
        assert len(out.splitlines()) == (name in ("head", "both"))
        assert len(read_metrics(tmp_path / name / "metrics.csv")) == ITERATIONS
        checkpoints[name] = (tmp_path / name / "checkpoints" / "iteration-00003.npz").read_bytes()
    assert len(set(checkpoints.values())) == 1


def test_an_error_is_an_error_even_if_nobody_reads_it(tmp_path):
    program = "import sys; from metrpo.commands.main import main; sys.exit(main(['evaluate', sys.argv[1]]))"
    for how in ("2>&-", "2> /dev/full"):
        command = f"'{sys.executable}' -c \"{program}\" '{tmp_path}' {how}"
        assert subprocess.run(["bash", "-c", command]).returncode == 2
