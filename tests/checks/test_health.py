"""Health warnings: each fires on rows made for it and says since when, and none fires on a healthy run."""

import dataclasses
import math
import re

import pytest

from metrpo.checks.health import CHECKS, examine
from metrpo.config import Config, EnsembleConfig, ImagineConfig, ValidateConfig
from metrpo.run.find import find
from places import RESULTS
from seen_runs import exploiting, healthy

CONFIG = Config("Swimmer", validate=ValidateConfig(max_updates=100))
NAN = math.nan


def changed(since, **columns):
    """The healthy run with other numbers from iteration `since` on."""
    return [row | (columns if row["iteration"] >= since else {}) for row in healthy()]


def codes(rows, config=CONFIG):
    return [concern.code for concern in examine(rows, config)]


def test_a_healthy_run_has_none_at_any_length():
    assert [[c for c in examine(healthy(n), CONFIG) if c.level == "warning"] for n in range(13)] == [[]] * 13
    assert codes(healthy(3)) == ["model-exploited"], "a note, on little data"
    assert [codes(healthy(n)) for n in range(6, 13)] == [[]] * 7


def falling():
    return [r | {"return_real": 30.0, "gap": 0.0} if r["iteration"] >= 9 else r for r in healthy()]


ONE_MODEL = dataclasses.replace(CONFIG, ensemble=EnsembleConfig(members=1))

CASES = [
    ("model-exploited", exploiting(), CONFIG, 5, "Imagined return 4.0 times the real one"),
    ("return-fell", falling(), CONFIG, 9, "Return 30, after"),
    ("no-improvement", changed(1, return_real=5.0, gap=0.0), CONFIG, 1, "No return above the first one, 5, in 12"),
    ("few-evaluation-episodes", changed(1, return_real_std=900.0), CONFIG, 1, "Standard error of the return 201"),
    ("member-apart", changed(7, validation_loss_3=9.0), CONFIG, 7, "Validation loss of model 3 is 9"),
    ("models-blind", changed(8, error_1=1.4), CONFIG, 8, "Model error 1.4 times that of predicting no change"),
    (
        "validation-loss-rising",
        changed(8, **{f"validation_loss_{k}": 20.0 for k in range(5)}),
        CONFIG,
        8,
        "Validation loss 20",
    ),
    ("not-finite", changed(12, return_imagined=NAN), CONFIG, 12, "return_imagined is not a finite number"),
    ("not-evaluated", changed(10, return_real=NAN, gap=NAN), CONFIG, 10, "No real return"),
    (
        "not-evaluated",
        changed(1, return_real=NAN, gap=NAN, failed_evaluation=1),
        CONFIG,
        1,
        "No real return",
    ),
    ("unfit-dimensions", changed(2, unfit_dimensions=3), CONFIG, 2, "3 observed dimensions with an offset or a scale"),
    ("failed-episodes", changed(3, failed_episodes=2), CONFIG, 3, "20 real episodes left out"),
    ("std-collapsed", changed(4, mean_std=0.05), CONFIG, 4, "Standard deviation of the policy 0.05, at first 1"),
    ("policy-saturated", changed(5, saturated=0.8), CONFIG, 5, "80% of the policy's mean actions beyond the limits"),
    ("updates-rejected", changed(3, rejected_steps=80, updates=99), CONFIG, 3, "81% of the updates rejected"),
    ("updates-rejected", changed(11, kl=1e-5), CONFIG, 11, "Updates of KL 1e-05"),
    ("nothing-accepted", changed(9, accepted_updates=0), CONFIG, 9, "No policy update accepted in 4 iterations"),
    (
        "nothing-accepted",
        [r | {"accepted_updates": 0 if r["iteration"] % 2 else 50} for r in healthy()],
        CONFIG,
        3,
        "No policy update accepted in 5 of 10 iterations",
    ),
    ("validation-never-stops", changed(2, updates=100), ONE_MODEL, 1, "All 100 policy updates made in each of 12"),
    ("rollouts-diverge", changed(6, diverged=0.2), CONFIG, 6, "20.0% of the imagined rollouts diverge"),
    ("end-untrusted", changed(10, end_recall=0.1), CONFIG, 10, "10% of the real ends predicted"),
    ("end-untrusted", changed(10, end_false_alarms=0.03), CONFIG, 10, "3.0% of other steps mistaken for an end"),
    ("end-untrusted", changed(10, end_error=0.2), CONFIG, 10, "calibration error 20.0%"),
]


