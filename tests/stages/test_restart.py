"""Every n-th iteration a fresh policy has a phase as well; where the models vote for it, it is the policy."""

import jax
import numpy as np
import pytest

import probe
import tiny_run
from helpers import random_ensemble, random_episode
from metrpo import algorithm, policy_phase
from metrpo.console.progress import SILENT
from metrpo.policy_phase import PhaseInfo
from metrpo.presets import override
from metrpo.run.clock import Clock
from metrpo.stages import policy_search
from metrpo.world import dataset as datasets

TINY = override(tiny_run.CONFIG, {"ensemble.members": 5})
NOTHING = np.full(5, -9.0)
OLD = np.full(5, 1.0)
CLEARLY_BETTER = 2.0001
"""More than OLD by this: 12 from nothing where OLD has 10."""


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.fixture(scope="module")
def state():
    rng = np.random.default_rng(0)
    nothing = algorithm.init(TINY, probe.PROBE)
    episodes = [random_episode(rng, probe.HORIZON, 2, 2) for _ in range(6)]
    return nothing._replace(iteration=2, dataset=datasets.add(nothing.dataset, episodes, TINY.collect, rng, ()))


class Phases:
    """Stands in for `policy_phase.improve`: the run's own policy ends with `OLD`, any other one with `fresh`."""

    def __init__(self, monkeypatch, state, fresh=OLD):
        self.state, self.fresh, self.began, self.drawn, self.keys = state, fresh, [], [], []
        monkeypatch.setattr(policy_phase, "improve", self)

    def __call__(self, config, simulator, policy, baseline, starts, key, hooks):
        self.began.append(policy)
        self.drawn.append(starts.draw(7))
        self.keys.append(jax.random.key_data(key).tolist())
        values = OLD if same(policy.layers, self.state.policy.layers) else self.fresh
        info = PhaseInfo(values, NOTHING, 5, 5, 0, 1, np.ones(5), 0.0, 0.0)
        return policy._replace(log_std=policy.log_std - 1), baseline, info


def search(state, every, iteration=3):
    config, before = override(TINY, {"policy.restart_every": every}), state._replace(iteration=iteration - 1)
    return policy_search.improve_policy(config, probe.PROBE, before, random_ensemble(0, 5, 2, 2), SILENT, Clock())


@pytest.mark.parametrize(
    ("every", "iteration", "phases"), [(0, 3, 1), (3, 2, 1), (3, 3, 2), (3, 4, 1), (2, 4, 2), (1, 1, 2)]
)
def test_a_fresh_policy_has_a_phase_every_nth_iteration(state, monkeypatch, every, iteration, phases):
    played = Phases(monkeypatch, state)
    search(state, every, iteration)
    assert len(played.began) == phases


@pytest.mark.parametrize(
    ("models", "more", "wins"),
    [
        (5, 0, False),
        (3, CLEARLY_BETTER, False),
        (4, CLEARLY_BETTER, True),
        (5, CLEARLY_BETTER, True),
        (5, 1.999, False),
    ],
)
def test_the_models_vote_for_what_is_clearly_better(state, monkeypatch, models, more, wins):
    """At least 70 % of five models are four, and a fifth more from nothing is clear."""
    played = Phases(monkeypatch, state, OLD + more * (np.arange(5) < models))
    policy, _, info = search(state, 3)
    assert info.restarted == wins
    assert same(policy.layers, played.began[wins].layers)
    assert not same(*(policy.layers for policy in played.began))


def test_both_are_judged_from_the_same_start_states_and_the_first_is_what_it_was(state, monkeypatch):
    played = Phases(monkeypatch, state)
    search(state, 3)
    np.testing.assert_array_equal(*played.drawn)
    assert played.keys[0] != played.keys[1]
    alone = Phases(monkeypatch, state)
    search(state, 0)
    assert (alone.drawn[0] == played.drawn[0]).all()
    assert alone.keys == played.keys[:1]


def test_a_fresh_policy_brings_no_parameter_noise(state, monkeypatch):
    """It has no last change that could say how wide the noise should be."""
    for fresh, restarted in ((OLD + 3, True), (OLD - 1, False)):
        Phases(monkeypatch, state, fresh)
        config = override(TINY, {"policy.restart_every": state.iteration + 1})
        following, row = algorithm.step(config, probe.PROBE, state)
        assert row["restarted"] == restarted
        assert same(following.policy, following.previous_policy) == restarted
