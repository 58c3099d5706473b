"""The calibration of a learned end, against numbers worked out by hand and a task whose end is known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import probe
from helpers import linear_ensemble
from metrpo import training
from metrpo.model.calibration import calibration, end_calibration
from metrpo.presets import override, preset
from metrpo.types import Transitions
from metrpo.world import registry

pytestmark = pytest.mark.usefixtures("plain_curve")


def test_by_hand():
    ended = np.array([True, True, False, False, False])
    found = calibration(np.array([[0.95, 0.45, 0.65, 0.05, -0.2], [1.3, 0.55, 0.0, 0.0, 0.05]]), ended)
    assert found.share == pytest.approx(0.4)
    assert found.recall == pytest.approx(3 / 4)  # 0.45 is not seen
    assert found.false_alarms == pytest.approx(1 / 6)  # 0.65
    # bins: [0, .1): 0.05, 0, 0, 0, 0.05 (no end); [.4, .5): 0.45 (end); [.5, .6): 0.55 (end); [.6, .7): 0.65 (none);
    # [.9, 1]: 0.95 and 1 (ends)
    assert found.error == pytest.approx((0.10 + 0.55 + 0.45 + 0.65 + 0.05) / 10)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 300))
def test_certain_and_right_has_no_error_its_opposite_all(seed, members, count):
    ended = np.random.default_rng(seed).uniform(size=count) < 0.4
    right = np.broadcast_to(ended.astype(float), (members, count))
    found = calibration(right, ended)
    assert found.error == 0
    assert found.recall == 1 or (math.isnan(found.recall) and not ended.any())
    assert found.false_alarms == 0 or (math.isnan(found.false_alarms) and ended.all())
    assert calibration(1 - right, ended).error == 1


def test_probabilities_that_say_how_often_have_almost_no_error():
    rng = np.random.default_rng(0)
    p = rng.uniform(size=20_000)
    found = calibration(p[None], rng.uniform(size=len(p)) < p)
    assert found.error < 0.02
    assert found.recall == pytest.approx(0.75, abs=0.02)  # E[p; p > 1/2] / E[p] = (3/8) / (1/2)


def test_each_members_last_output_is_what_is_calibrated():
    # two members that "predict" the next state s + a of one number, and an end of p = 0.6 s and 0.4 s
    matrices = [(np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([[1.0], [0.0]]))] * 2
    ensemble = linear_ensemble(matrices)
    weights = np.zeros((2, 2, 2), np.float32)  # inputs (s, a), outputs (change of s, end)
    weights[:, 1, 0] = 1
    weights[:, 0, 1] = 0.6, 0.4
    n = ensemble.normaliser
    n = n._replace(state_mean=n.state_mean[:1], state_scale=n.state_scale[:1])
    ensemble = ensemble._replace(networks=((weights, np.zeros((2, 1, 2), np.float32)),), normaliser=n)
    states = np.ones((30, 1), np.float32)
    deltas = np.stack([np.zeros(30), np.arange(30) % 2], axis=1).astype(np.float32)
    found = end_calibration(ensemble, Transitions(states, np.zeros((30, 1), np.float32), deltas, 30))
    assert found.share == 0.5
    assert found.recall == 0.5  # the first member sees every end, the second none
    assert found.false_alarms == 0.5
    assert found.error == pytest.approx(0.1)  # both are a tenth off


def test_a_run_with_a_learned_end_reports_it(monkeypatch):
    task = dataclasses.replace(probe.ENDING_PROBE, terminated="learned")
    monkeypatch.setitem(registry._TASKS, task.name, task)
    small = {"fit.max_steps": 200, "validate.max_updates": 5, "evaluation_episodes": 1, "collect.max_std": 3.0}
    config = override(dataclasses.replace(preset("Swimmer"), task=task.name), {**probe.LEARN, **small})
    _, row = training.step(config, training.init(config))
    assert 0 < row["end_share"] < 0.5
    assert 0 <= row["end_error"] <= 1
    assert {"end_recall", "end_false_alarms"} <= row.keys()
    assert list(row)[-1].startswith("seconds_"), "clocks come last"
