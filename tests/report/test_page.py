"""metrpo report: one page without any other file, whatever lies in the run directories."""

import dataclasses
import json
import math
import random
import re
from pathlib import Path

import pytest

from metrpo.checks.health import examine
from metrpo.commands.main import main
from metrpo.config import ImagineConfig
from metrpo.console.run_status import status_of
from metrpo.errors import RunDirectoryError
from metrpo.report import page as pages
from metrpo.report.charts import Axes, Line, bars, chart, number, real_frame
from metrpo.report.page import page, record
from metrpo.run.curve import draw_curve
from metrpo.run.find import FoundRuns, SeenRun, find, group
from metrpo.run.metrics import read_metrics
from places import RESULTS
from seen_runs import CONFIG, ONE, Page, a_run, details, healthy, numbers_in


def parsed(paths, folder=Path()):
    return Page(page(find(paths), folder))


def report(*arguments):
    return main(["report", *map(str, arguments)])


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_the_page_needs_nothing_but_itself(tmp_path):
    for seed in (0, 1, 2):
        run = a_run(tmp_path / f"runs/a/{seed}", dataclasses.replace(CONFIG, seed=seed))
        (run / "video.mp4").write_bytes(b"mp4" * 1000)
    a_run(tmp_path / "runs/b", ONE)
    text = page(find([tmp_path / "runs"]), tmp_path)
    found = Page(text)
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(found.tags)
    assert {reference.split(",")[0] for reference in found.references} == {"data:video/mp4;base64"}
    assert len(found.references) == 3
    assert found.links == []
    assert "url(" not in found.styles
    assert "@import" not in found.styles
    assert not re.search(r"https?://|//[a-z]", text)
    assert "default-src 'none'" in text
    assert 'name="viewport" content="width=device-width' in text
    assert "prefers-color-scheme:dark" in found.styles
    assert "max-width:640px" in found.styles


def test_the_page_shows_what_it_must(tmp_path):
    for seed in (0, 1, 2):
        a_run(tmp_path / f"a/{seed}", dataclasses.replace(CONFIG, seed=seed))
    rows = [r | {"seconds_fit": 2.0, "seconds_improve": 5.0, "wall_seconds": 7.0 * r["iteration"]} for r in healthy()]
    a_run(tmp_path / "b", ONE, [r | {"gap": 4 * abs(r["return_real"]), "novel_column": 3.0} for r in rows])
    text = page(find([tmp_path]), tmp_path)
    found = Page(text)
    for title in (
        "Imagined return 5.0 times the real one",
        "since iteration 1. The policy exploits the models' errors",
        "Warnings in 1 of 4 runs",
        "me-trpo (3 seeds)",
        "k-1, seed 0",
        "Real and imagined return",
        "Gap",
        "Models improved",
        "Accepted updates",
        "KL divergence",
        "Standard deviation",
        "Validation loss",
        "Policy updates",
        "Stage times",
        "novel_column",
        "Settings that differ",
        "ensemble.members",
        "1 min 24 s",
        "Zero in every iteration of every run: diverged rollouts",
    ):
        assert title in found.text, title
    wide = text[text.index('aria-label="Learning curves of Swimmer"') :]
    wide = wide[: wide.index("</svg>")]
    assert len(re.findall("<polygon[^>]*band", wide)) == 2, "a band for each group"
    assert len(re.findall('<polyline class="c0 thin"', wide)) == 3, "every seed"
    assert text.count('aria-label="Real and imagined return of') == 4
    assert page(find([tmp_path]), tmp_path) == text, "the same runs give the same page"


