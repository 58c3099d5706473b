"""PPO and DDPG of Stable-Baselines3: exact states, exact resumes, exact exports, and that they learn."""

from __future__ import annotations

import sys
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import jax
import torch

import probe
from metrpo import training
from metrpo.baselines import openai_defaults as defaults
from metrpo.baselines import stable_baselines
from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.errors import MetrpoError
from metrpo.policy import gaussian
from metrpo.presets import override
from metrpo.run import derived_files
from metrpo.run.checkpoint import load_state, save_state
from metrpo.run.curve import draw_curve
from metrpo.run.policy_file import Learned, load_policy, save_policy
from metrpo.seeds import Stage
from metrpo.stages.records import evaluate

TINY = override(
    Config(task="Probe", iterations=3, evaluation_episodes=2),
    {"collect.steps": 128, "policy.hidden": (8, 6), "policy.initial_std": 0.5},
)
METHODS = pytest.mark.parametrize("method", ["ppo", "ddpg"])


@pytest.fixture(scope="module", autouse=True)
def _probe_is_a_task():
    with probe.registered():
        yield


@pytest.fixture(scope="module")
def runs():
    """By method: the states of three iterations (the first included) and their rows."""
    return {method: run(override(TINY, {"method": method}), 3) for method in ("ppo", "ddpg")}


def run(config, iterations):
    states, rows = [stable_baselines.init(config, probe.PROBE)], []
    for _ in range(iterations):
        state, row = stable_baselines.step(config, probe.PROBE, states[-1])
        states.append(state)
        rows.append(row)
    return states, rows


def equal(one, other):
    return jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b), one, other))


