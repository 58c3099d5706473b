"""Progress: plain lines in logs, a live display on terminals, nothing when silent."""

import io
import re
import sys
import time

import pytest
from rich.console import Console

from metrpo.console.progress import SILENT, LiveProgress, PlainProgress, TolerantProgress, default_progress

ROW = {
    "iteration": 1,
    "real_steps": 3000,
    "return_real": 12.34,
    "return_real_std": 0.5,
    "return_imagined": float("nan"),
    "seconds_fit": 60.0,
    "seconds_collect": 5.4,
}


def play(progress, pause=0.0):
    progress.begin(1, 10)
    progress.stage("collect", 3000)
    progress.update(1500)
    progress.stage("fit")
    progress.update(7, "loss 0.2")
    time.sleep(pause)
    progress.end(ROW, 125)
    progress.begin(2, None)
    progress.stage("collect", 3000)
    progress.close()
    progress.close()


@pytest.mark.parametrize(
    ("iteration", "of", "said"),
    [
        (5, 20, "resuming runs/[a] at iteration 5 of 20, 12,000 real steps"),
        (5, None, "resuming runs/[a] at iteration 5, 12,000 real steps"),
        (1, 20, "resuming runs/[a] at iteration 1 of 20, 12,000 real steps and 600 new ones"),
        (5, 4, "runs/[a] is finished: 4 iterations, 12,000 real steps; raise the budget to continue it"),
    ],
)
def test_a_resumed_run_says_so(iteration, of, said):
    out = io.StringIO()
    for progress in (
        PlainProgress(out),
        TolerantProgress(PlainProgress(out)),
        LiveProgress(Console(file=out, width=30)),
        SILENT,
    ):
        progress.resume("runs/[a]", iteration, of, 12_000, 600 if iteration == 1 else 0)
    assert out.getvalue().splitlines() == [said] * 3


def test_plain_lines_are_one_per_stage_and_one_per_iteration():
    out = io.StringIO()
    play(PlainProgress(out))
    lines = out.getvalue().splitlines()
    assert [re.sub(r" +\d+\.\d s", "", line).split("  ")[0] for line in lines] == ["iteration 1/10"] * 3 + [
        "iteration 2"
    ]
    assert lines[0].endswith("collect")
    assert lines[1].endswith("fit")
    for text in ("3,000 real steps", "12.3 ± 0.5", "imagined     nan", "1 min 05 s", "about 2 min 05 s left"):
        assert text in lines[2]
    assert "\x1b" not in out.getvalue()


def test_nothing_is_said_of_time_left_after_the_last_iteration():
    out = io.StringIO()
    progress = PlainProgress(out)
    progress.begin(1, 1)
    progress.end({"real_steps": 3000, "return_real": 1.0}, 0.0)
    assert "3,000 real steps" in out.getvalue()
    assert "left" not in out.getvalue()


def test_the_live_display_shows_stage_bar_and_results():
    out = io.StringIO()
    play(LiveProgress(Console(file=out, force_terminal=True, width=100)), pause=0.5)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue())
    for part in (
        "iteration 1/10",
        "collect",
        "fit",
        "loss 0.2",
        "3,000 real steps",
        "12.3 ± 0.5",
        "about 2 min 05 s left",
    ):
        assert part in text


def test_iterations_stay_on_one_line_in_a_narrow_terminal():
    out = io.StringIO()
    play(LiveProgress(Console(file=out, force_terminal=True, width=40)))
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue())
    assert any("3,000 real steps" in line and "1 min 05 s" in line for line in text.splitlines())


def test_the_live_display_gives_the_terminal_back_after_an_error():
    out = io.StringIO()
    progress = LiveProgress(Console(file=out, force_terminal=True, width=100))
    progress.begin(1, 2)
    progress.stage("fit", None)
    progress.close()
    assert out.getvalue().rstrip().endswith("\x1b[?25h")  # the cursor is visible again


def test_silence(capsys):
    play(SILENT)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("terminal", "kind"), [(True, LiveProgress), (False, PlainProgress)])
def test_the_display_fits_the_output(monkeypatch, terminal, kind):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal, raising=False)
    assert type(default_progress()) is kind
