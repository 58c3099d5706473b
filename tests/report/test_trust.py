"""The report's charts of how far models can be trusted: what is drawn is what was measured."""

import dataclasses
import math
import re

import numpy as np
import pytest

from metrpo.report.charts import Axes, Line, chart
from metrpo.report.heatmap import heat
from metrpo.report.page import page
from metrpo.report.trust import trust_of
from metrpo.run.find import find
from metrpo.run.metrics import to_csv
from seen_runs import CONFIG, ONE, Page, a_run, details, healthy, numbers_in

TITLES = ("Model error ", "Model error by dimension", "Disagreement", "Which models agree", "Outside the data")
OLD = [{n: v for n, v in r.items() if not n.startswith(("error_", "disagreement_", "outside"))} for r in healthy()]


def drawn(folder, config=CONFIG, rows=None, diagnostics=None):
    (run,) = find([a_run(folder, config, rows, details() if diagnostics is None else diagnostics)]).runs
    return trust_of(run, "real_steps", "real steps")


def picture(text, said):
    """The one SVG whose text alternative begins so."""
    (found,) = re.findall(rf'<svg [^>]*aria-label="{said}[^"]*".*?</svg>', text)
    return found


def cells(text):
    """Class, opacity of each cell, row by row."""
    return [(a, float(b)) for a, b in re.findall(r'<rect class="(\w+) fill" fill-opacity="([-\d.e]+)"', text)]


def test_every_diagnostic_has_a_chart_and_says_how_to_read_it(tmp_path):
    found = Page(page(find([a_run(tmp_path / "a", diagnostics=details())]), tmp_path)).text
    assert all(title in found for title in TITLES)
    assert "worse than predicting no change" in found
    assert "the policy is where the models guess" in found
    assert "a model that the others outvote" in found
    assert "no real step has been that far out" in found
    assert "Model error, one step" not in found, "one run is not drawn twice"


def test_a_run_from_before_them_has_none_of_these_charts(tmp_path):
    found = Page(page(find([a_run(tmp_path / "a", rows=OLD)]), tmp_path)).text
    assert not any(title in found for title in TITLES)
    assert "Validation loss" in found


def test_several_runs_are_compared(tmp_path):
    a_run(tmp_path / "a")
    a_run(tmp_path / "b", ONE, OLD)
    text = page(find([tmp_path]), tmp_path)
    error = picture(text, "Model error, one step")
    assert error.count("<circle") == 12, "the one that has them"
    assert "Other columns" in text
    others = text[text.index("Other columns") :]
    assert "error_5" not in others
    assert "disagreement_real" not in others


def test_errors_of_all_horizons_share_one_logarithmic_axis(tmp_path):
    lines = picture(drawn(tmp_path / "a"), "Model error by steps predicted")
    assert re.findall(r'<polyline class="(c\d[ \w]*)"', lines) == ["c0 thick", "c1", "c2 thick"]
    assert lines.count('class="zero"') == 1, "no change"
    assert "<title>an imagined episode: 1.1 at 3,000</title>" in lines


def test_a_logarithmic_axis_puts_tenfold_steps_equally_far_apart():
    y = np.array([0.1, 1.0, 10.0, 0.0, -1.0, np.nan])
    made = chart("t", [Line(np.arange(6.0), y, "a", "c0")], "x", "", axes=Axes(log_y=True, mark=1.0))
    low, middle, high = numbers_in(made, "cy")
    assert low - middle == pytest.approx(middle - high, abs=0.15)
    assert low > high
    (mark,) = re.findall(r'class="zero" x1="46" x2="370" y1="([\d.]+)"', made)
    assert float(mark) == pytest.approx(middle, abs=0.1)
    assert ">0.1<" in made
    assert ">10<" in made


@pytest.mark.parametrize("y", [[1e-300, 1e300], [1e300, 1e300], [1e-300, 1e-300], [0.5, 0.52], [-1.0, 0.0], [3.0, 3.0]])
def test_no_range_is_too_odd_for_a_logarithmic_axis(y):
    made = chart("t", [Line(np.array([0.0, 1.0]), np.array(y), "a", "c0")], "x", "", axes=Axes(log_y=True))
    heights = [float(v) for v in re.findall(r'class="grid" [^>]*y1="([-\d.]+)"', made)]
    assert 2 <= len(heights) <= 10
    assert all(0 <= v <= 230 for v in heights)
    assert not re.search(r"\b(nan|inf)\b", made)


