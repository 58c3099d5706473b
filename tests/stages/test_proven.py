"""Real episodes without noise judge every new policy; a worse one is given up, and none of them is lost."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import probe
import tiny_run
from helpers import random_policy
from metrpo import algorithm, external, training
from metrpo.callbacks import Callback
from metrpo.config import Config
from metrpo.errors import EpisodeError
from metrpo.policy import gaussian
from metrpo.presets import override, preset
from metrpo.run import derived_files, machine
from metrpo.run.directory import RunDirectory
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import atomic_write
from metrpo.stages import policy_search, proven
from metrpo.stages.proven import judge, steps_kept_for_proof
from metrpo.stages.state import Proven
from metrpo.types import Episode

PROOFS, EPISODES = 3, 12
TRIED = override(
    tiny_run.CONFIG, {"collect.steps": EPISODES * probe.HORIZON, "validate.real_episodes": PROOFS, "iterations": 2}
)
OLD, NEW = random_policy(0), random_policy(1)


def earning(*returns):
    """An episode for each return."""
    one = np.zeros((2, 4)), np.zeros((1, 2), np.float32)
    return [Episode(*one, np.array([x], np.float32), False) for x in returns]


def best(mean, error, episodes=4):
    return Proven(OLD, mean, error, episodes)


# ---------------------------------------------------------------- the verdict


@pytest.mark.parametrize(
    ("before", "returns", "given_up", "winner"),
    [
        (best(0.0, 0.0, 0), (1, 3), False, NEW),  # nothing to hold it against
        (best(100.0, 3.0), (50, 52, 48, 50), True, OLD),
        (best(100.0, 3.0), (95, 99, 96, 94), False, OLD),  # less, but not clearly
        (best(100.0, 3.0), (101, 99, 103, 102), False, NEW),
        (best(100.0, 30.0), (50, 52, 48, 50), False, OLD),  # the best one is not known that well
        (best(100.0, 3.0), (-1e3, 1e3), False, OLD),  # nor is the new one
        (best(100.0, 3.0), (0,), False, OLD),  # one episode has no spread
        (best(100.0, 3.0), (), False, OLD),
    ],
)
def test_a_policy_is_given_up_if_it_earns_clearly_less(before, returns, given_up, winner):
    verdict = judge(before, NEW, earning(*returns))
    assert verdict.given_up == given_up
    assert verdict.best.policy is winner


def test_the_margin_is_two_standard_errors_of_the_difference():
    returns = 90 + np.array([-3.0, 3.0, -3.0, 3.0])
    error = np.hypot(1.0, np.std(returns, ddof=1) / 2)
    for side, given_up in ((1.001, True), (0.999, False)):
        assert judge(best(90 + side * 2 * error, 1.0), NEW, earning(*returns)).given_up == given_up


few = st.lists(st.integers(-1000, 1000).map(float), min_size=2, max_size=9)


@given(few, few)
def test_two_trials_of_one_policy_count_as_one(first, second):
    once = judge(Proven(OLD, 0.0, 0.0, 0), OLD, earning(*first)).best
    both = judge(once, OLD, earning(*second))
    assert not both.given_up
    assert both.best.episodes == len(first) + len(second)
    assert both.best.mean == pytest.approx(np.mean(first + second), abs=1e-6)
    # Of the mean of both, where each trial's spread is its own.
    variances = [np.var(x, ddof=1) * len(x) for x in (first, second)]
    assert both.best.error == pytest.approx(np.sqrt(sum(variances)) / both.best.episodes, abs=1e-6)


# ---------------------------------------------------------------- within the loop


@pytest.fixture(scope="module", autouse=True)
def _probe_is_a_task():
    with probe.registered():
        yield


@pytest.fixture(scope="module")
def two():
    """The states and rows of two iterations."""
    states, rows = [training.init(TRIED)], []
    for _ in range(2):
        state, row = training.step(TRIED, states[-1])
        states.append(state)
        rows.append(row)
    return states, rows


def test_proofs_are_part_of_an_iterations_steps_and_of_the_data(two):
    states, rows = two
    assert [row["real_steps"] for row in rows] == [EPISODES * probe.HORIZON, 2 * EPISODES * probe.HORIZON]
    assert len(states[2].dataset.starts) == 2 * EPISODES
    assert states[1].proven.episodes == PROOFS
    assert states[1].proven.mean == pytest.approx(rows[0]["return_proof"])


def test_proofs_are_played_without_noise(two, monkeypatch):
    played = []
    settle = algorithm.settle
    monkeypatch.setattr(algorithm, "settle", lambda *args: played.append(args[-2:]) or settle(*args))
    training.step(TRIED, two[0][1])
    ((candidate, proofs),) = played
    assert len(proofs) == PROOFS
    for episode in proofs:
        mean = gaussian.mean(candidate.policy, (episode.states[:-1] - candidate.origin).astype(np.float32))
        np.testing.assert_allclose(np.clip(mean, -1, 1), episode.actions, atol=1e-5)


def test_the_run_goes_back_from_a_policy_that_earns_less(two, monkeypatch):
    before = two[0][1]
    improve = policy_search.improve_policy

    def fooled(*args):
        policy, _, info = improve(*args)
        layers = jax.tree.map(lambda x: np.full_like(x, x.ndim == 1), policy.layers)  # all the same bad: actions of 1
        fooled.policy = policy._replace(layers=layers)
        return fooled.policy, None, info

    monkeypatch.setattr(algorithm, "improve_policy", fooled)
    state, row = training.step(TRIED, before)
    assert row["given_up"] == 1
    assert row["return_proof"] < before.proven.mean
    assert state.policy is before.proven.policy
    assert state.previous_policy is fooled.policy, "how far they are apart is how wide the next one explores"
    assert state.proven == before.proven
    assert len(state.dataset.starts) == 2 * EPISODES, "the models learn from what went wrong"


@pytest.fixture
def quick(monkeypatch):
    """No curve, and the machine as it is."""
    monkeypatch.setattr(derived_files, "draw_curve", lambda rows, path, *_: atomic_write(path, f"{len(rows)} rows"))
    monkeypatch.setattr(machine, "prepare", lambda *_, **__: None)


@pytest.mark.parametrize("kept", range(PROOFS + 1))
def test_a_run_stopped_among_its_proofs_loses_none(tmp_path, two, quick, monkeypatch, kept):
    config = override(TRIED, {"iterations": 1})
    append, save, proofs = EpisodeLog.append, RunDirectory.save, []

    def stopping(self, episode, proof=False):
        if proof and len(proofs) == kept:
            raise KeyboardInterrupt
        proofs.extend([episode] * proof)
        return append(self, episode, proof)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeLog, "append", stopping)
        patch.setattr(RunDirectory, "save", lambda self, *_: stopping(self.episodes, None, True))
        with pytest.raises(KeyboardInterrupt):
            training.train(config, tmp_path)
    log = EpisodeLog(tmp_path)
    assert (len(log.pending()), len(log.proofs())) == (EPISODES - PROOFS, kept)

    played = []
    monkeypatch.setattr(EpisodeLog, "append", lambda *args, **more: played.append(args) or append(*args, **more))
    monkeypatch.setattr(RunDirectory, "save", save)
    again = training.train(config, tmp_path)
    assert len(played) == PROOFS - kept
    assert jax.tree.all(jax.tree.map(np.array_equal, two[0][1], again))


def test_an_environment_that_fails_in_a_proof_costs_no_learning(two, monkeypatch, caplog):
    def failing(*_):
        raise EpisodeError("the motor is hot")
        yield

    monkeypatch.setattr(proven, "real", SimpleNamespace(play=failing))  # in a proof only
    state, row = training.step(TRIED, two[0][1])
    assert np.isnan(row["return_proof"])
    assert state.iteration == 2
    assert state.proven == two[0][1].proven
    assert "the motor is hot" in caplog.text


def test_a_callback_hears_of_proofs_as_of_other_episodes():
    heard = []

    class Hearing(Callback):
        def on_episode(self, episode):
            heard.append(len(episode.rewards))

    training.train(override(TRIED, {"iterations": 1}), callbacks=[Hearing()])
    assert heard == [probe.HORIZON] * EPISODES


# ---------------------------------------------------------------- how many steps


def test_what_nobody_proves_is_collected_whole(tmp_path, quick):
    external.begin(TRIED, tmp_path)
    episodes = external.collect(tmp_path)
    assert sum(len(e.rewards) for e in episodes) == TRIED.collect.steps, "another program has no proofs to play"


def test_proofs_stay_within_the_budget_of_a_run_that_has_collected_more(tmp_path, quick):
    config = override(TRIED, {"real_steps": TRIED.collect.steps})
    external.begin(config, tmp_path)
    external.collect(tmp_path)
    state = training.train(config, tmp_path)
    assert (state.real_steps, state.proven.episodes) == (TRIED.collect.steps, 0)


def test_a_budget_of_real_steps_is_kept_exactly():
    config = override(TRIED, {"real_steps": 350, "iterations": 5})
    state = training.train(config)
    assert state.real_steps == 350


@pytest.mark.parametrize(
    ("wanted", "tries", "left", "kept"),
    [(240, 3, None, 60), (239, 3, None, 0), (240, 0, None, 0), (240, 3, 240, 60), (240, 3, 239, 0)],
)
def test_proofs_take_a_quarter_of_an_iteration_at_most(wanted, tries, left, kept):
    settings = {"collect.steps": wanted, "validate.real_episodes": tries, "real_steps": left}
    assert steps_kept_for_proof(override(Config(task="Probe"), settings), probe.PROBE, 0) == kept


def test_long_episodes_are_too_dear_for_proofs():
    assert steps_kept_for_proof(preset("HalfCheetah"), probe.PROBE, 0) > 0
    assert steps_kept_for_proof(preset("HalfCheetah"), dataclasses.replace(probe.PROBE, horizon=1000), 0) == 0
