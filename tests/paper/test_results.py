"""What the README claims is what the committed runs show."""

import csv
import json
import runpy
import subprocess

import pytest

from metrpo import read_metrics
from metrpo.paper.figures import FIGURES, runs_there
from metrpo.paper.summary import as_markdown
from metrpo.paper.summary import summarise as summarise_figure
from metrpo.run.files import folder_name
from metrpo.speed.measure import BenchReport
from places import ROOT

RUNS = sorted(path.parent for path in (ROOT / "results").glob("*/*/*/seed-*/metrics.csv"))


def test_the_table_script_takes_every_committed_run():
    """Those of methods without models, which have no gap, too."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "summarise.py"))
    table = script["table"]([ROOT / "results"])
    assert table.count("\n") > 50
    for system in ("ppo", "ddpg", "trpo", "svg-inf"):
        (row,) = [line for line in table.splitlines() if line.startswith(f"| laptop | Swimmer | {system} |")]
        assert row.split(" | ")[10] == "-", "no gap"
    assert "nan" not in table


def test_make_train_takes_a_directory_with_a_space(tmp_path):
    (tmp_path / "metrpo").write_text('#!/bin/sh\nprintf "%s|" "$@"\n')
    (tmp_path / "metrpo").chmod(0o755)
    (tmp_path / "ready").touch()
    make = ["make", "-s", "train", f"BIN={tmp_path}", f"READY={tmp_path}/ready"]
    for run_dir, expected in (("", ""), ("runs/my 'own' run", "--run-dir|runs/my 'own' run|")):
        ran = subprocess.run([*make, f"RUN_DIR={run_dir}"], cwd=ROOT, capture_output=True, text=True, check=True)
        assert ran.stdout == f"train|Swimmer|{expected}"


def test_what_the_readme_writes_is_ignored_by_git():
    written = ["report.html", "curves.png", "swim.py", "swim.gif", "swim.onnx", "runs/a/config.json"]
    ran = subprocess.run(["git", "check-ignore", *written], cwd=ROOT, capture_output=True, text=True)
    if ran.returncode == 128:
        pytest.skip("not a git checkout")
    assert ran.stdout.split() == written


def test_there_are_results():
    assert len(RUNS) >= 3


@pytest.mark.parametrize("run", RUNS, ids=lambda run: str(run.relative_to(ROOT / "results")))
def test_a_result_is_whole(run):
    config = json.loads((run / "config.json").read_text())
    about = json.loads((run / "run.json").read_text())
    rows = read_metrics(run / "metrics.csv")
    assert folder_name(config["task"]) == run.parent.parent.name
    assert f"seed-{config['seed']}" == run.name
    assert len(about["commit"]) == 40, "run from a clean commit"
    assert (run / "curve.png").stat().st_size > 0
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))


def test_the_tables_are_those_that_the_metrics_give(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    fill = runpy.run_path(str(ROOT / "benchmarks" / "fill_tables.py"))
    texts = {page: page.read_text() for page in fill["PAGES"]}
    assert sum(text.count("<!-- runs: ") for text in texts.values()) >= 4
    for page, text in texts.items():
        assert fill["with_runs"](text) == text, f"{page}: run: python benchmarks/fill_tables.py"
    assert fill["headline"].table() in (ROOT / "README.md").read_text(), "run: python benchmarks/fill_tables.py"
    assert fill["mbbl_table"].table() in (ROOT / "docs" / "environments.md").read_text()
    assert fill["long_table"].table() in (ROOT / "docs" / "actor-critic.md").read_text()


@pytest.mark.parametrize("name", FIGURES)
def test_a_figures_table_is_the_one_that_the_metrics_give(name):
    """The page of the reproduction and the files beside the pictures."""
    out = ROOT / "results" / "laptop"
    table = as_markdown(summarise_figure(name, runs_there(name, "laptop", (), out), out))
    again = "run: metrpo reproduce all --out results/laptop --no-run"
    assert (out / "figures" / f"{name}.md").read_text() == table, again
    assert table in (ROOT / "docs" / "reproduction.md").read_text(), again
    assert (out / "figures" / f"{name}.png").stat().st_size > 0


def test_the_performance_table_is_the_recorded_one():
    recorded = json.loads((ROOT / "results" / "performance" / "bench.json").read_text())
    text = BenchReport.of(recorded).text()
    assert text in (ROOT / "docs" / "performance.md").read_text(), "paste what BenchReport.of(bench.json).text() gives"


def test_of_every_mutant_that_survived_it_is_said_why():
    out = ROOT / "results" / "mutation"
    tables = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in out.glob("*.csv")}
    explained = {(row["module"], row["before"], row["after"]) for row in tables.pop("equivalent") if row["why"]}
    assert len(tables) == 5
    for module, rows in tables.items():
        for row in rows:
            known = (module, row["before"], row["after"]) in explained
            assert row["outcome"] in ("killed", "timeout") or known, f"{module}, line {row['line']}: {row['after']}"


@pytest.mark.parametrize("task", ["delayed.py-cart", "delayed.py-cheetah", "half_seen.py-pendulum"])
def test_the_docs_say_what_a_history_is_worth(task):
    page = (ROOT / "docs" / "environments.md").read_text()
    means = []
    for history, bold in ((1, ""), (3, "**")):
        seeds = (ROOT / "results" / "history" / f"examples-{task}" / f"me-trpo,history={history}").glob("seed-*")
        last = [read_metrics(seed / "metrics.csv")[-1] for seed in sorted(seeds)]
        returns = [row["return_real"] for row in last]
        assert ([row["real_steps"] for row in last]) == [10_000] * 3
        means.append(sum(returns) / 3)
        assert f"| {history} | {bold}{means[-1]:.1f}{bold} | {min(returns):.1f} |" in page
    assert means[1] > means[0]