def test_the_heat_map_shows_dimensions_against_steps(tmp_path):
    made = picture(drawn(tmp_path / "a"), "Model error by state dimension")
    assert "largest 1.7, of dimension 2 after an imagined episode; 1 of 12 above 1" in made
    assert re.findall(r'"end"[^>]*>([^<]*)<', made) == ["s[0]", "s[1]", "s[2]", "s[3]"]
    assert re.findall(r'mid in"[^>]*>([^<]*)<', made)[6:9] == ["0.30", "0.30", "1.7"]
    assert [style for style, _ in cells(made)] == ["c0"] * 8 + ["c3"] + ["c0"] * 3
    strengths = [strength for _, strength in cells(made)]
    assert strengths[0] < strengths[3] < strengths[6] < strengths[9], "the larger the error, the stronger"


def test_what_was_not_measured_is_an_empty_cell(tmp_path):
    rows = [r | {f"error_T_{d}": math.nan for d in range(4)} for r in details()]
    made = picture(drawn(tmp_path / "a", diagnostics=rows), "Model error by state dimension")
    assert len(cells(made)) == 8
    assert made.count(">-<") == 4
    assert "0 of 8 above 1" in made


def test_the_worst_of_many_dimensions_are_shown(tmp_path):
    rows = [r | {"error_1_77": 9.0} for r in details(dimensions=90)]
    text = drawn(tmp_path / "a", diagnostics=rows)
    made = picture(text, "Model error by state dimension")
    shown = [int(n) for n in re.findall(r"s\[(\d+)\]", made)]
    assert len(shown) == 30
    assert shown == sorted(shown)
    assert {77, 89} <= set(shown), "the worst, and no smaller one in place of a larger"
    assert 10 not in shown
    assert "The 30 worst of 90 dimensions" in text


def test_the_model_that_never_agrees_is_the_pale_row(tmp_path):
    made = picture(drawn(tmp_path / "a"), "Share of the validations")
    assert "model 2 80, model 3 0, model 4 80" in made
    strengths = np.array([strength for _, strength in cells(made)]).reshape(5, 12)
    assert (strengths[3] == 0).all()
    assert (np.delete(strengths, 3, axis=0) > 0.4).all()


def test_many_iterations_share_cells(tmp_path):
    rows = [r | {"improved_0": float(r["iteration"] > 100)} for r in details(200)]
    text = drawn(tmp_path / "a", rows=healthy(200), diagnostics=rows)
    made = picture(text, "Share of the validations")
    strengths = np.array([strength for _, strength in cells(made)]).reshape(5, -1)
    assert strengths.shape == (5, 30)
    assert (strengths[0, :14] == 0).all()
    assert (strengths[0, 15:] == strengths[0, -1]).all()
    assert "iterations, about 7 to a cell" in made


def test_iterations_before_the_first_diagnosis_are_left_out(tmp_path):
    empty = [dict.fromkeys(r) | {"iteration": r["iteration"], "real_steps": r["real_steps"]} for r in details(8)]
    made = picture(drawn(tmp_path / "a", diagnostics=empty + details()[8:]), "Share of the validations")
    assert len(cells(made)) == 5 * 4


def test_one_model_has_nobody_to_disagree_with(tmp_path):
    one = [{n: v for n, v in r.items() if not re.fullmatch(r"improved_[1-9]", n)} for r in details()]
    text = drawn(tmp_path / "a", ONE, [r | {"disagreement_imagined": 0.0} for r in healthy()], one)
    assert "Disagreement" not in text
    assert "Which models agree" not in text
    assert "Model error by dimension" in text


def test_a_damaged_diagnostics_file_is_named_and_the_run_stays(tmp_path):
    good = to_csv(details())
    for i, text in enumerate(
        (good[: len(good) // 2], "", good.replace("\n3,", "\n2,"), "\0", good.replace("0.8", "x"), good[:-2])
    ):
        run = a_run(tmp_path / str(i), dataclasses.replace(CONFIG, seed=i))
        (run / "diagnostics.csv").write_text(text)
    found = find([tmp_path])
    assert len(found.runs) == 6
    assert [skipped.path.name for skipped in found.skipped] == ["diagnostics.csv"] * 6
    text = Page(page(found, tmp_path)).text
    assert "0/diagnostics.csv" in text
    assert "Model error by dimension" not in text


def test_a_heat_map_has_numbers_where_there_is_room():
    shade = lambda value: ("c2", 2 * value)  # noqa: E731
    few, many = (heat("said", ["a"], ["1"] * n, np.full((1, n), 0.9), "head", shade, str) for n in (5, 30))
    assert few.count(">0.9<") == 5
    assert many.count(">0.9<") == 0
    assert cells(few) == [("c2", 1.0)] * 5, "no more than opaque"
    assert many.count(">1<") < 30, "names of columns do not lie on each other"
