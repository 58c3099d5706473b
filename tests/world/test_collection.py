"""Collecting real episodes: the loop, the noise, the seeds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import probe
from metrpo.config import CollectConfig
from metrpo.world import collection as real
from metrpo.world import env_returns

ZERO = lambda state: np.zeros(2)  # noqa: E731


def collect(task=probe.PROBE, mean=ZERO, seed=0, **settings):
    config = CollectConfig(**{"steps": 100, "max_std": 0.2, **settings})
    explorer = lambda rng: real.explore(mean, config, rng)  # noqa: E731
    return real.collect(task, explorer, config.steps, np.random.default_rng(seed))


@pytest.mark.parametrize(("steps", "episodes"), [(1, 1), (20, 1), (21, 2), (100, 5), (101, 6)])
def test_whole_episodes_until_at_least_the_steps(steps, episodes):
    lengths = [len(e.rewards) for e in collect(steps=steps)]
    assert lengths == [20] * episodes


def test_episodes_that_end_early_count_by_their_length():
    episodes = collect(probe.ENDING_PROBE, max_std=3.0, steps=150)
    lengths = [len(e.rewards) for e in episodes]
    assert sum(lengths[:-1]) < 150 <= sum(lengths)
    assert min(lengths) < 20, "the case must have early ends"
    for e in episodes:
        assert e.terminated == bool(probe.beyond(e.states[-1]))
        assert not np.any(probe.beyond(e.states[1:-1]))
        assert e.terminated or len(e.rewards) == 20


def test_states_actions_and_rewards_belong_together():
    for e in collect(max_std=3.0):
        assert [x.dtype for x in e[:3]] == [np.float64, np.float32, np.float32]
        assert (len(e.states), len(e.actions)) == (21, 20)
        np.testing.assert_allclose(e.states[1:], e.states[:-1] @ probe.A.T + e.actions @ probe.B.T, atol=1e-5)
        np.testing.assert_allclose(e.rewards, probe.reward(e.states[:-1], e.actions, e.states[1:]), rtol=1e-4)


def test_actions_are_clipped_as_executed():
    actions = np.concatenate([e.actions for e in collect(max_std=3.0, steps=400)])
    assert np.abs(actions).max() == 1
    assert 0.2 < np.mean(np.abs(actions) == 1) < 0.8


@pytest.mark.parametrize("std_per", ["episode", "step"])
def test_without_noise_the_mean_acts(std_per):
    def mean(state):
        return np.array([0.1, -0.2]) + 0.3 * state[::-1]

    for e in collect(mean=mean, max_std=0.0, std_per=std_per):
        np.testing.assert_allclose(e.actions, [mean(s) for s in e.states[:-1]], atol=1e-6)


def test_the_noise_is_added_to_the_mean():
    mean = np.array([0.2, -0.3])
    actions = np.concatenate([e.actions for e in collect(mean=lambda s: mean, max_std=0.1, steps=2000)])
    np.testing.assert_allclose(actions.mean(0), mean, atol=0.01)


@pytest.mark.parametrize("power", [1.0, 3.0])
def test_one_std_per_episode_is_a_power_of_a_uniform_draw(power):
    episodes = collect(probe.LONG_PROBE, max_std=0.2, std_power=power, steps=200 * 150)
    stds = [e.actions.std() for e in episodes]
    assert stats.kstest(stds, stats.powerlaw(1 / power, scale=0.2).cdf).pvalue > 1e-3
    # within an episode the noise is Gaussian: normalised, all of it is N(0, 1)
    z = np.concatenate([e.actions / s for e, s in zip(episodes, stds, strict=True)])
    assert stats.kurtosis(z.ravel()) == pytest.approx(0, abs=0.1)
    assert abs(np.corrcoef(z.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(z[:-1, 0], z[1:, 0])[0, 1]) < 0.03


@pytest.mark.parametrize("std_per", ["episode", "step"])
def test_independent_noise_is_drawn_in_the_order_of_old_runs(std_per):
    """A standard deviation, then the noise of its steps: a run from before any other setting resumes as it was."""
    act = real.explore(ZERO, CollectConfig(max_std=2.0, std_power=3.0, std_per=std_per), np.random.default_rng(3))
    rng = np.random.default_rng(3)
    width = 2.0 * rng.uniform() ** 3
    for step in range(4):
        if step and std_per == "step":
            width = 2.0 * rng.uniform() ** 3
        np.testing.assert_array_equal(act(np.zeros(2)), width * rng.standard_normal(2))


def test_correlated_noise_is_as_strong_and_keeps_its_direction():
    """A first-order autoregressive process: the correlation k steps apart is that of one step to the power k."""
    episodes = collect(probe.LONG_PROBE, max_std=0.2, noise_correlation=0.8, steps=200 * 150)
    stds = [max(e.actions.std(), 1e-3) for e in episodes]
    assert stats.kstest(stds, stats.uniform(scale=0.2).cdf).pvalue > 1e-3
    z = np.array([e.actions / s for e, s in zip(episodes, stds, strict=True)])
    for apart in (1, 3, 10):
        assert np.mean(z[:, :-apart] * z[:, apart:]) == pytest.approx(0.8**apart, abs=0.05)
    assert np.mean(z[:, 0] ** 2) == pytest.approx(1.0, abs=0.2), "from the first step on"
    assert abs(np.mean(z[..., 0] * z[..., 1])) < 0.05
    assert abs(np.mean(z[:-1, -1] * z[1:, 0])) < 0.2, "each episode has noise of its own"


def test_one_std_per_step_varies_within_the_episode():
    episodes = collect(probe.LONG_PROBE, max_std=0.2, steps=200 * 150, std_per="step")
    stds = np.array([e.actions.std() for e in episodes])
    # a mixture over u ~ U[0, 1]: variance 1/3, excess kurtosis 3 E[u^4] / E[u^2]^2 - 3 = 2.4
    np.testing.assert_allclose(stds, 0.2 / np.sqrt(3), rtol=0.25)
    z = np.concatenate([e.actions for e in episodes])
    assert z.std() == pytest.approx(0.2 / np.sqrt(3), rel=0.02)
    assert stats.kurtosis(z.ravel()) == pytest.approx(2.4, abs=0.4)
    # dimensions share the standard deviation of a step, not the Gaussian (the bug in the authors' code)
    assert abs(np.corrcoef(z.T)[0, 1]) < 0.03
    assert np.corrcoef(np.abs(z.T))[0, 1] > 0.2


def test_an_acting_policy_is_drawn_for_every_episode():
    drawn = []

    def draw(rng):
        drawn.append(rng.normal())
        return lambda state: np.full(2, np.tanh(drawn[-1]))

    episodes = real.collect(probe.PROBE, draw, 60, np.random.default_rng(0))
    assert len(drawn) == len(set(drawn)) == 3
    for e, d in zip(episodes, drawn, strict=True):
        np.testing.assert_allclose(e.actions, np.tanh(d), rtol=1e-6)


def test_the_seed_decides_everything():
    for task in (probe.PROBE, probe.ENDING_PROBE):
        one, same, other = collect(task, seed=5), collect(task, seed=5), collect(task, seed=6)
        assert len(one) == len(same)
        for a, b in zip(one, same, strict=True):
            assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
        assert not np.array_equal(one[0].states, other[0].states)
        assert len({e.states[0].tobytes() for e in one}) == len(one), "every episode has a start of its own"


@pytest.mark.parametrize("at_most", [1, 20, 25, 150])
def test_no_step_is_played_beyond_the_most(at_most):
    for task in (probe.PROBE, probe.ENDING_PROBE):
        draw = lambda rng: real.explore(ZERO, CollectConfig(max_std=3.0), rng)  # noqa: E731
        capped = real.collect(task, draw, at_most, np.random.default_rng(0), at_most=at_most)
        whole = real.collect(task, draw, at_most, np.random.default_rng(0))
        assert sum(len(e.rewards) for e in capped) == at_most
        for a, b in zip(capped, whole, strict=True):
            np.testing.assert_array_equal(a.states, b.states[: len(a.states)])


def test_progress_is_told_the_steps_so_far():
    told = []
    real.collect(probe.PROBE, lambda rng: ZERO, 50, np.random.default_rng(0), told.append)
    assert told == [20, 40, 60]


def test_the_environment_is_closed_even_after_an_error():
    before = probe.ProbeEnv.open_count
    collect()
    real.evaluate(probe.PROBE, ZERO, 2, seed=0)
    real.reset_states(probe.PROBE, 2, np.random.default_rng(0))

    def fails(state):
        raise RuntimeError("policy failed")

    with pytest.raises(RuntimeError, match="policy failed"):
        collect(mean=fails)
    with pytest.raises(RuntimeError, match="policy failed"):
        real.evaluate(probe.PROBE, fails, 2, seed=0)
    assert probe.ProbeEnv.open_count == before


def test_a_close_that_fails_is_told_once_a_run_and_counted(caplog):
    class Stuck(probe.ProbeEnv):
        def close(self):
            raise OSError("port busy")

    def close(times):
        for _ in range(times):
            with env_returns.closing(Stuck(), "Stuck"):
                pass
        said = [record.getMessage() for record in caplog.records]
        caplog.clear()
        return said

    once, of_all = "Stuck: close() raised OSError: port busy; nothing is lost", "busy, 5 times in all"
    with env_returns.warning_once():
        assert close(5) == [once]
    assert [r.getMessage().endswith(of_all) for r in caplog.records] == [True]
    caplog.clear()
    with env_returns.warning_once():
        assert close(1) == [once], "another run tells it again"
    assert not caplog.records, "one needs no count"
    assert close(2) == [once, once], "outside of a run each counts"


def test_evaluation_is_the_undiscounted_return_without_noise():
    seen = []

    def act(state):
        seen.append(state)
        return -0.5 * state

    returns = real.evaluate(probe.PROBE, act, 10, seed=3)
    # s -> (A - 0.5 B) s: the return is a quadratic form in the start, by the Lyapunov recursion
    closed, m = probe.A - 0.5 * probe.B, np.zeros((2, 2))
    for _ in range(probe.HORIZON):
        m = 0.25 * np.eye(2) + closed.T @ (np.eye(2) + m) @ closed
    starts = np.array(seen[:: probe.HORIZON])
    np.testing.assert_allclose(returns, [-s @ m @ s for s in starts], rtol=1e-5)
    assert len(np.unique(starts, axis=0)) == 10
    assert m[0, 0] > probe.riccati()[0][0, 0], "no gain beats the optimal one"
    np.testing.assert_array_equal(returns, real.evaluate(probe.PROBE, act, 10, seed=3))
    assert not np.array_equal(returns, real.evaluate(probe.PROBE, act, 10, seed=4))


def test_the_probes_optimum_is_the_riccati_return():
    """The probe itself: the closed form is what the environment pays, and no clipping interferes."""
    p, gains = probe.riccati()
    start = probe.starts(10)
    for seed in range(10):
        states, actions, rewards = probe.rollout(probe.PROBE, seed, lambda t, s: -gains[t] @ s)
        np.testing.assert_array_equal(states[0], start[seed])
        assert np.abs(actions).max() < 1
        assert rewards.sum() == pytest.approx(-start[seed] @ p @ start[seed], rel=1e-5)
    assert np.abs(gains[0] @ (probe.START * np.array([[1, 1], [1, -1]])).T).max() < 1


def test_reset_states_are_fresh_starts():
    states = real.reset_states(probe.PROBE, 300, np.random.default_rng(0))
    assert (states.shape, states.dtype) == ((300, 2), np.float64)
    assert len(np.unique(states, axis=0)) == 300
    assert stats.kstest(states.ravel(), stats.uniform(-probe.START, 2 * probe.START).cdf).pvalue > 1e-3
    np.testing.assert_array_equal(states, real.reset_states(probe.PROBE, 300, np.random.default_rng(0)))
