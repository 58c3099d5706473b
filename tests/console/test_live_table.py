"""metrpo watch and metrpo plot."""

import dataclasses
import io
import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from metrpo.commands.main import main
from metrpo.config import Config, EnsembleConfig
from metrpo.console import live_table as watching
from metrpo.console.live_table import SPARKS, sparkline, watch
from metrpo.console.run_status import status_of
from metrpo.plots.bands import curve
from metrpo.policy.gaussian import Policy
from metrpo.run.directory import RunDirectory
from metrpo.run.episodes import waiting_steps
from metrpo.run.find import find, group, read
from metrpo.run.lock import claim
from metrpo.types import Episode
from seen_runs import a_run, details, healthy

CONFIG = Config("Swimmer", iterations=20)
TIMED = [r | {"wall_seconds": 2.0 * r["iteration"] ** 2} for r in healthy(10)]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def printed(paths, width=None, **options):
    out = io.StringIO()
    watch(paths, 1.0, True, Console(file=out, width=width, **options))
    return out.getvalue()


def test_a_table_of_runs(tmp_path):
    a_run(tmp_path / "stopped", CONFIG, TIMED)
    a_run(tmp_path / "finished", dataclasses.replace(CONFIG, iterations=10, seed=3), TIMED)
    a_run(tmp_path / "bad", CONFIG).joinpath("config.json").write_text("?")
    warned = [r | {"diverged": 0.5, "mean_std": 0.001} for r in TIMED]
    with claim(tmp_path / "running", dataclasses.replace(CONFIG, seed=7)):
        (tmp_path / "running" / "metrics.csv").write_text(
            a_run(tmp_path / "x", CONFIG, warned).joinpath("metrics.csv").read_text()
        )
        text = printed([tmp_path])
    lines = text.splitlines()
    for name in (
        "run",
        "task",
        "preset",
        "seed",
        "iteration",
        "return",
        "best",
        "gap",
        "so far",
        "warnings",
        "s/iteration",
        "left",
    ):
        assert name in lines[0]
    running, *stopped, finished = [line.split() for line in lines if "Swimmer" in line]
    assert running[:7] == ["running", "Swimmer", "me-trpo", "fast", "7", "10/20", "30,000"]
    assert [line[0] for line in stopped] == ["stopped", "x"]
    assert running[-1] == "running", "running ones first"
    # (2 * 100 - 2 * 49) / 3 seconds an iteration, ten to go
    assert "34.0" in running
    assert " ".join(running[-5:-1]).endswith("5 min 40 s")
    assert running[11] == "2", "two warnings"
    assert all("stopped" in line and line[-1] == "ago" for line in stopped)
    assert finished[4] == "3"
    assert finished[-1] == "finished"
    assert f"skipped: {tmp_path}/bad/config.json" in text
    assert "\x1b" not in text, "no control codes where there is no terminal"


