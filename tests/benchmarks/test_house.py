"""What `benchmarks/tools/house.py` counts: one word for one thing, and functions of few parameters."""

import runpy

import pytest

from places import ROOT

KEPT = ("functions of more than 7 parameters", "module names that stand twice", "public class names that stand twice")


@pytest.fixture
def measure():
    return runpy.run_path(str(ROOT / "benchmarks/tools/house.py"))["measure"]


def test_names_stand_once_and_functions_take_few_parameters(measure):
    numbers = measure(ROOT)
    assert {name: numbers[name] for name in KEPT} == {name: [] for name in KEPT}


def test_what_is_counted_is_named(measure, tmp_path):
    for file, text in {
        "src/one/search.py": "class Scale: ...\n",
        "src/two/search.py": "Scale = dict[str, int]\ndef wide(a, b, c, d, *, e, f, g, h): ...\n",
        "tests/test_it.py": "import it\nit._hidden()\n",
    }.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    numbers = measure(tmp_path)
    assert numbers["module names that stand twice"] == ["search: src/one/search.py, src/two/search.py"]
    assert numbers["public class names that stand twice"] == ["Scale: src/one/search.py, src/two/search.py"]
    assert numbers["functions of more than 7 parameters"] == ["src/two/search.py:wide"]
    assert numbers["private accesses in tests"] == 1
