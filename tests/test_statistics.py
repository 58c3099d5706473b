"""Statistics over few seeds: by hand, by their symmetries, and against the authors' own library and SciPy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import stats

from metrpo.statistics import (
    at_steps,
    caveat,
    fewest_seeds,
    iqm,
    probability_of_improvement,
    steps_to_reach,
    stratified_bootstrap,
)

nan = np.nan
# Few distinct values, for ties matter; whole numbers, so that sums are exact in any order.
whole = st.integers(-5, 5).map(float)


def tables(tasks=None):
    """Scores [seeds, tasks]."""
    return st.tuples(st.integers(1, 6), st.just(tasks) if tasks else st.integers(1, 4)).flatmap(
        lambda shape: arrays.arrays(np.float64, shape, elements=whole)
    )


def pairs_of_tables():
    """Two [seeds, tasks] with as many tasks."""
    return st.integers(1, 3).flatmap(lambda tasks: st.tuples(*[tables(tasks)] * 2))


# ---------------------------------------------------------------- interquartile mean


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([7.0], 7.0),
        ([1.0, 2.0, 30.0], 11.0),  # a quarter of three is no whole score: nothing is cut
        ([4.0, 1.0, 100.0, 2.0], 3.0),  # of 1 2 4 100 the middle two
        ([1.0, 2.0, 3.0, 4.0, 500.0], 3.0),
        ([8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, -1e9], 4.5),  # of -1e9 2 3 4 5 6 7 8 the middle four
    ],
)
def test_iqm_by_hand(scores, expected):
    assert iqm(np.array(scores)) == expected


def test_iqm_pools_seeds_and_tasks():
    scores = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, -99.0], [4.0, 999.0]])
    assert iqm(scores) == (2 + 3 + 4 + 10) / 4
    assert iqm([scores[:, 0], scores[:, 1]]) == iqm(scores)
    # Tasks with differing numbers of seeds: every score counts as much.
    assert iqm([np.array([1.0, 2.0, 3.0]), np.array([1000.0])]) == 2.5


def test_statistics_of_curves_are_those_of_every_point():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 5, 3, 4))
    np.testing.assert_allclose(iqm(x), [iqm(x[:, :, i]) for i in range(4)])
    got = probability_of_improvement(x, y)
    np.testing.assert_allclose(got, [probability_of_improvement(x[:, :, i], y[:, :, i]) for i in range(4)])


@given(tables())
def test_iqm_is_the_middle_of_the_sorted_scores(scores):
    ordered = sorted(scores.ravel())
    cut = len(ordered) // 4
    middle = ordered[cut : len(ordered) - cut]
    assert iqm(scores) == pytest.approx(sum(middle) / len(middle))
    assert middle[0] - 1e-9 <= iqm(scores) <= middle[-1] + 1e-9


@given(tables(), st.randoms(use_true_random=False), st.floats(-10, 10), st.floats(0.1, 10))
def test_iqm_knows_no_order_and_follows_shift_and_scale(scores, random, shift, scale):
    shuffled = scores.copy()
    for column in shuffled.T:
        random.shuffle(column)
    assert iqm(shuffled) == iqm(scores)
    assert iqm(scale * scores + shift) == pytest.approx(scale * iqm(scores) + shift, abs=1e-9)


def test_a_score_that_is_no_number_is_not_cut_off_as_an_outlier():
    scores = np.arange(8.0)
    scores[3] = nan
    assert np.isnan(iqm(scores))
    curves = np.arange(16.0).reshape(4, 2, 2)
    curves[0, 0, 1] = nan
    np.testing.assert_array_equal(np.isnan(iqm(curves)), [False, True])
    np.testing.assert_array_equal(np.isnan(probability_of_improvement(curves, np.ones((1, 2, 2)))), [False, True])
    np.testing.assert_array_equal(np.isnan(stratified_bootstrap(iqm, curves, repetitions=50)), [[False, True]] * 2)


# ---------------------------------------------------------------- probability of improvement


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        ([2.0], [1.0], 1.0),
        ([1.0], [2.0], 0.0),
        ([1.0], [1.0], 0.5),
        ([1.0, 3.0], [2.0, 4.0], 1 / 4),
        ([1.0, 2.0, 3.0], [2.0, 2.0], 1 / 2),  # 0, two ties, two wins: 3 of 6
        ([5.0, 2.0], [1.0, 2.0, 7.0], (2 + 0.5 + 1) / 6),
    ],
)
def test_probability_of_improvement_by_hand(x, y, expected):
    assert probability_of_improvement(np.array(x), np.array(y)) == pytest.approx(expected)


def test_every_task_counts_as_much_however_many_seeds_it_has():
    x = [np.array([1.0, 1.0, 1.0, 1.0]), np.array([0.0])]
    assert probability_of_improvement(x, [np.zeros(5), np.ones(1)]) == 0.5
    with pytest.raises(ValueError, match=r"zip\(\) argument 2 is shorter"):
        probability_of_improvement(x, [np.zeros(5)])


@given(pairs_of_tables())
def test_one_improves_as_far_as_the_other_does_not(pair):
    x, y = pair
    p = probability_of_improvement(x, y)
    assert 0 <= p <= 1
    assert p + probability_of_improvement(y, x) == pytest.approx(1)
    assert probability_of_improvement(x, x) == pytest.approx(0.5)
    assert probability_of_improvement(x + 0.5, x) >= 0.5
    assert probability_of_improvement(x + 100, y) == 1
    assert probability_of_improvement(x[::-1], y) == pytest.approx(p)
    assert probability_of_improvement(np.exp(x), np.exp(y)) == pytest.approx(p), "only the order counts"


@given(pairs_of_tables())
def test_probability_of_improvement_is_mann_whitneys_u(pair):
    x, y = pair
    expected = [
        stats.mannwhitneyu(a, b, method="asymptotic").statistic / (len(a) * len(b))
        for a, b in zip(x.T, y.T, strict=True)
        if len({*a, *b}) > 1  # SciPy's U of ties alone divides by their spread
    ]
    ties = x.shape[1] - len(expected)
    assert probability_of_improvement(x, y) == pytest.approx((sum(expected) + 0.5 * ties) / x.shape[1])


# ---------------------------------------------------------------- bootstrap


def mean(scores):
    return np.mean([task.mean(axis=0) for task in scores], axis=0)


def test_the_interval_of_a_mean_is_the_normal_distributions():
    scores = np.random.default_rng(0).normal(size=(400, 2)) * [1.0, 3.0]
    low, high = stratified_bootstrap(mean, scores, repetitions=4000)
    half = 1.96 * np.sqrt(np.var(scores, axis=0).sum() / 400) / 2
    center = scores.mean()
    assert (low, high) == (pytest.approx(center - half, abs=0.06 * half), pytest.approx(center + half, abs=0.06 * half))
    narrow = stratified_bootstrap(mean, scores, repetitions=4000, level=0.5)
    assert narrow[1] - narrow[0] == pytest.approx(2 * half * 0.6745 / 1.96, rel=0.06)


def test_seeds_are_redrawn_within_each_task():
    """Constant tasks, however far apart, leave no doubt; drawing across tasks would."""
    assert stratified_bootstrap(mean, np.tile([0.0, 100.0], (5, 1))) == (50, 50)
    drawn = []

    def watch(one, other):
        drawn.append(tuple(task.tolist() for task in (*one, *other)))
        return 0.0

    tasks = [np.arange(4.0), 10 + np.arange(3.0)], [20 + np.arange(5.0), 30 + np.arange(4.0)]
    stratified_bootstrap(watch, *tasks, repetitions=3000)
    for i, original in enumerate([*tasks[0], *tasks[1]]):
        column = np.array([d[i] for d in drawn])
        assert column.shape == (3000, len(original))
        assert set(column.ravel()) <= set(original)
        assert stats.chisquare(np.unique(column, return_counts=True)[1]).pvalue > 1e-4
    # Independently: of the first seeds drawn in each of the four, no pair goes together.
    first = np.array([[task[0] for task in d] for d in drawn])
    for i, j in itertools.combinations(range(4), 2):
        table = stats.contingency.crosstab(first[:, i], first[:, j]).count
        assert stats.chi2_contingency(table).pvalue > 1e-4


def test_a_seeds_curve_is_drawn_whole():
    """Points that are multiples of one another have intervals that are so too."""
    scores = np.random.default_rng(1).normal(size=(6, 3))
    curves = scores[:, :, None] * np.array([1.0, 2.0, -1.0, 0.0])
    low, high = stratified_bootstrap(iqm, curves)
    assert low.shape == high.shape == (4,)
    one = stratified_bootstrap(iqm, scores)
    np.testing.assert_allclose([low[0], high[0]], one)
    np.testing.assert_allclose([low[1], high[1]], 2 * np.array(one))
    np.testing.assert_allclose([low[2], high[2]], [-one[1], -one[0]])
    assert (low[3], high[3]) == (0, 0)
    listed = stratified_bootstrap(iqm, list(np.moveaxis(curves, 1, 0)))
    np.testing.assert_array_equal(listed, (low, high))


def test_tasks_may_differ_in_their_seeds():
    tasks = [np.random.default_rng(n).normal(size=(n, 2)) for n in (3, 5, 8)]
    low, high = stratified_bootstrap(iqm, tasks)
    assert low.shape == high.shape == (2,)
    assert np.all(low < iqm(tasks))
    assert np.all(iqm(tasks) < high)
    assert fewest_seeds(tasks) == 3


def test_the_seed_decides_the_interval():
    scores = np.random.default_rng(2).normal(size=(5, 2))
    same = stratified_bootstrap(iqm, scores, repetitions=100, seed=3)
    assert stratified_bootstrap(iqm, scores, repetitions=100, seed=3) == same
    assert stratified_bootstrap(iqm, scores, repetitions=100, seed=4) != same


@settings(max_examples=30)
@given(tables())
def test_an_interval_is_within_the_scores_and_grows_with_level(scores):
    wide = stratified_bootstrap(iqm, scores, repetitions=60, level=0.9)
    narrow = stratified_bootstrap(iqm, scores, repetitions=60, level=0.5)
    assert scores.min() - 1e-9 <= wide[0] <= narrow[0] <= narrow[1] <= wide[1] <= scores.max() + 1e-9


def test_few_seeds_give_a_range_and_say_so():
    one, two, three = np.array([4.0]), np.array([[4.0, 1.0], [9.0, 1.0]]), np.array([4.0, 5.0, 9.0])
    assert stratified_bootstrap(iqm, one) == (4, 4)
    assert caveat(one) == "One seed: the interval is the point itself."
    # Of two seeds, drawn (4, 4) or (9, 9), whatever the level; each has a quarter of the draws.
    assert stratified_bootstrap(mean, two, level=0.1) == (2.5, 5)
    assert caveat(two) == "Fewer than 3 seeds: the interval is the range of what resampling gives."
    assert caveat([three, one]) == caveat(two)
    assert caveat(three, one) == caveat(two)
    assert caveat(three) == ""
    low, high = stratified_bootstrap(mean, three, level=0.5)
    assert 4 < low < high < 9


@pytest.mark.parametrize("nothing", [np.zeros(0), np.zeros((0, 3)), np.zeros((3, 0)), [], [np.zeros(3), np.zeros(0)]])
def test_no_scores_are_an_error(nothing):
    with pytest.raises(ValueError, match="expected at least one seed of at least one task"):
        iqm(nothing)


# ---------------------------------------------------------------- against SciPy and the authors' library


def within_monte_carlo_error(ours, theirs, spread):
    """Ends of two intervals of 95 %, of 20,000 repetitions each, of a statistic with standard deviation `spread`.

    A quantile's standard error is sqrt(p (1 - p) / n) / density, in a normal distribution here 0.019 spreads; the ends
    must agree within five errors of their difference.
    """
    np.testing.assert_allclose(ours, theirs, atol=5 * np.sqrt(2) * 0.019 * spread)


def test_intervals_are_those_of_scipys_bootstrap():
    """SciPy resamples each of several samples independently: our tasks."""
    rng = np.random.default_rng(3)
    tasks = [rng.normal(size=5), 2 + rng.normal(size=8), rng.exponential(size=6)]
    theirs = stats.bootstrap(
        tasks, lambda *t: iqm(list(t)), n_resamples=20_000, method="percentile", rng=0, vectorized=False
    )
    ours = stratified_bootstrap(iqm, tasks, repetitions=20_000)
    within_monte_carlo_error(ours, theirs.confidence_interval, theirs.standard_error)
    assert ours[1] - ours[0] > 3 * theirs.standard_error


@given(pairs_of_tables())
def test_statistics_are_those_of_rliable(pair):
    metrics = pytest.importorskip("rliable.metrics")
    x, y = pair
    assert iqm(x) == pytest.approx(metrics.aggregate_iqm(x))
    assert probability_of_improvement(x, y) == pytest.approx(metrics.probability_of_improvement(x, y))


def rliable_intervals():
    """rliable's bootstrap stands on arch, whose version 7.2 cannot be imported beside pandas 3."""
    pytest.importorskip("rliable")
    try:
        from rliable import library
    except TypeError as error:
        if "deprecate_kwarg" not in str(error):
            raise
        pytest.skip("rliable needs arch, and arch 7.2 needs pandas < 3")
    # Its StratifiedBootstrap draws from NumPy's global state, whatever random_state it is given.
    np.random.seed(0)
    return library.get_interval_estimates