def test_json_says_the_same(tmp_path, capsys):
    a_run(tmp_path / "a", CONFIG, TIMED)
    fresh = a_run(tmp_path / "b", dataclasses.replace(CONFIG, real_steps=90_000), [])
    (fresh / "run.json").write_text("{}")
    assert main(["watch", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    a, b = said["runs"]
    assert (a["state"], a["iteration"], a["iterations"], a["warnings"]) == ("stopped", 10, 20, 0)
    assert a["seconds_per_iteration"] == pytest.approx(34.0)
    assert a["seconds_left"] is None, "nobody is working on it"
    assert a["returns"] == [pytest.approx(r["return_real"]) for r in TIMED]
    assert (b["iteration"], b["iterations"], b["return_real"], b["returns"]) == (0, None, None, [])
    assert said["skipped"] == []


def test_steps_that_wait_are_seen(tmp_path):
    with RunDirectory(tmp_path / "a", CONFIG) as run:
        run.load(State(0, 0, LAYERS))
        run.episodes.append(an_episode(30))
        run.episodes.append(an_episode(12))
        assert waiting_steps(tmp_path / "a") == 42
        run.episodes.pending()
        run.save(State(1, 42, LAYERS), {"iteration": 1, "real_steps": 42, "return_real": 1.0})
        assert (tmp_path / "a" / "episodes" / "00000001.npz").exists(), "kept for the checkpoint before"
        assert waiting_steps(tmp_path / "a") == 0
        run.episodes.append(an_episode(1500))
        assert status_of(read(tmp_path / "a")).waiting_steps == 1500
        assert "42 +1,500" in printed([tmp_path / "a"])
        (tmp_path / "a" / "episodes" / "00000002.npz").write_bytes(b"torn")
        assert status_of(read(tmp_path / "a")).waiting_steps == 0


class State(NamedTuple):
    iteration: int
    real_steps: int
    policy: Policy


LAYERS = Policy(((np.zeros((10, 2), np.float32), np.zeros(2, np.float32)),), np.zeros(2, np.float32))


def an_episode(length):
    return Episode(np.zeros((length + 1, 10)), np.zeros((length, 2), "f"), np.zeros(length, "f"), False)


def test_what_tells_runs_apart_is_shown(tmp_path, capsys):
    more = dataclasses.replace(CONFIG, ensemble=dataclasses.replace(CONFIG.ensemble, members=10))
    a_run(tmp_path / "runs/sizes/five", CONFIG, TIMED)
    a_run(tmp_path / "runs/sizes/ten", more, TIMED)
    a_run(tmp_path / "runs/paper", dataclasses.replace(CONFIG, preset="paper"), TIMED)
    text = printed([tmp_path / "runs"], 200)
    assert "changed" in text
    for name, preset, changed in (
        ("sizes/five", "fast", "ensemble.members=5"),
        ("sizes/ten", "fast", "ensemble.members=10"),
        ("paper", "paper", ""),
    ):
        (line,) = [line for line in text.splitlines() if line.startswith(f"{name} ")]
        assert preset in line.split()
        assert changed in line
        assert ("ensemble.members" in line) == bool(changed)
    assert "changed" not in printed([tmp_path / "runs/paper"], 200), "nothing to be told from"
    assert main(["watch", "runs", "--json"]) == 0
    said = {Path(run["path"]).name: run["changed"] for run in json.loads(capsys.readouterr().out)["runs"]}
    assert said == {"paper": {}, "five": {"ensemble.members": "5"}, "ten": {"ensemble.members": "10"}}


def test_a_robots_run_shows_what_was_collected(tmp_path):
    nothing = {"return_real": None, "gap": None}
    rows = [r | nothing | {"return_collected": 5.0 * r["iteration"]} for r in TIMED]
    a_run(tmp_path / "robot", CONFIG, rows)
    line = printed([tmp_path], 200).splitlines()[-1]
    assert "50.0 collected" in line
    assert SPARKS[-1] in line
    assert status_of(read(tmp_path / "robot")).return_collected == 50.0


def test_the_command_prints_once_and_refuses_what_makes_no_sense(tmp_path, capsys):
    a_run(tmp_path / "a", CONFIG, TIMED)
    assert main(["watch", "a", "--once"]) == 0
    assert "10/20" in capsys.readouterr().out
    assert main(["watch", "nothing", "--once"]) == 2
    assert "expected a run directory or a folder with runs inside, got nothing" in capsys.readouterr().err
    assert main(["watch", "a", "--every", "0"]) == 2
    assert "every: expected at least 0.1 seconds" in capsys.readouterr().err


@pytest.mark.parametrize("terminal", [True, False])
def test_it_goes_on_until_ctrl_c_and_sees_new_runs(tmp_path, monkeypatch, capsys, terminal):
    a_run(tmp_path / "runs/a", CONFIG, TIMED)
    looks = itertools.count()

    def sleep(seconds):
        assert seconds == 2.5
        if next(looks) == 1:
            raise KeyboardInterrupt
        a_run(tmp_path / "runs/b", dataclasses.replace(CONFIG, task="Hopper"), TIMED)

    out = io.StringIO()
    monkeypatch.setattr(watching.time, "sleep", sleep)
    console = Console(file=out, force_terminal=terminal, width=150)
    monkeypatch.setattr(watching, "Console", lambda: console)
    assert main(["watch", str(tmp_path / "runs"), "--every", "2.5"]) == 0, "Ctrl-C is how it ends"
    assert "Hopper" in out.getvalue()


def test_a_narrow_terminal_goes_without_some_columns(tmp_path):
    a_run(tmp_path / "a", CONFIG, TIMED)
    for width in (60, 80, 100, 130):
        lines = printed([tmp_path], width, force_terminal=True, no_color=True, legacy_windows=False).splitlines()
        assert len(lines) == 3, "no line is broken"
        assert "return" in lines[0]
        assert "stopped" in lines[2]
        assert "…" not in lines[2]


def test_sparklines():
    assert sparkline([]) == ""
    assert sparkline([None, float("nan")]) == ""
    assert sparkline([1.0]) == SPARKS[0]
    assert sparkline(list(range(8))) == SPARKS
    assert sparkline([0.0, None, 7.0]) == SPARKS[0] + " " + SPARKS[-1]
    assert len(sparkline(list(range(500)))) == 12
    assert sparkline(list(range(500)))[-1] == SPARKS[-1]


def test_markup_in_a_name_is_text(tmp_path):
    a_run(tmp_path / "a", dataclasses.replace(CONFIG, task="[red]x[/nope]"), TIMED)
    assert "[red]x[/nope]" in printed([tmp_path])


def some_runs(folder):
    for seed, factor in enumerate((1.0, 2.0, 3.0)):
        rows = [r | {"return_real": factor * r["return_real"]} for r in TIMED]
        a_run(folder / f"five/{seed}", dataclasses.replace(CONFIG, seed=seed), rows)
    one = dataclasses.replace(CONFIG, system="k-1", ensemble=EnsembleConfig(members=1))
    a_run(folder / "one", one, TIMED)
    a_run(folder / "logged", dataclasses.replace(CONFIG, system="k-10", data=r"$\y$.npz"), TIMED)
    a_run(folder / "unlogged", dataclasses.replace(CONFIG, system="k-10"), TIMED)
    a_run(folder / "hopper", dataclasses.replace(CONFIG, task=r"Hop_per $\x$"), TIMED)
    return folder


@pytest.mark.parametrize(("name", "magic"), [("a.png", b"\x89PNG"), ("sub/a.svg", b"<?xml"), ("a.PDF", b"%PDF")])
def test_plot_writes_the_kind_that_is_asked_for_twice_the_same(tmp_path, capsys, name, magic):
    some_runs(tmp_path / "runs")
    assert main(["plot", "runs", "--out", name]) == 0
    assert capsys.readouterr().out == f"{name}\n"
    first = Path(name).read_bytes()
    assert first.startswith(magic)
    assert main(["plot", "runs", "--out", name]) == 0
    assert Path(name).read_bytes() == first
    if magic == b"\x89PNG":
        with Image.open(name) as picture:
            assert len(set(picture.convert("L").tobytes())) > 20


def test_plot_draws_what_is_asked_for(tmp_path, monkeypatch):
    from metrpo.plots import learning_curves

    drawn = []
    monkeypatch.setattr(learning_curves, "png_of", lambda figure: drawn.append(figure) or b"x")
    some_runs(tmp_path / "runs")
    for x, y in (("real_steps", "return_real"), ("wall_seconds", "kl"), ("iteration", "gap")):
        assert main(["plot", "runs", "--x", x, "--y", y]) == 0
    labels = [(f.axes[0].get_xlabel(), f.axes[0].get_ylabel()) for f in drawn]
    assert all(tick == int(tick) for tick in drawn[2].axes[0].get_xticks()), "no half iterations"
    assert labels == [
        ("real steps", "real return"),
        ("wall-clock time (s)", "kl"),
        ("iteration", "gap: imagined minus real return"),
    ]
    panels = {axes.get_title(): axes for axes in drawn[0].axes if axes.get_title()}
    assert set(panels) == {"Swimmer", r"Hop_per $\x$"}
    legend = [t.get_text() for t in panels["Swimmer"].get_legend().get_texts()]
    assert legend == ["me-trpo (3 seeds)", r"k-10, data=$\y$.npz", "k-1", "k-10, data=None"]
    mean = next(line for line in panels["Swimmer"].lines if line.get_label() == "me-trpo (3 seeds)")
    assert mean.get_ydata()[-1] == pytest.approx(2 * TIMED[-1]["return_real"]), "the mean of one, two and three times"
    assert len(panels["Swimmer"].collections) == 1, "one band"


def test_plot_draws_diagnostics_against_their_iterations_steps(tmp_path, monkeypatch):
    from metrpo.plots import learning_curves

    drawn = []
    monkeypatch.setattr(learning_curves, "png_of", lambda figure: drawn.append(figure) or b"x")
    rows = [r | {"error_10_3": 10.0 ** r["iteration"], "improved_0": 0.0} for r in details()]
    a_run(tmp_path / "a", diagnostics=rows[2:5])  # the file may be a row behind, or begin late
    for y in ("error_10_3", "improved_0", "error_T"):
        assert main(["plot", "a", "--y", y]) == 0
    error, share, overall = (figure.axes[0] for figure in drawn)
    (line,) = error.lines
    assert list(line.get_xdata()) == [9000, 12000, 15000]
    assert line.get_ydata() == pytest.approx([1e3, 1e4, 1e5])
    assert (error.get_yscale(), share.get_yscale(), overall.get_yscale()) == ("log", "linear", "log")
    assert overall.get_ylabel() == "model error after an imagined episode\n(1: as predicting no change)"
    assert {axes.yaxis.get_major_formatter()(0.2, 0) for axes in (error, overall)} == {"0.2"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "a.gif"], "out: expected a file name that ends in .png, .svg or .pdf, got a.gif"),
        (["--y", "nope"], "y: expected a column with numbers (iteration, real_steps, return_real,"),
        (["--y", "train_loss", "--x", "wall_seconds"], "x: expected a column with numbers"),
    ],
)
def test_plot_says_what_is_wrong(tmp_path, capsys, arguments, said):
    a_run(tmp_path / "a", CONFIG, [r | {"wall_seconds": None} for r in healthy()])
    assert main(["plot", "a", *arguments]) == 2
    out, err = capsys.readouterr()
    assert said in err
    assert (out, err.count("\n")) == ("", 1)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_plot_names_what_it_leaves_out(tmp_path, capsys, caplog):
    a_run(tmp_path / "runs/a")
    a_run(tmp_path / "runs/b").joinpath("metrics.csv").write_text("x")
    assert main(["plot", "runs"]) == 0
    assert "skipped runs/b" in caplog.text


