"""Budgets: one place says whether a run has used up its own."""

import dataclasses

import pytest

from metrpo import budget
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import has_spent
from metrpo.presets import preset
from metrpo.tune.search import Search
from metrpo.tune.space import Range


@pytest.mark.parametrize(
    ("given", "iteration", "real_steps", "spent"),
    [
        ({"iterations": 3}, 2, 900, False),
        ({"iterations": 3}, 3, 900, True),
        ({"real_steps": 1000}, 30, 999, False),
        ({"real_steps": 1000}, 1, 1000, True),
        ({"real_steps": 0, "iterations": 3}, 2, 0, False),
        ({"real_steps": 0, "iterations": 3}, 3, 0, True),
    ],
)
def test_runs_grids_and_searches_agree_on_a_spent_budget(given, iteration, real_steps, spent):
    rows = [{"iteration": iteration, "real_steps": real_steps}]
    config = dataclasses.replace(preset("Swimmer"), **given)
    assert budget.spent(config, rows) is spent
    assert has_spent(RunSpec("Swimmer", "me-trpo", 0, tuple(given.items()), "fast", ""), rows) is spent
    if len(given) == 1:
        assert Search("Swimmer", {"trpo.max_kl": Range(0.01, 0.1)}, **given).is_spent(rows) is spent
    assert not budget.spent(config, [])


@pytest.mark.parametrize(
    ("task", "budget_of", "iteration", "real_steps", "left"),
    [
        ("Swimmer", {"iterations": 20}, 5, 7500, 15),
        ("Swimmer", {"real_steps": 15_000}, 0, 0, None),
        ("Swimmer", {"real_steps": 15_000}, 2, 3000, 8),
        ("Swimmer", {"real_steps": 15_000}, 10, 15_000, 0),
        # The first iteration takes 3,000 random steps, the others what whole episodes take: 250 to 1,000.
        ("Ant", {"real_steps": 20_000}, 1, 3000, None),
        ("HalfCheetah-v5", {"real_steps": 50_000}, 2, 4000, 46),
        ("HalfCheetah-v5", {"real_steps": 50_000}, 25, 27_000, 23),
        ("Ant", {"real_steps": 20_000}, 41, 13_000, 28),
        ("Ant", {"real_steps": 2000}, 1, 2000, 0),
    ],
)
def test_the_iterations_left_are_those_that_a_run_will_have(task, budget_of, iteration, real_steps, left):
    config = dataclasses.replace(preset(task), **budget_of)
    assert budget.iterations_left(config, iteration, real_steps) == left
