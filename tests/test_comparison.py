"""Groups of runs side by side: numbers that can be worked out by hand, and every format of the table."""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest

from metrpo.commands import main
from metrpo.comparison import compare
from metrpo.config import Config, EnsembleConfig
from metrpo.errors import ConfigError
from metrpo.plots import learning_curves
from metrpo.plots.bands import curve
from metrpo.plots.learning_curves import Look, plot
from metrpo.report.tables import markdown_row, written
from metrpo.run.find import find, group
from seen_runs import Page, a_run


def rows(returns):
    return [
        {"iteration": i, "real_steps": 100 * i, "return_real": value, "return_collected": -1.0}
        for i, value in enumerate(returns, 1)
    ]


CURVES = {
    "me-trpo": [(0.0, 10.0, 20.0), (0.0, 20.0, 24.0), (4.0, 30.0, 28.0)],
    "trpo": [(0.0, 1.0, 2.0), (0.0, 2.0, 4.0), (0.0, 3.0, 6.0)],
}


@pytest.fixture
def folder(tmp_path):
    for system, curves in CURVES.items():
        for seed, returns in enumerate(curves):
            config = Config("Swimmer", system=system, seed=seed)
            run = a_run(tmp_path / "runs" / system / f"seed-{seed}", config, rows(returns))
            if system == "me-trpo" and seed:  # one from before they were measured
                measured = {"zero": {"mean": -1.0 * seed}, "random": {"mean": -10.0}}
                (run / "run.json").write_text(json.dumps({"yardsticks": {"task": "Swimmer", **measured}}))
    a_run(tmp_path / "runs" / "other" / "seed-0", Config("Hopper"), rows([7.0, float("nan")]))
    (a_run(tmp_path / "runs" / "none" / "seed-0", Config("Ant"), []) / "run.json").write_text("{}")
    return tmp_path / "runs"


def test_a_level_of_no_task_is_refused(folder):
    with pytest.raises(ConfigError, match=r"level: expected one of the tasks .*Swimmer.*, got Swimer"):
        compare(find([folder]).runs, {"Swimer": 1.0})


def test_runs_of_one_seed_are_not_taken_for_seeds(folder):
    a_run(folder / "again" / "seed-2", Config("Swimmer", system="me-trpo", seed=2), rows([0.0, 1.0]))
    own, other = (one for one in compare(find([folder]).runs) if one.task == "Swimmer")
    assert (own.seeds, own.caveat) == (4, "Swimmer, me-trpo: several runs of seed 2, which are not independent.")
    assert other.caveat == ""


def test_numbers_are_those_worked_out_by_hand(folder):
    hopper, ours, theirs = sorted(compare(find([folder]).runs, 15.0), key=lambda one: (one.task, one.label))
    assert (ours.seeds, ours.last.value, ours.best, ours.real_steps) == (3, 24.0, 30.0, (300, 300))
    assert (ours.worst, ours.no_skill) == (20.0, {"doing nothing": -1.5, "random actions": -10.0})
    assert (theirs.worst, theirs.no_skill) == (2.0, {})
    assert 20.0 <= ours.last.low < 24.0 < ours.last.high <= 28.0
    # 15 is passed at 250, 175 and 100 + 11 / 26 of 100 steps.
    assert (ours.reached, ours.steps, ours.better) == (3, 175.0, None)
    assert (theirs.reached, theirs.steps, theirs.against) == (0, None, "me-trpo")
    assert dataclasses.astuple(theirs.better) == (0.0, 0.0, 0.0)
    assert (hopper.last.value, hopper.caveat) == (7.0, "One seed: the interval is the point itself.")


