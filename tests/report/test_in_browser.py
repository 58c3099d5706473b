"""The report in a real browser without a network, where there is one: nothing is asked for, nothing lies on anything
else, and no phone must scroll sideways."""

import dataclasses
import io

import pytest

pytest.importorskip("websockets", reason="the browser is driven over a web socket")

from PIL import Image

from browser import Browser, chromium
from metrpo.config import EnsembleConfig
from metrpo.report.page import page
from metrpo.run.find import find
from places import RESULTS
from seen_runs import CONFIG, ONE, a_run, details, exploiting, healthy

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium here (apt install chromium)")


@pytest.fixture(scope="module")
def browser():
    with Browser(chromium()) as opened:
        yield opened


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Pages by name: of one run with every diagnostic, of runs that differ in much, of committed ones."""
    folder = tmp_path_factory.mktemp("pages")
    a_run(folder / "one", diagnostics=details(dimensions=18))
    a_run(folder / "many/exploited", ONE, exploiting())
    twenty = dataclasses.replace(CONFIG, system="k-20", ensemble=EnsembleConfig(members=20))
    rows = [r | {f"improved_{k}": 0.05 * k for k in range(20)} for r in details(40, 60)]
    a_run(folder / "many/twenty", twenty, healthy(40), rows)
    a_run(folder / "many/wide", dataclasses.replace(CONFIG, seed=1), [r | {"error_T": 1e12} for r in healthy(1)])
    a_run(folder / "many/long", dataclasses.replace(CONFIG, task="own/" + "VeryLongName" * 8), healthy(3))
    (folder / "many/cut").mkdir()
    (folder / "many/cut/metrics.csv").write_text("iteration,real_")
    found = {name: find([folder / name]) for name in ("one", "many")}
    found["committed"] = find(sorted(RESULTS.glob("*/HalfCheetah/*/seed-0")))
    for name, runs in found.items():
        (folder / f"{name}.html").write_text(page(runs, folder))
    return {name: folder / f"{name}.html" for name in found}


@pytest.mark.parametrize(
    ("name", "width", "dark"),
    [
        ("one", 390, False),
        ("one", 390, True),
        ("one", 1280, True),
        ("many", 390, False),
        ("many", 1280, False),
        ("committed", 390, False),
    ],
)
def test_a_page_fits_and_asks_for_nothing(browser, pages, name, width, dark):
    seen = browser.look(pages[name], width, dark, height=844)
    assert seen.requests == [pages[name].as_uri()]
    assert seen.complaints == []
    assert seen.width <= width
    assert seen.too_wide == []
    assert seen.overlapping == []
    picture = Image.open(io.BytesIO(seen.shot)).convert("L")
    light = sum(picture.histogram()[128:]) / (picture.width * picture.height)
    assert light < 0.2 if dark else light > 0.8
    assert len(picture.getcolors()) > 50, "something is drawn"


def test_the_browser_sees_what_must_not_be(browser, tmp_path):
    bad = tmp_path / "bad.html"
    bad.write_text(
        '<meta name="viewport" content="width=device-width"><img src="picture.png"><p style="width:500px">wide</p>'
        '<script>console.error("wrong")</script>'
        '<svg aria-label="a"><text y="20">one</text><text y="22">two</text></svg>'
    )
    seen = browser.look(bad, 390)
    assert seen.requests == [bad.as_uri(), (tmp_path / "picture.png").as_uri()]
    assert any("wrong" in one for one in seen.complaints)
    assert any("not loaded" in one for one in seen.complaints)
    assert seen.width > 390
    assert seen.too_wide == ["P wide"]
    assert seen.overlapping == ["a: one | two"]
