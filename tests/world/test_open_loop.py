"""Open-loop rollouts of the paper's tasks are its environments, step by step; and the search for a ceiling."""

from __future__ import annotations

import json
import runpy
import sys

import numpy as np
import pytest

from metrpo.world import open_loop
from metrpo.world.open_loop import OpenLoop
from metrpo.world.registry import get_task
from places import ROOT

NAMES = ["Swimmer", "Snake", "Hopper", "HopperUpright", "HalfCheetah", "Ant", "Humanoid", "HumanoidStandup"]


@pytest.mark.parametrize("name", NAMES)
def test_rewards_and_states_are_the_environments(name):
    task, rng = get_task(name), np.random.default_rng(0)
    length = 40 if name != "Ant" else 100
    actions = rng.uniform(-1.2, 1.2, (3, length, task.action_size))
    actions[0] = np.sign(actions[0])
    search = OpenLoop(name, seed=5)
    rewards, states = search.rewards(actions), search.states(np.float64(np.float32(np.clip(actions, -1, 1))))
    ends = []
    for i, plan in enumerate(actions):
        env = task.make_env()
        np.testing.assert_array_equal(env.reset(seed=5)[0], states[i, 0])
        over = False
        for t, action in enumerate(plan):
            if over:
                assert rewards[i, t] == 0
                continue
            state, reward, over, _, _ = env.step(action.astype(np.float32))
            np.testing.assert_allclose(states[i, t + 1], state, rtol=1e-9, atol=1e-9)
            assert rewards[i, t] == pytest.approx(reward, rel=1e-6, abs=1e-6)
        ends.append(over)
        env.close()
    assert any(ends) == (name == "Ant"), "Ant's case must have an early end"


def test_many_plans_are_rolled_out_in_parts(monkeypatch):
    actions = np.random.default_rng(0).uniform(-1, 1, (7, 20, 6))
    whole = OpenLoop("HalfCheetah", seed=0).rewards(actions)
    monkeypatch.setattr(open_loop, "CHUNK", 1000)
    np.testing.assert_array_equal(OpenLoop("HalfCheetah", seed=0).rewards(actions), whole)


@pytest.fixture
def ceiling():
    return runpy.run_path(str(ROOT / "benchmarks" / "ceiling.py"))


def test_coloured_noise_has_its_spectrum_and_std_one(ceiling, monkeypatch):
    monkeypatch.setitem(ceiling["coloured"].__globals__, "COLOURS", (2.0,))
    noise = ceiling["coloured"](np.random.default_rng(0), 300, 128, 3)
    np.testing.assert_allclose(noise.std(axis=(1, 2)), 1, rtol=1e-6)
    power = (np.abs(np.fft.rfft(noise, axis=1)) ** 2).mean(axis=(0, 2))
    slope = np.polyfit(np.log(np.arange(1, 60)), np.log(power[1:60]), 1)[0]
    assert slope == pytest.approx(-2, abs=0.2)


def test_the_search_finds_a_known_optimum(ceiling):
    """Of a return that is largest at one plan, which no gait is."""
    rng = np.random.default_rng(0)
    target = np.clip(rng.standard_normal((20, 2)).cumsum(axis=0) / 4, -0.9, 0.9)

    def score(plans):
        return -np.square(plans - target).sum(axis=(1, 2))

    still = np.zeros_like(target)
    plan, curve = ceiling["best_plan"](score, [still], 6000, rng)
    assert score(still[None])[0] < -5
    assert score(plan[None])[0] > -0.3
    assert curve[-1] == (pytest.approx(6000, abs=100), score(plan[None])[0])
    best = [value for _, value in curve]
    assert best == sorted(best)


def test_the_record_says_what_was_found_and_what_idleness_earns(ceiling, tmp_path, monkeypatch):
    for name, value in {"POPULATION": 10, "ELITES": 3, "KEPT": 1}.items():
        monkeypatch.setitem(ceiling["main"].__globals__, name, value)
    out = tmp_path / "deep" / "Hopper.json"
    line = ["ceiling.py", "hopper", "--resets", "2", "--episodes", "200", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", line)
    ceiling["main"]()
    record = json.loads(out.read_text())
    assert record["task"] == "Hopper"
    assert [row["reset_seed"] for row in record["resets"]] == [0, 1]
    for row in record["resets"]:
        assert row["best"] >= max(row["rounds"]) >= row["gait"] - 0.02 > row["zero_action"]
        assert row["curve"][-1][0] <= 210
    assert record["best"]["max"] == max(row["best"] for row in record["resets"])
    assert record["zero_action"]["mean"] == pytest.approx(-54, abs=15), "as measured otherwise"
    assert record["random_actions"]["mean"] < record["zero_action"]["mean"]
