"""The rule that stops the policy phase: the share of models that a policy improves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from metrpo.config import ValidateConfig
from metrpo.policy.validate import RULES, ensemble_rule, fraction_improved

CONFIG = ValidateConfig()
nan, inf = np.nan, np.inf


def improved_in(count, of):
    """Values and reference of `of` models, `count` of which improve, the others getting worse; shuffled."""
    reference = np.linspace(-5, 5, of).astype(np.float32)
    gains = np.random.default_rng(of).permutation(np.where(np.arange(of) < count, 0.5, -0.5))
    return (reference + gains).astype(np.float32), reference


@pytest.mark.parametrize(
    ("count", "of", "accepted"),
    [
        (0, 1000, False),
        (699, 1000, False),
        (700, 1000, True),
        (1000, 1000, True),
        (0, 5, False),
        (3, 5, False),
        (4, 5, True),
        (5, 5, True),
        (7, 10, True),
        (6, 10, False),
        (0, 1, False),
        (1, 1, True),
    ],
)
def test_seventy_percent_of_the_models_must_improve(count, of, accepted):
    verdict = ensemble_rule(*improved_in(count, of), CONFIG)
    assert verdict.accepted is accepted
    assert verdict.fraction_improved == pytest.approx(count / of)


@pytest.mark.parametrize("of", [10, 20, 30, 50, 70, 90, 110, 1000])
def test_exactly_the_threshold_is_enough(of):
    """7/10 in floats, for every size of ensemble that can have it; and one model less is not."""
    assert ensemble_rule(*improved_in(7 * of // 10, of), CONFIG).accepted
    assert not ensemble_rule(*improved_in(7 * of // 10 - 1, of), CONFIG).accepted


def test_a_tie_is_no_improvement():
    same = np.array([1.0, 2.0, 3.0, 4.0, 5.0], np.float32)
    assert fraction_improved(same, same) == 0
    assert not ensemble_rule(same, same, CONFIG).accepted
    three_better = same + np.array([1, 1, 1, 0, 0], np.float32)
    assert ensemble_rule(three_better, same, CONFIG) == (False, pytest.approx(0.6))
    assert ensemble_rule(three_better + np.array([0, 0, 0, 1e-6, 0]), same, CONFIG).accepted


def test_any_gain_however_small_is_one():
    reference = np.ones(5, np.float32)
    assert fraction_improved(np.nextafter(reference, np.float32(2)), reference) == 1


@pytest.mark.parametrize(
    ("new", "old", "improved"),
    [
        (nan, 1.0, False),
        (nan, nan, False),
        (inf, 1.0, False),
        (-inf, 1.0, False),
        (1.0, nan, True),
        (-1e9, nan, True),
        (1.0, -inf, True),
        (1.0, inf, False),
    ],
)
def test_a_diverged_model_never_vouches_and_a_recovered_one_does(new, old, improved):
    assert fraction_improved(np.array([new]), np.array([old])) == improved
    # Among others it is one vote, no more.
    values, reference = np.array([2.0, 2.0, 2.0, 0.0, new]), np.array([1.0, 1.0, 1.0, 1.0, old])
    assert ensemble_rule(values, reference, CONFIG).accepted == improved


@given(st.lists(st.tuples(st.floats(), st.floats()), min_size=1, max_size=12), st.floats(0, 1))
def test_the_rule_is_the_count_of_the_models(pairs, threshold):
    count = sum(1 for new, old in pairs if abs(new) < inf and (new > old or old != old))
    values, reference = np.array(pairs).T
    verdict = ensemble_rule(values, reference, ValidateConfig(threshold=threshold))
    assert verdict.fraction_improved == pytest.approx(count / len(pairs))
    assert verdict.accepted == (count / len(pairs) >= threshold)


def test_the_rule_stands_in_the_table():
    assert RULES[CONFIG.rule] is ensemble_rule