def test_the_level_is_what_all_reach_and_the_reference_may_be_named(folder):
    found = {one.label: one for one in compare(find([folder]).runs, None, "trpo") if one.task == "Swimmer"}
    assert {one.level for one in found.values()} == {4.0}
    assert (found["me-trpo"].better.value, found["trpo"].better) == (1.0, None)
    backwards = compare(find([folder]).runs[::-1])
    assert {one.against for one in backwards if one.task == "Swimmer"} == {"me-trpo"}
    by_task = compare(find([folder]).runs, {"Hopper": 3.0})
    assert {one.task: one.level for one in by_task} == {"Swimmer": 4.0, "Hopper": 3.0}
    with pytest.raises(ConfigError, match="against: expected one of me-trpo, trpo, got ppo"):
        compare(find([folder]).runs, None, "ppo")
    with pytest.raises(ConfigError, match="expected runs with at least one evaluation, got none"):
        compare([run for run in find([folder]).runs if run.config.task == "Ant"])


@pytest.mark.parametrize("ending", ["md", "csv", "tex", "html"])
def test_the_table_is_written_in_every_format(ending, folder, tmp_path, capsys):
    out = tmp_path / "new" / f"table.{ending}"
    assert main.main(["compare", str(folder), "--level", "15", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    text = out.read_text()
    assert text.count("me-trpo") >= 2
    if ending == "csv":
        lines = list(csv.DictReader(io.StringIO(text)))
        assert [line["last return"] for line in lines if line["system"] == "trpo"] == ["4.0"]
        assert [float(line["most real steps"]) for line in lines if line["system"] == "trpo"] == [300]
        assert [line["steps to it"] for line in lines if line["task"] == "Swimmer"] == ["175.0", ""]
        for line in lines:
            words = {"task", "system", "against"}
            assert all(not value or np.isfinite(float(value)) for name, value in line.items() if name not in words)
        columns = ("worst seed", "best", "doing nothing", "random actions")
        assert [[line[c] for c in columns] for line in lines if line["task"] == "Swimmer"] == [
            ["20.0", "30.0", "-1.5", "-10.0"],
            ["2.0", "6.0", "", ""],
        ]
    if ending == "html":
        assert "95 % bootstrap" in Page(f"<html>{text}</html>").text
        assert "<td>20.0</td><td>30.0</td><td>-1.5</td><td>-10.0</td>" in text
    if ending == "tex":
        assert r"Swimmer & me-trpo & 3 & 300 & 24.0" in text
        assert r"95 \% & worst seed & best & doing nothing & random actions" in text
        assert "& 20.0 & 30.0 & -1.5 & -10.0 &" in text
    if ending == "md":
        assert "| Swimmer | me-trpo | 3 | 300 | 24.0 |" in text
        assert "| 20.0 | 30.0 | -1.5 | -10.0 |" in text
        assert text.endswith("point itself.\n")


def test_cells_are_text_in_every_format():
    cell = "a|b<x>&$"
    assert markdown_row([cell]) == r"| a\|b&lt;x>&$ |"
    assert r"a\textbar{}b\textless{}x\textgreater{}\&\$" in written("tex", ["h"], [[cell]], [])
    assert "a|b&lt;x&gt;&amp;$" in written("html", ["h"], [[cell]], [])


def test_the_command_prints_a_table_or_json(folder, capsys):
    assert main.main(["compare", str(folder), "--level", "Swimmer=15"]) == 0
    assert "| 0.00 (0.00 to 0.00) |" in capsys.readouterr().out
    assert main.main(["compare", str(folder), "--json"]) == 0
    assert {one["task"] for one in json.loads(capsys.readouterr().out)} == {"Swimmer", "Hopper"}
    for level, said in (("much", "expected a number or TASK=NUMBER, got 'much'"), ("1 2", "expected one number")):
        assert main.main(["compare", str(folder), "--level", *level.split()]) == 2
        assert said in capsys.readouterr().err
    assert main.main(["compare", str(folder), "--out", "table.doc"]) == 2
    assert "ends in .md, .csv, .tex, .html, got .doc" in capsys.readouterr().err


def test_steps_that_go_down_cost_no_table(tmp_path):
    """No run writes them; a report of damaged files must come all the same."""
    damaged = [row | {"real_steps": steps} for row, steps in zip(rows([1.0, 2.0, 3.0]), (300, 100, 200), strict=True)]
    a_run(tmp_path / "a", Config("Swimmer"), damaged)
    assert [one.last.value for one in compare(find([tmp_path]).runs)] == [3.0]


# ---------------------------------------------------------------- pictures


def test_a_picture_looks_as_asked(folder, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(learning_curves, "png_of", lambda figure: seen.append(figure) or b"x")
    words = ["--title", "A $title", "--x-label", "steps", "--y-label", "earned", "--y-limits", "1", "40"]
    words += ["--x-limits", "90", "310", "--y-scale", "log", "--x-scale", "log", "--legend", "inside"]
    assert main.main(["plot", str(folder / "me-trpo"), "--out", str(tmp_path / "a.png"), *words]) == 0
    axes = seen[0].axes[0]
    assert (seen[0].get_suptitle(), axes.get_xlabel(), axes.get_ylabel()) == ("A $title", "steps", "earned")
    assert (axes.get_xlim(), axes.get_ylim()) == ((90, 310), (1, 40))
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_legend() is not None) == ("log", "log", True)
    plot(find([folder]).runs, tmp_path / "b.png", look=Look(legend="none"))
    assert [a.get_legend() for a in seen[1].axes] == [None] * 2
    assert seen[1].axes[0].get_xscale() == "linear"


def test_legends_side_by_side_do_not_meet(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(learning_curves, "png_of", lambda figure: seen.append(figure) or b"x")
    for task in ("Swimmer", "Hopper", "Ant"):
        for members in (1, 2, 3):
            config = Config(task, ensemble=EnsembleConfig(members=members, probabilistic=members > 1))
            a_run(tmp_path / task / f"{members}" / "seed-0", config, rows([1.0, 2.0]))
    plot(find([tmp_path]).runs, tmp_path / "b.png")
    widths = [axes.get_legend().get_window_extent().width for axes in seen[0].axes]
    assert len(widths) == 3
    assert max(widths) <= seen[0].bbox.width / 3


def test_what_has_been_measured_once_is_a_dot(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(learning_curves, "png_of", lambda figure: seen.append(figure) or b"x")
    for seed in (0, 1):
        a_run(tmp_path / "a" / f"seed-{seed}", Config("Swimmer", seed=seed), rows([1.0 + seed]))
    plot(find([tmp_path]).runs, tmp_path / "b.png")
    lines = seen[0].axes[0].get_lines()
    assert [len(line.get_xdata()) == 1 or line.get_marker() == "o" for line in lines] == [True] * 3
    assert all(line.get_marker() not in ("", "None") for line in lines)


def test_a_logarithmic_axis_without_anything_above_0_is_refused(tmp_path):
    a_run(tmp_path / "a", rows=rows([-1.0, -2.0]))
    with pytest.raises(ConfigError, match="y_scale: expected some return_real above 0 on a logarithmic axis, got none"):
        plot(find([tmp_path]).runs, tmp_path / "b.png", look=Look(y_scale="log"))


def test_looks_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="y_limits: expected the lower one first, got 4 1"):
        Look(y_limits=(4, 1))
    with pytest.raises(ConfigError, match="x_limits: expected limits above 0 on a logarithmic axis, got 0"):
        Look(x_limits=(0, 1), x_scale="log")


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("log_y", [False, True])
def test_the_band_of_two_seeds_holds_their_lines_on_any_axis(log, log_y, tmp_path):
    for seed, returns in enumerate([(1.0, 900.0, 2.0, 400.0), (800.0, 3.0, 500.0, 1.0)]):
        uneven = [row | {"real_steps": row["real_steps"] ** (1 + seed)} for row in rows(returns)]
        if seed:
            uneven = [r | {"real_steps": s} for r, s in zip(uneven, (90, 130, 320, 410), strict=True)]
        a_run(tmp_path / f"seed-{seed}", Config("Swimmer", seed=seed), uneven)
    (both,) = group(find([tmp_path]).runs)
    c = curve(both, "real_steps", "return_real", log, log_y)
    across, up = (np.log if is_log else np.asarray for is_log in (log, log_y))
    for x, y in c.seeds:
        line = np.interp(across(c.x), across(x), up(y))
        assert (up(c.low) - 1e-9 <= line).all()
        assert (line <= up(c.high) + 1e-9).all()