@pytest.mark.parametrize("rows", [c[1] for c in CASES], ids=[c[0] for c in CASES])
def test_to_the_critics_nothing_is_recommended_that_they_do_not_read(rows):
    config = dataclasses.replace(CONFIG, improver="actor-critic", ensemble=EnsembleConfig(members=1))
    unread = r"\b(trpo|imagine|policy|validate)\.[a-z_]+|collect\.max_std|beyond the limits"
    for concern in examine(rows, config):
        assert "validate.patience" not in concern.text
        assert concern.code != "validation-never-stops", "their vote stops nothing"
        if concern.code != "nothing-accepted":
            assert not re.search(unread, concern.text), concern.text


@pytest.mark.parametrize(("code", "rows", "config", "since", "said"), CASES, ids=[c[0] for c in CASES])
def test_each_warning_says_what_and_since_when(code, rows, config, since, said):
    found = {concern.code: concern for concern in examine(rows, config)}
    assert code in found
    assert found[code].since == since
    assert said in found[code].measured
    assert found[code].text == (
        f"{found[code].measured} since iteration {since}: {found[code].meaning}; {found[code].help}"
    )
    assert set(found) - {code} <= {"no-improvement", "few-evaluation-episodes"}, "one cause, one warning"


def test_a_policy_that_earns_less_than_nothing_does_is_told():
    idle = {"doing nothing": 120.0, "random actions": -3.0}
    found = {c.code: c for c in examine(healthy(), CONFIG, idle)}
    assert found["no-skill"].since == 1
    assert found["no-skill"].level == "warning"
    assert "while doing nothing earns 120" in found["no-skill"].measured
    assert [c.level for c in examine(healthy(3), CONFIG, idle) if c.code == "no-skill"] == ["note"], "it has time"
    assert "no-skill" not in [
        c.code for c in examine(healthy(), CONFIG, {"doing nothing": 5.0, "random actions": -3.0})
    ]
    other = {"no-improvement", "few-evaluation-episodes", "no-skill", "model-exploited"}
    assert set(found) <= other


def test_a_task_solved_at_once_is_no_warning():
    rows = changed(1, return_real=500.0, return_real_std=1.0, gap=0.0)
    levels = [
        [c.level for c in examine(rows, CONFIG, yardsticks) if c.code == "no-improvement"]
        for yardsticks in ({}, {"doing nothing": 499.9}, {"doing nothing": 5.0, "random actions": -3.0})
    ]
    assert levels == [["warning"], ["warning"], ["note"]]


def test_every_check_has_a_case():
    fired = {check.__name__ for check in CHECKS for _, rows, config, *_ in CASES if check(rows, config)}
    assert fired == {check.__name__ for check in CHECKS}


def test_what_has_passed_is_no_warning():
    for column, value in (("diverged", 0.5), ("mean_std", 0.01), ("kl", 0.0), ("validation_loss_2", 50.0)):
        rows = [r | {column: value} if r["iteration"] < 11 else r for r in healthy()]
        assert codes(rows) == []


def test_settings_count():
    no_stop = dataclasses.replace(ONE_MODEL, validate=ValidateConfig(max_updates=100, rule="no_early"))
    assert "validation-never-stops" not in codes(changed(1, updates=100), no_stop)
    bonus = dataclasses.replace(CONFIG, imagine=ImagineConfig(disagreement=1.0))
    assert "model-exploited" not in codes(exploiting(), bonus), "the imagined return holds the bonus"
    assert "few-evaluation-episodes" in codes(healthy(), dataclasses.replace(CONFIG, evaluation_episodes=1))
    helps = {c.code: c.help for c in examine(exploiting(), ONE_MODEL)}
    assert helps["model-exploited"].startswith("try five models instead of one (ensemble.members)")


def test_one_bad_fit_is_not_yet_blind():
    assert "models-blind" not in codes(changed(12, error_1=1.4))
    assert "models-blind" in codes(changed(11, error_1=1.4))


