"""Results and times in words."""

from pathlib import Path

import pytest

from metrpo.console.result_lines import duration, outcome, summary

ROW = {"real_steps": 3000, "return_real": 12.34, "return_real_std": 0.5, "return_imagined": float("nan")}


def test_a_runs_return_is_shown_even_where_evaluation_failed():
    nothing = ROW | {"return_real": float("nan"), "return_collected": 4.0}
    run_dir = Path("a dir")
    assert outcome(ROW, run_dir) == "return 12.3 ± 0.5 after 3,000 real steps"
    assert outcome(nothing | {"failed_evaluation": 0}, run_dir) == "collected 4.0 after 3,000 real steps"
    failed = outcome(nothing | {"failed_evaluation": 1}, run_dir)
    assert failed.startswith("no return after 3,000 real steps: the last evaluation failed")
    assert failed.endswith("metrpo evaluate 'a dir'")
    assert "nan" not in failed
    assert "evaluation failed, collected     4.0" in summary(nothing | {"failed_evaluation": 1})
    baseline = {name: value for name, value in nothing.items() if name != "return_imagined"}
    assert outcome(baseline, run_dir).startswith("no return"), "it has an environment"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3599, "59 min 59 s"), (7800, "2 h 10 min")],
)
def test_durations(seconds, text):
    assert duration(seconds) == text