def test_intervals_are_those_of_rliable():
    estimates, rng = rliable_intervals(), np.random.default_rng(4)
    scores = rng.normal(size=(6, 3)) * [1.0, 2.0, 3.0]
    point, theirs = estimates({"x": scores}, lambda x: np.array([iqm(x)]), reps=20_000)
    ours = stratified_bootstrap(iqm, scores, repetitions=20_000)
    spread = (ours[1] - ours[0]) / 3.92
    within_monte_carlo_error(ours, theirs["x"][:, 0], spread)
    assert point["x"] == pytest.approx(iqm(scores))
    # Two systems, with differing numbers of seeds.
    pair = scores, 1.0 + rng.normal(size=(9, 3))
    _, theirs = estimates({"p": pair}, lambda x, y: np.array([probability_of_improvement(x, y)]), reps=20_000)
    ours = stratified_bootstrap(probability_of_improvement, *pair, repetitions=20_000)
    within_monte_carlo_error(ours, theirs["p"][:, 0], (ours[1] - ours[0]) / 3.92)


# ---------------------------------------------------------------- curves


@pytest.mark.parametrize(
    ("level", "expected"),
    [
        (-3.0, 100),
        (0.0, 100),
        (5.0, 150),
        (10.0, 200),
        (10.1, 300 + 100 * (10.1 - 4) / 16),  # falls back to 4 at 300, then 20 at 400
        (20.0, 400),
        (20.1, nan),
    ],
)
def test_steps_to_reach_by_hand(level, expected):
    got = steps_to_reach(np.array([100, 200, 300, 400]), np.array([0.0, 10.0, 4.0, 20.0]), level)
    assert got == pytest.approx(expected, nan_ok=True)