def test_several_runs_begin_with_their_groups(tmp_path):
    for seed in (0, 1, 2):
        run = a_run(tmp_path / f"a/{seed}", dataclasses.replace(CONFIG, seed=seed), healthy(12 - seed))
        yardsticks = {"task": "Swimmer", "zero": {"mean": -1.25}, "random": {"mean": -7.0}}
        (run / "run.json").write_text(json.dumps({"yardsticks": yardsticks}))
    a_run(tmp_path / "b", ONE, [r | {"return_real": 1e300} for r in healthy()])
    text = page(find([tmp_path]), tmp_path)
    groups, health = text.index('<section id="groups">'), text.index('<section id="health">')
    assert groups < health, "first"
    ours, theirs = text[groups:health].split("<tbody>")[1].split("<tr>")[1:]
    last = [healthy(n)[-1]["return_real"] for n in (12, 11, 10)]
    for cell in ("3", "30,000 to 36,000", f"{sum(last) / 3:.1f}", f"{min(last):.1f}", "-1.2", "-7.0"):
        assert f"<td>{cell}</td>" in ours, cell
    assert 'class="swatch c0"></i>me-trpo<' in ours
    assert "<td>1e+300</td>" in theirs
    assert record(find([tmp_path]))["groups"][0]["worst"] == min(last)
    alone = find([tmp_path / "b"])
    assert ('id="groups"' in page(alone, tmp_path), record(alone)["groups"]) == (False, []), "a run is no group"
    (tmp_path / "none").mkdir()
    for seed in (0, 1):
        rows = [r | {"return_real": float("nan")} for r in healthy()]
        a_run(tmp_path / f"none/{seed}", dataclasses.replace(CONFIG, seed=seed), rows)
    assert 'id="groups"' not in page(find([tmp_path / "none"]), tmp_path), "nothing has been measured"


def test_what_a_run_says_is_text_and_no_markup(tmp_path):
    evil = dataclasses.replace(CONFIG, task='" onload="1" <script>alert("x")</script>&amp;\'')
    rows = [{**r, "<img src=x onerror=alert(1)>": 1.0, "diverged": 0.5} for r in healthy()]
    a_run(tmp_path / '<b>"javascript:', evil, rows)
    a_run(tmp_path / "<del>twice", evil, rows)
    a_run(tmp_path / "logged", dataclasses.replace(evil, data='<ins onclick="1">.npz'), rows)
    a_run(tmp_path / "other", dataclasses.replace(evil, seed=1, system="k-1", preset="paper"), rows)
    (tmp_path / "<i>damaged").mkdir()
    (tmp_path / "<i>damaged" / "metrics.csv").write_text("<u>")
    (tmp_path / "other" / "diagnostics.csv").write_text('iteration,real_steps,"error_1_0","<u>"\n1,3000,0.5,1\n')
    found = parsed([tmp_path], tmp_path)
    assert not {"script", "img", "b>", "i>", "u", "del", "ins"} & set(found.tags)
    assert found.references == []
    assert evil.task in found.text
    assert "<img src=x onerror=alert(1)>" in found.text
    assert '<b>"javascript:' in found.text
    assert "me-trpo, data=None, seed 0 (<del>twice)" in found.text
    assert '<ins onclick="1">.npz' in found.text


def test_a_large_video_is_a_link(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "VIDEO_BYTES", 5000)
    for number_, size in enumerate((3000, 3000, 1000)):
        run = a_run(tmp_path / f"runs/a b#{number_}?", dataclasses.replace(CONFIG, seed=number_))
        (run / "video.mp4").write_bytes(b"x" * size)
    found = parsed([tmp_path / "runs"], tmp_path / "out")
    assert len(found.references) == 2
    assert found.links == ["./../runs/a%20b%231%3F/video.mp4"]


def test_ten_runs_are_small(tmp_path):
    found = parsed(sorted(RESULTS.glob("laptop/HalfCheetah/*/seed-0"))[:10])
    assert "10 runs" in found.text
    text = page(find(sorted(RESULTS.glob("laptop/HalfCheetah/*/seed-0"))[:10]), tmp_path)
    assert len(text) < 500_000
    assert len(text) + pages.VIDEO_BYTES * 4 / 3 < 5_000_000


