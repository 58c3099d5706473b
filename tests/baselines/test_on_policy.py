"""Learning in the real environment: TRPO on real rollouts, and stochastic value gradients."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from scipy import stats

import probe
from helpers import random_episode, random_policy, slow_mean
from metrpo import training
from metrpo.baselines import on_policy, real_trpo
from metrpo.baselines.on_policy import Drawn
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.presets import override

pytestmark = pytest.mark.usefixtures("plain_curve")

BASE = override(
    Config(task="Probe", evaluation_episodes=10),
    {"collect.steps": 400, "policy.hidden": (8,), "policy.initial_std": 0.3, "ensemble.members": 1},
)
TRPO = override(BASE, {"method": "trpo", "trpo.max_kl": 0.05, "iterations": 30})
SVG = override(
    BASE,
    {
        "method": "svg",
        "iterations": 20,
        "ensemble.hidden": (16,),
        "fit.learning_rate": 3e-3,
        "fit.batch_size": 64,
        "svg.model_steps": 20,
        "svg.value_steps": 20,
        "gradient.learning_rate": 1e-2,
        "collect.max_train": 10_000,
    },
)


@pytest.fixture(autouse=True)
def _probe_is_a_task():
    with probe.registered():
        yield


class Rows(Progress):
    def __init__(self):
        self.rows = []

    def end(self, row, seconds_left=None):
        self.rows.append(row)


# ---------------------------------------------------------------- rollouts of the policy


def test_actions_are_kept_as_drawn_and_executed_clipped():
    policy = random_policy(0, 2, 2, std=1.5)
    drawn = on_policy.collect(probe.PROBE, policy, 2000, np.random.default_rng(0))
    assert sum(len(e.rewards) for e in drawn.episodes) == 2000
    z = []
    for episode, actions in zip(drawn.episodes, drawn.actions, strict=True):
        np.testing.assert_array_equal(np.clip(actions, -1, 1), episode.actions)
        means = np.array([slow_mean(policy, s) for s in episode.states[:-1]])
        z.append((actions - means) / np.exp(policy.log_std))
    assert any((np.abs(a) > 1).any() for a in drawn.actions)
    assert stats.kstest(np.concatenate(z).ravel(), "norm").pvalue > 1e-3


def test_episodes_lie_side_by_side_and_end_where_they_ended():
    rng = np.random.default_rng(0)
    episodes = [random_episode(rng, length, terminated=length < 7) for length in (7, 3, 5)]
    actions = [rng.normal(size=(len(e.rewards), 2)).astype(np.float32) for e in episodes]
    t = real_trpo.trajectories(Drawn(episodes, actions), 7)
    assert t.states.shape == (7, 64, 4), "padded to a fixed number of episodes"
    np.testing.assert_array_equal(t.mask.sum(0), [7, 3, 5, *[0] * 61])
    for i, (episode, drawn) in enumerate(zip(episodes, actions, strict=True)):
        length = len(episode.rewards)
        np.testing.assert_array_equal(t.states[:length, i], episode.states[:-1])
        np.testing.assert_array_equal(t.actions[:length, i], drawn)
        np.testing.assert_array_equal(t.rewards[:length, i], episode.rewards)


# ---------------------------------------------------------------- TRPO


@pytest.mark.slow
def test_trpo_finds_the_probes_optimum_in_the_real_environment():
    told = Rows()
    state = training.train(TRPO, None, told)
    assert state.real_steps == 30 * 400
    last = told.rows[-1]
    assert probe.real_return(training.init(TRPO).policy) < 3 * probe.optimum()
    assert 1.25 * probe.optimum() < probe.real_return(state.policy) < probe.optimum()
    assert all(0 < row["kl"] <= 0.05 for row in told.rows if not row["rejected_steps"])
    assert last["mean_std"] < 0.3, "less noise earns more"
    assert [row["iteration"] for row in told.rows] == list(range(1, 31))


@pytest.mark.parametrize("config", [TRPO, SVG, override(SVG, {"svg.horizon": "1"})], ids=["trpo", "svg-inf", "svg-1"])
@pytest.mark.parametrize("task", ["Probe", "EndingProbe"])
def test_a_baseline_repeats_and_resumes_itself(tmp_path, config, task):
    """Stopped after the first of three iterations and resumed from disk: the same as without the stop."""
    config = override(config, {"task": task, "iterations": 3, "collect.steps": 60})
    whole = training.train(config)
    training.train(dataclasses.replace(config, iterations=1), tmp_path / "run")
    resumed = training.train(config, tmp_path / "run")
    assert resumed.iteration == 3
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    other = training.train(dataclasses.replace(config, seed=1, iterations=1))
    assert not np.allclose(whole.policy.layers[0][0], other.policy.layers[0][0])


@pytest.mark.parametrize("config", [TRPO, SVG], ids=["trpo", "svg"])
def test_a_baseline_stops_at_its_budget_of_real_steps(config):
    config = override(config, {"task": "EndingProbe", "real_steps": 33, "collect.steps": 500, "evaluation_episodes": 1})
    state = training.train(config)
    assert (state.iteration, state.real_steps) == (1, 33)


@pytest.mark.slow
def test_svg_inf_learns_the_probe():
    told = Rows()
    state = training.train(SVG, None, told)
    assert probe.real_return(training.init(SVG).policy) < 3 * probe.optimum()
    assert 1.1 * probe.optimum() < probe.real_return(state.policy) < probe.optimum()
    assert told.rows[-1]["train_loss"] < 0.1 * told.rows[0]["train_loss"]