def test_points_that_are_no_numbers_are_left_out():
    steps = np.array([1.0, 2.0, 3.0, 4.0])
    assert steps_to_reach(steps, np.array([nan, nan, 3.0, 5.0]), 2.0) == 3
    assert steps_to_reach(steps, np.array([0.0, nan, 3.0, nan]), 1.5) == 2
    assert np.isnan(steps_to_reach(steps, np.full(4, nan), 0.0))
    assert np.isnan(steps_to_reach(np.zeros(0), np.zeros(0), 0.0))


curve = st.lists(st.tuples(st.integers(1, 1000), whole), min_size=1, max_size=8, unique_by=lambda point: point[0]).map(
    lambda points: np.array(sorted(points), np.float64).T
)


@given(curve, st.floats(-6, 6))
def test_a_curve_has_reached_the_level_there_and_not_before(points, level):
    steps, returns = points
    at = steps_to_reach(steps, returns, level)
    if np.isnan(at):
        assert returns.max() < level
        return
    assert steps[0] <= at <= steps[-1]
    assert np.interp(at, steps, returns) >= level - 1e-6
    assert np.all(returns[steps < at - 1e-9] < level)
    assert at == steps[0] or np.interp(at, steps, returns) == pytest.approx(level, abs=1e-6)


def test_curves_at_common_steps_by_hand():
    curves = [([10, 20, 40], [1.0, 3.0, 7.0]), ([15, 30], [0.0, 15.0])]
    got = at_steps(curves, np.array([5, 10, 15, 20, 25, 30, 35, 40, 41]))
    expected = [[nan, 1, 2, 3, 4, 5, 6, 7, nan], [nan, nan, 0, 5, 10, 15, nan, nan, nan]]
    np.testing.assert_allclose(got, expected)
    assert at_steps([([10], [2.0])], np.array([9, 10, 11])) == pytest.approx(np.array([[nan, 2, nan]]), nan_ok=True)


@given(curve, curve)
def test_curves_at_their_own_steps_are_themselves(one, other):
    got = at_steps([one, other], one[0])
    np.testing.assert_array_equal(got[0], one[1])
    outside = (one[0] < other[0][0]) | (one[0] > other[0][-1])
    np.testing.assert_array_equal(np.isnan(got[1]), outside)


@pytest.mark.parametrize(
    ("steps", "returns"), [([1, 1], [0, 1]), ([2, 1], [0, 1]), ([1, nan], [0, 1]), ([1, 2, 3], [0, 1]), (1, 0)]
)
def test_curves_must_be_curves(steps, returns):
    for use in (lambda: steps_to_reach(steps, returns, 0.5), lambda: at_steps([(steps, returns)], np.ones(1))):
        with pytest.raises(ValueError, match="increasing steps"):
            use()