def shapes(state):
    """Names, dtypes and ranks: what a checkpoint must find again."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): (np.asarray(x).dtype, np.ndim(x)) for path, x in leaves}


# ---------------------------------------------------------------- states


@METHODS
def test_the_config_fixes_the_structure_of_the_state(runs, method):
    states, rows = runs[method]
    for state in states[1:]:
        assert shapes(state) == shapes(states[0])
        assert jax.tree.structure(state) == jax.tree.structure(states[0])
    assert all(isinstance(x, int | np.ndarray) for x in jax.tree.leaves(states[2]))
    assert len({tuple(row) for row in rows}) == 1


@METHODS
def test_the_networks_and_adam_change_and_are_kept(runs, method):
    (first, second, _, last), _ = runs[method]
    assert not any(np.any(x) for x in jax.tree.leaves(first.adam))
    assert all(np.any(x) for x in jax.tree.leaves(second.adam))
    for name, before in first.parameters.items():
        assert not np.array_equal(before, second.parameters[name]), name
    # PPO: 10 passes of 2 minibatches; DDPG: 50 updates after step 100, and 50 after step 200
    each = {"ppo": 20, "ddpg": 100}[method]
    for state, counted in ((second, each), (last, 3 * each)):
        assert {int(step) for optimiser in state.adam for step, _, _ in optimiser} == {counted}


@METHODS
def test_the_state_goes_into_the_library_and_comes_out_again(runs, method):
    config, state = override(TINY, {"method": method}), runs[method][0][3]
    env = stable_baselines.training_env(probe.PROBE)
    assert equal(stable_baselines.state_of(config, stable_baselines.new_model(config, env, 0, state), 3), state)
    env.close()


@METHODS
def test_a_step_leaves_its_state_as_it_was_and_can_be_repeated(runs, method):
    config, (states, rows) = override(TINY, {"method": method}), runs[method]
    before = jax.tree.map(np.array, states[1])
    again, row = stable_baselines.step(config, probe.PROBE, states[1])
    assert equal(states[1], before)
    assert equal(again, states[2])
    assert {n: x for n, x in row.items() if "seconds" not in n} == {
        n: x for n, x in rows[1].items() if "seconds" not in n
    }


@METHODS
def test_a_resumed_run_equals_an_uninterrupted_one(runs, method, tmp_path):
    config, (states, _) = override(TINY, {"method": method}), runs[method]
    save_state(tmp_path / "state.npz", states[2], {})
    # Nothing may hang on what this process has drawn before.
    torch.manual_seed(99)
    np.random.seed(99)
    state, _ = load_state(tmp_path / "state.npz", stable_baselines.init(config, probe.PROBE))
    assert equal(state, states[2])
    assert all(isinstance(x, int | np.ndarray) for x in jax.tree.leaves(state))
    resumed, _ = stable_baselines.step(config, probe.PROBE, state)
    assert equal(resumed, states[3])


@METHODS
def test_a_stopped_run_directory_is_resumed_exactly(runs, method, tmp_path, monkeypatch):
    monkeypatch.setattr(derived_files, "draw_curve", lambda *_: None)
    config = override(TINY, {"method": method, "deterministic": True, "iterations": 2})
    whole = training.train(config, tmp_path / "whole")
    training.train(override(config, {"iterations": 1}), tmp_path / "parts")
    resumed = training.train(config, tmp_path / "parts")
    assert equal(resumed, whole)
    assert equal(whole, runs[method][0][2])
    csvs = [(tmp_path / name / "metrics.csv").read_text() for name in ("whole", "parts")]
    assert csvs[0] == csvs[1]


@METHODS
def test_the_seed_decides_the_whole_run(runs, method):
    states, rows = run(override(TINY, {"method": method, "seed": 1}), 1)
    assert not equal(states[0].policy, runs[method][0][0].policy)
    assert not equal(states[1].policy, runs[method][0][1].policy)
    assert rows[0]["return_collected"] != runs[method][1][0]["return_collected"]


# ---------------------------------------------------------------- policies


@METHODS
def test_the_exported_policy_acts_as_stable_baselines3_predicts(runs, method, tmp_path):
    config, state = override(TINY, {"method": method}), runs[method][0][3]
    states = np.random.default_rng(0).normal(scale=3.0, size=(1000, 2)).astype(np.float32)
    env = stable_baselines.training_env(probe.PROBE)
    expected, _ = stable_baselines.new_model(config, env, 0, state).predict(states, deterministic=True)
    env.close()
    np.testing.assert_allclose(np.clip(gaussian.mean(state.policy, states), -1, 1), expected, atol=1e-5)
    save_policy(tmp_path, state.policy, "Probe", Learned(3, state.real_steps, None))
    np.testing.assert_allclose(load_policy(tmp_path)(states), expected, atol=1e-5)
    assert np.ptp(expected) > 0.02, "the policy must not be the same everywhere"
    assert [len(b) for _, b in state.policy.layers] == {"ppo": [8, 6, 2], "ddpg": [8, 6, 2, 2]}[method]


def test_the_initial_std_is_the_configs(runs):
    np.testing.assert_allclose(np.exp(runs["ppo"][0][0].policy.log_std), TINY.policy.initial_std, rtol=1e-6)
    np.testing.assert_allclose(np.exp(runs["ddpg"][0][0].policy.log_std), defaults.DDPG_NOISE, rtol=1e-6)


# ---------------------------------------------------------------- real steps and episodes


class Counted:
    """Every step and every start of the probe, evaluations included."""

    def __init__(self, patch):
        self.steps, self.starts = 0, []
        step, reset = probe.ProbeEnv.step, probe.ProbeEnv.reset

        def counted_step(env, action):
            self.steps += 1
            return step(env, action)

        def counted_reset(env, **kwargs):
            state, info = reset(env, **kwargs)
            self.starts.append(state.tobytes())
            return state, info

        patch.setattr(probe.ProbeEnv, "step", counted_step)
        patch.setattr(probe.ProbeEnv, "reset", counted_reset)


@pytest.mark.parametrize(
    ("method", "steps", "taken"),
    [
        ("ppo", 100, 128),
        ("ppo", 64, 64),
        ("ppo", 256, 256),
        ("ppo", 257, 512),
        ("ddpg", 30, 30),
        ("ddpg", 130, 200),
    ],
)
def test_real_steps_are_counted_one_by_one(monkeypatch, method, steps, taken):
    """Whole updates: PPO's of whole minibatches of 64 and up to PPO_STEPS, DDPG's of up to 100 steps."""
    counted = Counted(monkeypatch)
    monkeypatch.setattr(defaults, "PPO_STEPS", 256)
    config = override(TINY, {"method": method, "collect.steps": steps})
    state, row = stable_baselines.step(config, probe.PROBE, stable_baselines.init(config, probe.PROBE))
    evaluated = config.evaluation_episodes * probe.HORIZON
    assert state.real_steps == row["real_steps"] == counted.steps - evaluated == taken
    assert len(state.replay.get("rewards", [])) == (taken if method == "ddpg" else 0)
    assert len(set(counted.starts)) == len(counted.starts), "every episode must start elsewhere"
    assert probe.ProbeEnv.open_count == 0


def test_every_iteration_starts_with_a_fresh_episode():
    """30 steps are an episode of 20 and half of another, which is left there."""
    states, _ = run(override(TINY, {"method": "ddpg", "collect.steps": 30}), 2)
    replay = states[2].replay
    firsts = np.flatnonzero((replay["observations"][1:] != replay["next_observations"][:-1]).any(axis=1)) + 1
    np.testing.assert_array_equal(firsts, [20, 30, 50])
    assert np.abs(replay["observations"][firsts]).max() <= probe.START


def test_the_end_of_the_clock_is_an_end_as_the_tasks_is(runs):
    """As in OpenAI baselines: undiscounted, nobody can say what would follow."""
    ends = np.flatnonzero(runs["ddpg"][0][3].replay["dones"])
    # Iterations of 200 steps, episodes of 20.
    np.testing.assert_array_equal(ends, np.arange(19, 600, 20))
    states, _ = run(override(TINY, {"method": "ddpg", "task": "EndingProbe"}), 2)
    replay = states[2].replay
    early = probe.beyond(replay["next_observations"])
    assert replay["dones"][early].all()
    assert 0 < early.sum() < replay["dones"].sum() < 400


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_ppo_values_nothing_after_the_end_of_the_clock(monkeypatch, discount):
    monkeypatch.setitem(defaults.PPO_SETTINGS, "gae_lambda", 0.0)
    seen = {}

    def train(model):
        buffer = model.rollout_buffer
        seen.update(first=buffer.episode_starts[:, 0], rewards=buffer.rewards[:, 0], states=buffer.observations[:, 0])
        seen.update(actions=buffer.actions[:, 0], values=buffer.values[:, 0], advantages=buffer.advantages[:, 0])

    monkeypatch.setattr(defaults.PPO, "train", train)
    config = override(TINY, {"method": "ppo", "advantage.discount": discount})
    stable_baselines.step(config, probe.PROBE, stable_baselines.init(config, probe.PROBE))
    (last, *_) = np.flatnonzero(seen["first"][1:])
    action = np.clip(seen["actions"][last], -1, 1).astype(float)
    reward = probe.reward(None, action, probe.A @ seen["states"][last] + probe.B @ action)
    assert last == probe.HORIZON - 1
    assert seen["advantages"][last] == pytest.approx(reward - seen["values"][last], abs=1e-5)
    following = seen["rewards"][3] + discount * seen["values"][4] - seen["values"][3]
    assert seen["advantages"][3] == pytest.approx(following, abs=1e-5)


# ---------------------------------------------------------------- as in OpenAI baselines


@METHODS
def test_observations_learned_from_are_counted_once(runs, method):
    states, _ = runs[method]
    assert states[0].statistics["count"] == pytest.approx(0.01)
    for state in states[1:]:
        assert state.statistics["count"] == pytest.approx(state.real_steps + 0.01)
        assert {x.dtype for x in state.statistics.values()} == {np.dtype(np.float64)}
    if method == "ddpg":
        observations = states[3].replay["observations"].astype(float)
        np.testing.assert_allclose(states[3].statistics["sum"], observations.sum(0), atol=1e-4)
        np.testing.assert_allclose(states[3].statistics["squares"], (observations**2).sum(0) + 0.01, rtol=1e-6)


def test_statistics_are_running_ones_and_fold_into_a_layer():
    rng = np.random.default_rng(0)
    x = (rng.standard_normal((500, 3)) * [5, 0.3, 0.001] + [100, 0, 2]).astype(np.float32)
    s = defaults.Statistics(3)
    np.testing.assert_array_equal([s.mean, s.std], [[0] * 3, [1] * 3])
    for part in np.split(x, 10):
        s.update(part)
    np.testing.assert_allclose(s.mean, x.mean(0), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(s.std[:2], x.std(0)[:2], rtol=0.02)
    assert s.std[2] == pytest.approx(0.1), "what hardly moves is not blown up"
    weights, biases = rng.standard_normal((3, 4)), rng.standard_normal(4)
    folded, shifted = s.folded(weights, biases)
    np.testing.assert_allclose(x @ folded + shifted, (x - s.mean) / s.std @ weights + biases, atol=1e-4)


@METHODS
def test_networks_see_observations_by_their_statistics(runs, method):
    """Another unit and another zero of the observations, taken in by the statistics, change nothing."""
    config, state = override(TINY, {"method": method}), runs[method][0][3]
    env, scale, shift = stable_baselines.training_env(probe.PROBE), np.array([50.0, 4.0]), np.array([300.0, -20.0])
    n = state.statistics["count"]
    moved = state._replace(
        statistics={
            "sum": state.statistics["sum"] * scale + n * shift,
            "squares": state.statistics["squares"] * scale**2
            + 2 * shift * scale * state.statistics["sum"]
            + n * shift**2,
            "count": n,
        }
    )
    states = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    expected, _ = stable_baselines.new_model(config, env, 0, state).predict(states, deterministic=True)
    got, _ = stable_baselines.new_model(config, env, 0, moved).predict(
        (states * scale + shift).astype(np.float32), deterministic=True
    )
    env.close()
    np.testing.assert_allclose(got, expected, atol=2e-3)
    assert np.ptp(expected) > 0.02


def test_the_critic_normalises_layers_and_takes_actions_second():
    torch.manual_seed(0)
    critic = defaults._Value(3, 2, (5, 4))
    for norm in critic.norms:
        torch.nn.init.normal_(norm.weight)
        torch.nn.init.normal_(norm.bias)
    x = np.random.default_rng(0).normal(size=(6, 5)).astype(np.float32)
    p = {name: value.detach().numpy() for name, value in critic.named_parameters()}

    def layer(inputs, name, norm):
        out = inputs @ p[f"{name}.weight"].T + p[f"{name}.bias"]
        out = (out - out.mean(-1, keepdims=True)) / np.sqrt(out.var(-1, keepdims=True) + 1e-5)
        return np.maximum(out * p[f"norms.{norm}.weight"] + p[f"norms.{norm}.bias"], 0)

    hidden = layer(np.concatenate([layer(x[:, :3], "first", 0), x[:, 3:]], axis=1), "second", 1)
    expected = hidden @ p["last.weight"].T + p["last.bias"]
    np.testing.assert_allclose(critic(torch.from_numpy(x)).detach().numpy(), expected, atol=1e-5)


def test_l2_pulls_on_the_critics_hidden_weights_alone(runs):
    config, state = override(TINY, {"method": "ddpg"}), runs["ddpg"][0][3]
    env = stable_baselines.training_env(probe.PROBE)
    model = stable_baselines.new_model(config, env, 0, state)
    env.close()
    critic = model.critic
    for memory in critic.optimizer.state.values():
        memory["exp_avg"].zero_()
    before = {name: value.detach().clone() for name, value in critic.named_parameters()}
    for value in critic.parameters():
        value.grad = torch.zeros_like(value)
    critic.optimizer.step()
    pulled = {name for name, value in critic.named_parameters() if not torch.equal(value, before[name])}
    assert pulled == {"qf0.first.weight", "qf0.second.weight"}
    assert all(value.norm() < before[name].norm() for name, value in critic.named_parameters() if name in pulled)
    # Adam's memory after one step: 0.1 of the gradient, which is DDPG_DECAY times the weight.
    memory = critic.optimizer.state[critic.qf0.first.weight]["exp_avg"]
    np.testing.assert_allclose(memory.numpy(), 0.1 * 0.01 * before["qf0.first.weight"].numpy(), rtol=1e-4)


def test_an_untrained_actor_hardly_acts(runs):
    policy = runs["ddpg"][0][0].policy
    assert np.abs(gaussian.mean(policy, np.random.default_rng(0).normal(size=(100, 2)))).max() < 0.03


def test_the_replay_buffer_forgets_the_oldest_first(monkeypatch):
    monkeypatch.setattr(defaults, "DDPG_BUFFER", 250)
    config = override(TINY, {"method": "ddpg", "collect.steps": 100})
    states, _ = run(config, 4)
    assert [len(s.replay["rewards"]) for s in states] == [0, 100, 200, 250, 250]
    for before, after in pairwise(states[2:]):
        for name, values in after.replay.items():
            np.testing.assert_array_equal(values[:150], before.replay[name][-150:])


def test_no_episode_finished_is_no_return():
    config = override(TINY, {"method": "ddpg", "collect.steps": 10})
    _, row = stable_baselines.step(config, probe.PROBE, stable_baselines.init(config, probe.PROBE))
    assert np.isnan(row["return_collected"])


def test_progress_is_told_of_both_stages():
    told = []

    class Told(Progress):
        def stage(self, name, total=None):
            told.append((name, total))

        def update(self, done, note=""):
            told.append(done)

    config = override(TINY, {"method": "ddpg"})
    states, _ = run(config, 1)
    _, row = stable_baselines.step(config, probe.PROBE, states[1], Told())
    assert told == [("learn", 128), 100, 200, ("evaluate", 2)]
    assert row["seconds_collect"] > 0
    assert row["seconds_improve"] > 0


def test_the_curve_can_be_drawn_without_the_models_columns(runs, tmp_path):
    draw_curve(runs["ppo"][1], tmp_path / "curve.png", "Probe")
    assert (tmp_path / "curve.png").exists()


# ---------------------------------------------------------------- settings


@METHODS
def test_the_algorithm_has_the_settings_named(method):
    config = override(TINY, {"method": method})
    env = stable_baselines.training_env(probe.PROBE)
    model = stable_baselines.new_model(config, env, stable_baselines._seed(config, 0, Stage.INIT), None)
    env.close()
    sizes = {name: tuple(x.shape) for name, x in model.policy.named_parameters() if name.endswith("weight")}
    if method == "ppo":
        assert (model.n_steps, model.batch_size, model.n_epochs, model.gae_lambda) == (128, 64, 10, 0.95)
        assert (model.gamma, model.clip_range(1.0), model.learning_rate) == (1.0, 0.2, 3e-4)
        assert model.max_grad_norm == np.inf
        assert sizes["mlp_extractor.value_net.2.weight"] == (6, 8)
    else:
        assert (model.gamma, model.tau, model.batch_size, model.learning_starts) == (1.0, 0.01, 64, 64)
        assert (model.train_freq.frequency, model.gradient_steps, model.policy_delay) == (100, 50, 1)
        model._update_learning_rate([model.actor.optimizer, model.critic.optimizer])
        assert [{g["lr"] for g in o.param_groups} for o in stable_baselines._optimisers(model)] == [{1e-4}, {1e-3}]
        assert sizes["critic.qf0.second.weight"] == (64, 64 + 2)
    assert torch.get_num_threads() == 1


@pytest.mark.parametrize("library", ["torch", "stable_baselines3"])
def test_without_its_libraries_the_error_says_what_to_install(monkeypatch, library):
    monkeypatch.setitem(sys.modules, library, None)
    for module in ("sb3", "openai_defaults"):
        monkeypatch.delitem(sys.modules, f"metrpo.baselines.{module}")
    monkeypatch.delattr("metrpo.baselines.openai_defaults")
    with pytest.raises(MetrpoError, match=r"make baselines.*torch==2\.13\.0.*metrpo\[baselines\]"):
        training.init(override(TINY, {"method": "ppo"}))


@pytest.mark.slow
@METHODS
def test_it_learns_the_probe(method):
    """After 12,288 real steps within twice the optimum's loss; untrained policies lose more than ten times as much."""
    config = override(TINY, {"method": method, "collect.steps": 2048, "policy.hidden": (16, 16)})
    config = override(config, {"evaluation_episodes": 20})
    states, rows = run(config, 6)
    p, _ = probe.riccati()
    optimum = np.mean([-s @ p @ s for s in probe.starts(100)])
    untrained = np.mean(evaluate(config, probe.PROBE, states[0].policy, 1))
    after = rows[-1]["return_real"]
    assert untrained < 10 * optimum
    assert after > 2 * optimum