DAMAGE = [
    ("config.json", lambda text: text[: len(text) // 2], "config.json"),
    ("config.json", lambda text: text.replace('"seed"', '"weed"'), "weed"),
    ("config.json", lambda text: None, "config.json"),
    ("metrics.csv", lambda text: text[: len(text) // 2], "cut within a row"),
    ("metrics.csv", lambda text: text.splitlines()[0] + "\n", "expected a row for each iteration, got none"),
    ("metrics.csv", lambda text: "", "metrics.csv"),
    ("metrics.csv", lambda text: text.replace("\n3,", "\nthree,"), "metrics.csv"),
    ("metrics.csv", lambda text: text.replace("\n3,", "\n2,"), "expected iterations that go up"),
    ("metrics.csv", lambda text: text.replace("return_real,", "something,"), "expected the column return_real"),
    ("metrics.csv", lambda text: "\0\x80" + text, "metrics.csv"),
]


@pytest.mark.parametrize(("file", "damage", "said"), DAMAGE)
def test_a_damaged_run_is_named_and_left_out(tmp_path, capsys, caplog, file, damage, said):
    a_run(tmp_path / "runs/good")
    bad = a_run(tmp_path / "runs/bad") / file
    text = damage(bad.read_text())
    bad.unlink()
    if text is not None:
        bad.write_bytes(text.encode("latin-1"))
    assert report(tmp_path / "runs", "--json") == 0
    said_ = json.loads(capsys.readouterr().out)
    assert [run["path"] for run in said_["runs"]] == [str(tmp_path / "runs/good")]
    assert [one["path"] for one in said_["skipped"]] == [str(tmp_path / "runs/bad")]
    assert said in said_["skipped"][0]["why"]
    assert said_["skipped"][0]["why"].count("\n") == 0
    assert "runs/bad" in Page((tmp_path / "report.html").read_text()).text
    capsys.readouterr()
    assert report(tmp_path / "runs/bad", "--out", "none.html") == 2
    err = capsys.readouterr().err
    assert "expected at least one run that can be read, got none" in err
    assert said in err
    assert not Path("none.html").exists()


def test_what_is_no_run_is_one_message(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    for arguments, said in (
        (["empty"], "expected a run (config.json and metrics.csv), got none; start one with: metrpo train"),
        (["missing"], "missing: expected a run directory or a folder with runs inside, got nothing"),
        (["file"], "file: expected a run directory or a folder with runs inside, got a file"),
        ([], "report needs run directories, or folders with runs inside: metrpo report runs"),
    ):
        assert report(*arguments) == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert said in err
    a_run(tmp_path / "run")
    assert report("run", "--out", "file/page.html") == 2
    assert "cannot write file/page.html" in capsys.readouterr().err


def test_a_run_in_its_first_iteration_is_named(tmp_path):
    a_run(tmp_path / "fresh", rows=[])
    (tmp_path / "fresh" / "run.json").write_text("{}")
    a_run(tmp_path / "good")
    assert "fresh: no finished iteration yet" in parsed([tmp_path]).text
    alone = parsed([tmp_path / "fresh"])
    assert "fresh: no finished iteration yet" in alone.text


def test_the_command_says_the_warnings_and_where_the_page_is(tmp_path, capsys):
    a_run(tmp_path / "a", rows=[r | {"diverged": 0.5} for r in healthy()])
    assert report("a", "--out", "sub/page.html") == 0
    out = capsys.readouterr().out.splitlines()
    assert out[-1] == "sub/page.html"
    assert out[0].startswith("a: 50.0% of the imagined rollouts diverge since iteration 1: ")
    assert Path("sub/page.html").exists()
    assert report("a", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["report"] == "report.html"
    (run,) = said["runs"]
    assert [w["code"] for w in run["warnings"] if w["level"] == "warning"] == ["rollouts-diverge"]
    assert (run["task"], run["seed"], run["iterations"], run["finished"]) == ("Swimmer", 0, 12, True)
    assert run["return_real"] == pytest.approx(healthy()[-1]["return_real"])


def test_json_has_no_nan_and_names_what_differs(tmp_path, capsys):
    a_run(tmp_path / "a", rows=[r | dict.fromkeys(("return_real", "gap"), math.nan) for r in healthy()])
    a_run(tmp_path / "b", ONE)
    assert report(tmp_path, "--json") == 0
    said = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))
    assert said["runs"][0]["return_real"] is None
    assert said["differences"]["ensemble.members"] == [5, 1]


@pytest.mark.parametrize(
    "rows",
    [
        healthy(1),
        [{"iteration": 1, "real_steps": 0, "return_real": None}],
        [r | {"real_steps": 0} for r in healthy()],
        [r | dict.fromkeys(r.keys() - {"iteration", "real_steps"}, math.nan) for r in healthy()],
        [r | {"return_imagined": math.inf, "gap": math.inf, "return_real": 1e30} for r in healthy()],
        [r | {"return_real": 3.0, "gap": 0.0, "return_imagined": 3.0} for r in healthy()],
    ],
    ids=["one row", "nothing measured", "offline", "nan", "inf", "constant"],
)
def test_a_page_is_made_whatever_the_numbers(tmp_path, rows):
    a_run(tmp_path / "a", rows=rows)
    a_run(tmp_path / "b", ONE)
    text = page(find([tmp_path]), tmp_path)
    Page(text)
    assert not re.search(r'="[^"<>]*\b(nan|inf)\b', text), "no coordinate is nan"


def test_no_numbers_are_too_odd():
    """400 runs in which random cells hold nan, infinities, nothing, 1e300 and the like; warnings are errors."""
    values = [None, math.nan, math.inf, -math.inf, 0, 0.0, -1.0, 1e300, -1e300, 1e-300, 1, 5, 1000]
    for trial in range(400):
        draw = random.Random(trial)
        rows, often = healthy(draw.choice([1, 2, 3, 4, 7, 12])), draw.choice([0.2, 1.0])
        columns = [name for name in rows[0] if name not in ("iteration", "real_steps")]
        for name in draw.sample(columns, draw.randint(1, len(columns))):
            for row in rows:
                row[name] = draw.choice(values) if draw.random() < often else row[name]
        for config in (CONFIG, ONE):
            assert all(concern.text for concern in examine(rows, config))
        if trial % 5 == 0:
            odd = [{n: draw.choice(values) if "_" in n else v for n, v in row.items()} for row in details()]
            odd = [{**row, "real_steps": 3000 * row["iteration"]} for row in odd]
            found = FoundRuns([SeenRun(Path("a"), CONFIG, rows, odd), SeenRun(Path("b"), ONE, rows)], [])
            text = page(found, Path())
            Page(text)
            assert not re.search(r'="[^"<>a-z]*\b(nan|inf)\b', text), "no coordinate is nan"
            assert json.dumps(record(found))
            assert status_of(found.runs[0]).iteration == len(rows)


def test_runs_are_found_once_and_groups_share_their_settings(tmp_path):
    for seed in (0, 1):
        a_run(tmp_path / f"x/s{seed}", dataclasses.replace(CONFIG, seed=seed, iterations=10 + seed))
    a_run(tmp_path / "x/short", dataclasses.replace(CONFIG, imagine=ImagineConfig(horizon=10)))
    a_run(tmp_path / "x/one", ONE)
    a_run(tmp_path / "x/other", dataclasses.replace(CONFIG, task="Hopper"))
    (tmp_path / "x/s0/checkpoints").mkdir()
    (tmp_path / "x/s0/checkpoints/metrics.csv").write_text("")
    found = find([tmp_path, tmp_path / "x", tmp_path / "x/../x/one"])
    assert [r.path.name for r in found.runs] == ["one", "other", "s0", "s1", "short"]
    groups = {(g.task, g.label): [r.path.name for r in g.runs] for g in group(found.runs)}
    assert groups == {
        ("Swimmer", "k-1"): ["one"],
        ("Swimmer", "me-trpo, imagine.horizon=None"): ["s0", "s1"],
        ("Swimmer", "me-trpo, imagine.horizon=10"): ["short"],
        ("Hopper", "me-trpo"): ["other"],
    }
    with pytest.raises(RunDirectoryError, match="got nothing"):
        find([tmp_path / "none"])


def test_a_chart_puts_points_where_they_belong():
    import numpy as np

    x, y = np.array([0.0, 50.0, 100.0]), np.array([0.0, 10.0, np.nan])
    drawn = chart("t", [Line(x, y, "a", "c0")], "x", "", size=(380, 230), axes=Axes(frame=(0, 10)))
    assert numbers_in(drawn, "cx") == [46.0, 208.0]
    low, high = numbers_in(drawn, "cy")
    assert low > high, "y goes up"
    beyond = chart("t", [Line(x, np.array([1.0, 500.0, 2.0]), "a", "c0")], "x", "", axes=Axes(frame=(0, 10)))
    assert ">500<" in beyond
    assert len(numbers_in(beyond, "cx")) == 2
    many = chart(
        "t",
        [Line(np.arange(9.0), np.array([500.0] * 2 + [1.0] * 6 + [700.0]), "a", "c0")],
        "",
        "",
        axes=Axes(frame=(0, 9)),
    )
    assert (many.count(">500<"), many.count(">700<")) == (1, 1), "values of neighbours do not lie on each other"
    stacked = bars("t", ["a", "b"], np.array([[1.0, 2.0], [3.0, 0.0]]), [1, 2], "x", "")
    heights = numbers_in(stacked, "height")
    assert heights[2] == pytest.approx(3 * heights[0], abs=0.15), "three seconds are three times one"
    assert len(heights) == 3, "nothing is drawn for nothing"
    assert real_frame(np.array([0.0, 10.0]), np.array([5000.0, 9.0]))[1] == 25.0
    assert real_frame(np.array([0.0, 10.0]), np.array([5000.0, 40.0, 45.0, 50.0, 9.0]))[1] == 50.0, "it lasts"
    assert real_frame(np.array([0.0, 10.0]), np.array([5000.0, 4000.0, 3000.0, 2000.0]))[1] == 70.0
    assert [number(v) for v in (0.01234, 3.0, 1735.2, 2.5e6, math.nan)] == ["0.0123", "3", "1,735", "2.5M", "-"]


def test_a_curve_without_an_environment_has_no_real_return(tmp_path, monkeypatch):
    from metrpo.run import curve

    draw_curve(healthy(2), tmp_path / "curve.png", r"a $\task$, which is no formula")
    drawn = []
    monkeypatch.setattr(curve, "png_of", lambda figure: drawn.append(figure) or b"x")
    arm = read_metrics(RESULTS / "own/examples-robot-arm.py-task/learned-reward/seed-0/metrics.csv")
    cheetah = read_metrics(RESULTS / "laptop/HalfCheetah/me-trpo/seed-0/metrics.csv")
    for rows in (arm, cheetah):
        draw_curve(rows, tmp_path / "curve.png", "title")
    words = [[t.get_text() for a in f.axes if a.get_legend() for t in a.get_legend().get_texts()] for f in drawn]
    assert words[0] == [
        "collected (with exploration noise)",
        "imagined (models)",
        "models in which the policy improved",
    ]
    assert "real (deterministic policy)" in words[1]
    assert "gap: imagined - real" in words[1]
    labels = [[a.get_ylabel() for a in f.axes] for f in drawn]
    assert labels[0] == ["return of an episode", "models improved (%)"]
    assert labels[1] == ["return of an episode", "gap", "models improved (%)"]
