"""Numbers of things in words: one is one, and no message says "1 iterations"."""

import re
from pathlib import Path

import pytest

import metrpo
from metrpo.counting import counted, named_value

NOUNS = "iterations|episodes|actions|steps|real steps|runs|trials|seeds|updates|numbers"


@pytest.mark.parametrize(("n", "said"), [(0, "0 steps"), (1, "1 step"), (2, "2 steps"), (2000, "2,000 steps")])
def test_one_is_one(n, said):
    assert counted(n, "step") == said


def test_messages_count_by_it():
    """What is written by hand before a noun is a constant of ours, above 1, or a total that is compared with."""
    by_hand = re.compile(rf"\\{{(?!counted)[^{{}}A-Z]*\\}} ({NOUNS})\\b")
    found = [
        f"{path.name}: {line.strip()}"
        for path in Path(metrpo.__file__).parent.rglob("*.py")
        if "bench" not in path.parts
        for line in path.read_text().splitlines()
        if by_hand.search(line) and "expected at least" not in line
    ]
    assert found == []


def test_values_in_names():
    values = [5, (1024, 1024), ("gain=2.0", "mode=a"), True]
    assert [named_value(value) for value in values] == ["5", "1024x1024", "gain=2.0+mode=a", "True"]