def test_a_mean_curve_is_where_all_seeds_are(tmp_path):
    a_run(tmp_path / "a", CONFIG, TIMED)
    a_run(tmp_path / "b", dataclasses.replace(CONFIG, seed=1), [r | {"return_real": 0.0} for r in TIMED[3:7]])
    (only,) = group(find([tmp_path]).runs)
    c = curve(only, "real_steps", "return_real")
    assert (c.x[0], c.x[-1]) == (12_000, 21_000)
    assert c.mean[0] == pytest.approx(TIMED[3]["return_real"] / 2)
    assert np.all(c.low == 0), "of two seeds, their range"
    np.testing.assert_allclose(c.high, 2 * c.mean)
    assert len(c.seeds) == 2
    apart = [TIMED[:3], TIMED[6:]]
    for name, rows in zip("cd", apart, strict=True):
        a_run(tmp_path / f"z/{name}", CONFIG, rows)
    (none,) = group(find([tmp_path / "z"]).runs)
    assert len(curve(none, "real_steps", "return_real").x) == 0
    assert len(curve(none, "real_steps", "return_real").seeds) == 2


@pytest.mark.parametrize(("log", "log_y"), [(False, False), (True, False), (False, True), (True, True)])
def test_the_band_of_two_seeds_contains_their_drawn_lines(tmp_path, log, log_y):
    """Between its points a line is straight on the axes, logarithmic ones too."""
    for seed, (steps, values) in enumerate([([1000, 50_000], [0.01, 0.9]), ([900, 2000, 60_000], [1.0, 0.02, 0.5])]):
        rows = [
            {"iteration": i, "real_steps": s, "return_real": v}
            for i, (s, v) in enumerate(zip(steps, values, strict=True))
        ]
        a_run(tmp_path / str(seed), dataclasses.replace(CONFIG, seed=seed), rows)
    (only,) = group(find([tmp_path]).runs)
    c = curve(only, "real_steps", "return_real", log, log_y)
    across, up = (np.log if is_log else np.asarray for is_log in (log, log_y))
    fine = np.linspace(across(1000), across(50_000), 4001)
    low, high = (np.interp(fine, across(c.x), up(band)) for band in (c.low, c.high))
    for xs, ys in c.seeds:
        line = np.interp(fine, across(xs), up(ys))
        assert np.all(low <= line + 1e-9)
        assert np.all(line <= high + 1e-9)
    # No wider than needed, but for where the lines cross between two points of the grid.
    both = np.array([np.interp(fine, across(xs), up(ys)) for xs, ys in c.seeds])
    assert np.median(np.abs(high - both.max(axis=0))) < 1e-9


def test_points_off_a_logarithmic_axis_are_left_out(tmp_path):
    rows = [{"iteration": i, "real_steps": 1000 * i, "return_real": [0.5, 0.1, 0.2][i]} for i in range(3)]
    a_run(tmp_path / "a", CONFIG, rows)
    (only,) = group(find([tmp_path]).runs)
    assert len(curve(only, "real_steps", "return_real").x) == 3
    assert list(curve(only, "real_steps", "return_real", log=True).x) == [1000, 2000]


@pytest.mark.parametrize("command", ["report", "plot", "watch"])
def test_every_help_has_examples(capsys, command):
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"metrpo {command} runs" in out.replace("usage: metrpo", "")
    assert "(default: " in out


def test_looking_needs_neither_jax_nor_mujoco(tmp_path):
    a_run(tmp_path / "a", CONFIG, TIMED)
    code = "import sys; from metrpo.commands.main import main; "
    code += "assert main(['report', 'a']) == main(['watch', 'a', '--once']) == 0; "
    code += "print([m for m in ('jax', 'mujoco', 'gymnasium', 'matplotlib') if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "[]"