def test_an_exploited_run_says_where_its_models_fail():
    def meaning(**columns):
        rows = [r | (columns if r["iteration"] == 12 else {"error_1": 5.0, "outside": 0.2}) for r in exploiting()]
        return next(c.meaning for c in examine(rows, CONFIG) if "exploited" in c.code)

    assert meaning(outside=0.64, error_5=0.9, error_T=0.99).endswith(
        "errors (64% of the imagined states lie outside the data)"
    )
    assert meaning(outside=0.0, error_5=1.2, error_T=NAN).endswith(
        "errors (after 5 steps predictions are worse than no change)"
    )
    assert meaning(outside=1.0, error_T=3.0).endswith(
        "states lie outside the data, and after an imagined episode predictions are worse than no change)"
    )
    assert meaning(outside=NAN, error_5=NAN, error_T=NAN).endswith("the policy exploits the models' errors")


def test_negative_returns_and_returns_through_zero():
    rows = [r | {"return_real": r["return_real"] - 300, "return_imagined": 0.0} for r in healthy()]
    rows = [r | {"gap": -r["return_real"]} for r in rows]
    found = {c.code: c for c in examine(rows, CONFIG)}
    assert found["model-exploited"].measured.startswith("Imagined return 0, real return -200")
    # A small gap where the return happens to be near zero, of a run that has come a long way, is none.
    through = [r | {"return_real": 50.0 * i - 550, "gap": 40.0} for i, r in enumerate(healthy())]
    assert "model-exploited" not in codes(through)


def test_rows_of_other_methods_and_without_an_environment():
    few = ("iteration", "real_steps", "return_real", "return_real_std", "return_collected", "mean_std")
    assert codes([{k: r.get(k) for k in few} for r in healthy()], dataclasses.replace(CONFIG, method="trpo")) == []
    unplayed = changed(1, return_real=NAN, return_real_std=NAN, gap=NAN)
    assert codes(unplayed) == []
    empty = [dict.fromkeys(r) | {"iteration": r["iteration"], "real_steps": 1} for r in healthy()]
    assert codes(empty) == []


@pytest.fixture(scope="module")
def committed():
    found = find([RESULTS])
    assert not found.skipped
    return {str(r.path.relative_to(RESULTS)): examine(r.rows, r.config) for r in found.runs}


def test_healthy_committed_runs_have_no_warning(committed):
    warned = {
        name: [c.code for c in concerns if c.level == "warning"]
        for name, concerns in committed.items()
        if "/me-trpo/" in name and any(c.level == "warning" for c in concerns)
    }
    # Two runs whose models promise more than is earned: Ant after ten iterations, 240 for 92, and the seed of
    # HalfCheetah that fell from 90 to 63 while its models promised 99.
    assert warned == {
        "laptop/Ant/me-trpo/seed-0": ["model-exploited"],
        "fast-after/HalfCheetah/me-trpo/seed-5": ["model-exploited"],
    }


def test_committed_runs_with_one_model_are_named(committed):
    for seed in (0, 1):
        warnings = {c.code for c in committed[f"laptop/HalfCheetah/k-1/seed-{seed}"] if c.level == "warning"}
        assert {"model-exploited", "validation-never-stops"} <= warnings
    assert "return-fell" in [c.code for c in committed["laptop/HalfCheetah/k-1/seed-0"]]


def test_committed_diagnostics_tell_five_models_from_one(committed):
    runs = {r.path.parent.name: r for r in find([RESULTS / "diagnostics"]).runs}
    assert set(runs) == {"me-trpo", "k-1"}
    assert all(len(r.details) == len(r.rows) == 8 for r in runs.values())
    (one,) = [c for c in committed["diagnostics/HalfCheetah/k-1/seed-0"] if c.code == "model-exploited"]
    assert one.measured == "Imagined return 3.9 times the real one (mean of 3 iterations)"
    assert "54% of the imagined states lie outside the data" in one.meaning
    assert not [c for c in committed["diagnostics/HalfCheetah/me-trpo/seed-0"] if c.level == "warning"]


def test_the_page_has_a_row_for_each():
    page = (RESULTS.parent / "docs" / "report.md").read_text()
    assert all(f"| `{code}` |" in page for code, *_ in CASES)
