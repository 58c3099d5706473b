"""The presets: `paper` held against the paper value by value, `fast` possible for every task."""

from __future__ import annotations

import dataclasses
import typing

import pytest

from metrpo import systems, training
from metrpo.commands.parse import parse
from metrpo.config import Config, Preset, System, flatten, from_json, require_consistent, to_json
from metrpo.errors import ConfigError
from metrpo.launch.grid import Grid
from metrpo.presets import (
    BY_CRITICS,
    LONG_BY_CRITICS,
    LONG_HORIZON_ALL,
    PAPER,
    SHORT_BY_CRITICS,
    configured,
    override,
    preset,
)
from metrpo.systems import SYSTEMS
from metrpo.tune.search import Search
from metrpo.tune.space import Choices
from metrpo.world.registry import tasks

TASKS = ["Swimmer", "Snake", "Hopper", "HopperUpright", "HalfCheetah", "Ant", "Humanoid", "HumanoidStandup"]

# Setting -> (value, where it is written). "A.1" is the paper's appendix "Model-Ensemble Trust-Region Policy
# Optimization"; "code" is the authors' published code, which fills in what the paper leaves out.
CITED = {
    "improver": ("trpo", 'section 4, "Policy Optimization": the best results were achieved by TRPO'),
    "collect.steps": (3000, "A.1.1: 3000 timesteps of real world data for every environment, except Humanoid"),
    "collect.std_power": (1.0, "A.1.1: sampled from U[0.0, 3.0]"),
    "collect.noise_correlation": (0.0, "A.1.1: the stochastic policy acts, whose actions are drawn at every step anew"),
    "collect.max_std": (3.0, "A.1.1: standard deviation sampled from U[0.0, 3.0]"),
    "collect.std_per": ("episode", "A.1.1: at the beginning of every roll-out, fixed throughout the episode"),
    "collect.parameter_noise": (3.0, "A.1.1: proportional to the absolute difference of parameters; factor 3.0: code"),
    "collect.validation_fraction": (1 / 3, "A.1.1: 2-to-1 ratio for training and validation"),
    "collect.piece": (None, "A.1.1: whole episodes, as nothing else is said"),
    "collect.max_train": (200_000, "code: first in, first out"),
    "collect.max_validation": (100_000, "code: first in, first out"),
    "ensemble.members": (5, 'B, "Ablation study": ME-TRPO with 5 models'),
    "ensemble.hidden": ((1024, 1024), "A.1.2: hidden sizes 1024-1024"),
    "ensemble.activation": ("relu", "A.1.2: ReLU nonlinearities"),
    "ensemble.probabilistic": (False, "equation 1: the L2 norm of the error alone"),
    "ensemble.std_floor": (0.1, "code: floor of the normaliser"),
    "ensemble.delta_std_floor": (0.1, "code: floor of the normaliser, one for inputs and outputs"),
    "fit.learning_rate": (0.001, "A.1.2: Adam with learning rate 0.001"),
    "fit.decay": (False, "A.1.2: Adam with learning rate 0.001"),
    "fit.batch_size": (1000, "A.1.2: batch size of 1000"),
    "fit.loss_units": ("raw", "equation 1: the L2 norm of the error in the state"),
    "fit.validate_every": (5, "A.1.2: we validate the training every 5 passes"),
    "fit.patience": (25, "A.1.2: until the validation loss has not decreased for 25 passes"),
    "fit.max_passes": (2000, "code"),
    "fit.reinitialise_every": (5, "code: iterations 1, 6, 11, ..."),
    "imagine.steps": (50_000, "A.1.3: batch size 50000"),
    "imagine.sampling": ("step_rand", "section 4: in every step, we randomly choose a model"),
    "imagine.start": ("dataset", "footnote in section 3.2: initial states chosen from the sampled trajectories"),
    "policy.hidden": ((32, 32), "A.1.3: hidden sizes 32-32, except Humanoid"),
    "policy.initial_std": (1.0, "A.1.3: initial standard deviation 1.0"),
    "advantage.discount": (1.0, "section 2: the undiscounted sum of rewards; code: gamma 1"),
    "advantage.gae_lambda": (1.0, "code"),
    "advantage.ridge": (1e-5, "code: linear feature baseline"),
    "advantage.baseline": ("linear", "code: linear feature baseline"),
    "trpo.max_kl": (0.01, "A.1.3: step size delta_KL 0.01"),
    "trpo.cg_iterations": (10, "code"),
    "fit.products": ("float32", "code"),
    "imagine.products": ("float32", "code"),
    "trpo.fisher_every": (1, "every step, as nothing else is said"),
    "trpo.damping": (1e-5, "code"),
    "trpo.backtrack_ratio": (0.8, "code"),
    "trpo.max_backtracks": (15, "code"),
    "validate.rule": ("ensemble", "equation 5: the ratio of models in which the policy improves"),
    "validate.every": (5, 'section 4, "Policy Validation": after every 5 gradient updates'),
    "validate.threshold": (0.7, 'section 4, "Policy Validation": 70% as the threshold'),
    "validate.patience": (25, "A.1.3: if the policy fails the validation for 25 updates"),
    "validate.starts": (500, "code: fixed start states"),
}

HUMANOID = {
    "collect.steps": (6000, "A.1.1: except Humanoid in which we collect 6000 timesteps"),
    "collect.max_train": (400_000, "code"),
    "policy.hidden": ((100, 50, 25), "A.1.3: except Humanoid, hidden sizes 100-50-25"),
    "validate.starts": (32, "code"),
}

CITED_BY_TASK = {
    "Swimmer": {
        "collect.max_train": (100_000, "code"),
        "collect.max_validation": (50_000, "code"),
    },
    "Humanoid": HUMANOID,
    "HumanoidStandup": HUMANOID,
}

# Real steps of the paper's learning curves (its figure "data-comparison"); iterations are these by the steps of each.
REAL_STEPS = {**dict.fromkeys(TASKS, 300_000), "Ant": 600_000, "Humanoid": 2_400_000, "HumanoidStandup": 2_400_000}

# Setting -> (value, why it is not the paper's to decide).
OURS = {
    "preset": ("paper", "the label"),
    "seed": (0, "any will do"),
    "data": (None, "nothing is logged elsewhere"),
    "history": (1, "the paper's states are one observation"),
    "max_action": (1.0, "the environment's range is the only limit"),
    "max_change": (None, "the paper knows none: off"),
    "env_kwargs": ((), "the paper's tasks take none"),
    "imports": ((), "the paper's tasks are our own"),
    "real_steps": (None, "the budget is given in iterations"),
    "evaluation_episodes": (20, "reporting only: nothing is learned from it"),
    "deterministic": (False, "how the machine computes, not what"),
    "fit.weight_decay": (0.0, "an option of `fast`; the paper knows none, so it is off"),
    "fit.max_steps": (None, "an option of `fast`; the paper knows none, so it is off"),
    "system": ("me-trpo", "the label"),
    "method": ("model-based", "the paper's own"),
    "imagine.horizon": (None, "section 2: the full horizon"),
    "advantage.value_hidden": ((64, 64), "of the network that the paper does not have"),
    "advantage.value_steps": (40, "of the network that the paper does not have"),
    "advantage.value_batch_size": (1000, "of the network that the paper does not have"),
    "advantage.value_learning_rate": (1e-3, "of the network that the paper does not have"),
    "policy.normalise": (False, "code: the policy sees the full, unnormalised state"),
    "policy.min_std": (0.0, "A.1.3: the std is reset at every phase (code)"),
    "policy.mean_penalty": (0.0, "the paper knows none: off"),
    "validate.real_episodes": (0, "the paper validates in the models only"),
    "imagine.disagreement": (0.0, "the paper's future work: off"),
    "trust_reward": (False, "the paper's tasks are our own"),
    "learn_reward": (False, "section 2: the reward function is known"),
    **{
        f"{section}.{name}": (value, "used by the systems that the paper compares with, not by me-trpo")
        for section in ("gradient", "ppo", "svg", "actor_critic")
        for name, value in vars(getattr(Config("x"), section)).items()
    },
    "validate.max_updates": (400, "a bound that keeps one phase from running forever"),
}


def test_the_tasks_of_this_table_are_all_there_are():
    assert set(TASKS) <= set(tasks())
    assert {n for n, t in tasks().items() if t.env_id.startswith("metrpo/")} == set(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_the_paper_preset_is_the_papers_value_by_value(task):
    expected = {name: value for name, (value, _) in (CITED | OURS | CITED_BY_TASK.get(task, {})).items()}
    expected["task"] = task
    expected["iterations"] = REAL_STEPS[task] // expected["collect.steps"]
    assert flatten(preset(task, "paper")) == expected


def test_every_value_has_its_source():
    for row in (CITED, OURS, *CITED_BY_TASK.values()):
        assert all(len(why) >= 4 for _, why in row.values())
    assert not CITED.keys() & OURS.keys()


@pytest.mark.parametrize("name", typing.get_args(Preset))
@pytest.mark.parametrize("task", TASKS)
def test_every_preset_can_be_built_and_written(task, name):
    config = preset(task, name)
    assert (config.task, config.preset) == (task, name)
    assert from_json(to_json(config)) == config
    assert hash(config) == hash(preset(task, name))


def test_fast_is_the_default():
    assert preset("Swimmer") == preset("Swimmer", "fast")


@pytest.mark.parametrize("task", TASKS)
def test_fast_collects_no_more_than_the_paper_does_for_the_same_policy(task):
    """It may learn from the data in another way, but it gets no more of them, and the policies are comparable."""
    fast, paper = preset(task), preset(task, "paper")
    assert fast.collect.steps <= paper.collect.steps
    assert fast.validate.threshold == paper.validate.threshold
    if fast.system == "me-trpo":  # the actor-critic's actor is another kind of policy
        assert fast.policy.hidden == paper.policy.hidden


@pytest.mark.parametrize(("variant", "task"), [("HopperUpright", "Hopper"), ("HumanoidStandup", "Humanoid")])
@pytest.mark.parametrize("name", typing.get_args(Preset))
def test_variants_share_their_tasks_settings(variant, task, name):
    for system in typing.get_args(System):
        assert flatten(preset(variant, name, system)) == flatten(preset(task, name, system)) | {"task": variant}


def test_long_horizon_cuts_imagined_episodes_and_values_the_rest():
    fast, long = preset("mbbl/HalfCheetah", "fast", "me-trpo"), preset("mbbl/HalfCheetah", "long-horizon")
    assert (long.advantage.baseline, long.imagine.horizon, long.imagine.start) == ("network", 30, "anywhere")
    # The value of a cut episode leans on itself; exploration leaves the policy recognisable.
    assert long.advantage.discount < 1
    assert long.collect.max_std <= fast.collect.max_std
    assert long.collect.parameter_noise == 0
    # No task of 1,000 steps is asked for more data in an iteration, and the policies are comparable.
    assert long.collect.steps <= fast.collect.steps
    assert long.policy.hidden == fast.policy.hidden
    assert long.ensemble == fast.ensemble


@pytest.mark.parametrize("task", ["mbbl/HalfCheetah", "mbbl/CartPole", *TASKS])
def test_long_horizon_changes_what_its_row_says_and_nothing_else(task):
    fast, long = flatten(preset(task, "fast", "me-trpo")), flatten(preset(task, "long-horizon"))
    assert long == fast | LONG_HORIZON_ALL | {"preset": "long-horizon"}


@pytest.mark.parametrize(
    ("task", "settings", "system"),
    [
        ("HalfCheetah-v5", {}, "actor-critic"),
        ("mbbl/HalfCheetah", {}, "actor-critic"),
        ("mbbl/Swimmer", {}, "actor-critic"),
        ("mbbl/Swimmer", {"improver": "trpo"}, "me-trpo"),
        ("Pendulum-v1", {}, "me-trpo"),
        ("Swimmer", {}, "me-trpo"),
        ("HalfCheetah", {}, "me-trpo"),
        ("Hopper", {}, "actor-critic"),
        ("HopperUpright", {}, "me-trpo"),
        ("Snake", {}, "actor-critic"),
        ("Humanoid", {}, "actor-critic"),
        ("HumanoidStandup", {}, "actor-critic"),
        ("Ant", {}, "actor-critic"),
        ("Ant", {"improver": "trpo"}, "me-trpo"),
        ("HalfCheetah-v5", {"improver": "ppo"}, "me-trpo"),
        ("HalfCheetah-v5", {"max_change": 0.5}, "me-trpo"),
    ],
)
def test_long_episodes_and_some_tasks_have_another_usual_system(task, settings, system):
    assert preset(task, **settings).system == system
    assert configured(task, "fast", None, settings).system == system
    words = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    assert parse(["train", task, *words]).system == system
    assert parse(["train", task, *words, "--system", "me-trpo"]).system == "me-trpo"
    assert Grid((task,), settings={name: [value] for name, value in settings.items()}).runs()[0].system == system


@pytest.mark.parametrize("task", ["mbbl/HalfCheetah", "Ant"])
@pytest.mark.parametrize("name", ["paper", "long-horizon"])
def test_other_presets_have_one_usual_system(name, task):
    assert preset(task, name).system == "me-trpo"
    assert parse(["train", task, "--preset", name]).system == "me-trpo"


def test_a_task_of_the_critics_differs_from_their_system_in_its_row_alone():
    for task, row in BY_CRITICS.items():
        usual, me_trpo = flatten(preset(task)), flatten(preset(task, system="me-trpo"))
        by_length = SHORT_BY_CRITICS if task in PAPER else LONG_BY_CRITICS
        assert usual == me_trpo | SYSTEMS["actor-critic"] | by_length | {"system": "actor-critic"} | row
        # Who asks for a setting gets it.
        assert preset(task, iterations=3).iterations == 3
        assert not configured(task, "fast", None, {"ensemble.probabilistic": False}).ensemble.probabilistic


@pytest.mark.parametrize(
    ("task", "discount", "episodes"),
    [
        ("Swimmer", 0.99, 20),
        ("Pendulum-v1", 0.99, 20),
        ("mbbl/CartPole", 0.99, 20),
        ("HalfCheetah-v5", 0.995, 3),
        ("mbbl/HalfCheetah", 0.995, 3),
    ],
)
def test_the_critics_look_as_far_as_episodes_last(task, discount, episodes):
    config = preset(task, system="actor-critic")
    assert (config.advantage.discount, config.evaluation_episodes) == (discount, episodes)


def test_a_horizon_of_ones_own_decides_how_far_the_critics_look():
    config = preset("Pendulum-v1", system="actor-critic", env_kwargs={"max_episode_steps": 500})
    assert config.advantage.discount == 0.995


def test_long_episodes_have_a_budget_of_real_steps_until_iterations_are_asked_for():
    def parsed(*more):
        config = parse(["train", "HalfCheetah-v5", *more]).config
        return config.iterations, config.real_steps

    assert preset("HalfCheetah-v5").real_steps == parsed()[1] == 50_000
    assert parsed("--iterations", "5") == parsed("--iterations=5") == (5, None)
    config = preset("HalfCheetah-v5", iterations=5)
    assert (config.iterations, config.real_steps) == (5, None)
    assert override(preset("HalfCheetah-v5"), {"iterations": 5}) == config
    assert override(preset("HalfCheetah-v5"), {"seed": 1}).real_steps == 50_000
    assert [run.config.real_steps for run in Grid(("HalfCheetah-v5",), iterations=3).runs()] == [None]
    assert preset("HalfCheetah-v5", system="me-trpo").real_steps is preset("Snake").real_steps is None
    assert override(Config("Swimmer", data="log.npz", real_steps=0), {"iterations": 5}).real_steps == 0


def test_a_run_has_one_budget():
    both = {"iterations": 5, "real_steps": 4000}
    for config in (lambda: preset("Swimmer", **both), lambda: configured("HalfCheetah-v5", "fast", None, both)):
        with pytest.raises(ConfigError, match="expected iterations or real_steps, got both"):
            config()
    assert preset("Swimmer", iterations=5, real_steps=0, data="log.npz").iterations == 5  # no steps at all: offline


def test_only_options_decide_the_system_not_their_values():
    def words(*more):
        return parse(["train", "HalfCheetah-v5", *more]).system

    assert words("--run-dir", "max_action") == words("--run-dir", "system") == "actor-critic"
    assert words("--max-action", "0.5") == words("--max_action=0.5") == "me-trpo"


def test_who_asks_for_the_critics_as_improver_has_their_system():
    assert parse(["train", "Swimmer", "--improver", "actor-critic"]).system == "actor-critic"
    assert preset("Swimmer", improver="actor-critic").system == "actor-critic"
    assert preset("Swimmer", improver="actor-critic").advantage.discount == 0.99


@pytest.mark.parametrize(
    ("system", "settings", "message"),
    [
        ("actor-critic", {"improver": "trpo"}, "improver: expected actor-critic with the system actor-critic"),
        ("actor-critic", {"max_action": 0.5}, "max_action: expected the system me-trpo or trpo to learn under limits"),
        ("actor-critic", {"advantage.discount": 1.0}, "advantage.discount: expected less than 1 with the improver"),
        ("svg-1", {"data": "log.npz"}, "data: expected the method model-based to learn from offline data, got svg"),
    ],
)
def test_what_contradicts_itself_is_refused_before_anything_runs(system, settings, message):
    config = configured("Snake", "fast", system, settings)
    with pytest.raises(ConfigError, match=message):
        training.init(config)
    with pytest.raises(ConfigError, match=message):
        Grid(("Snake",), (system,), settings={name: [value] for name, value in settings.items()}).runs()


def test_the_presets_contradict_themselves_nowhere():
    for task in TASKS:
        for name in typing.get_args(Preset):
            for system in SYSTEMS:
                require_consistent(preset(task, name, system))


def test_what_is_searched_decides_the_system_too():
    assert Search("Snake", {"max_action": Choices((0.5, 1.0))}).system == "me-trpo"
    assert Search("Snake", {"fit.max_steps": Choices((100, 200))}).system == "actor-critic"
    with pytest.raises(ConfigError, match=r"advantage\.discount: expected less than 1"):
        Search("Snake", {"advantage.discount": Choices((0.99, 1.0))})


def test_settings_on_top():
    config = preset("Swimmer", "paper", seed=3, iterations=2)
    assert (config.seed, config.iterations) == (3, 2)
    assert isinstance(config, Config)


def test_settings_that_need_each_other_may_come_in_any_order():
    both = {"fit.decay": True, "fit.max_steps": 100}
    for values in (both, dict(reversed(both.items()))):
        fit = configured("Swimmer", "paper", None, values).fit
        assert (fit.decay, fit.max_steps) == (True, 100)
    with pytest.raises(ConfigError, match=r"fit.max_steps: expected a number of steps with fit.decay, got None"):
        configured("Swimmer", "paper", None, {"fit.decay": True})


def test_an_unknown_preset_is_refused():
    with pytest.raises(ConfigError, match="preset: expected one of fast, paper, long-horizon, got 'quick'"):
        preset("Swimmer", "quick")
    with pytest.raises(ConfigError, match=r"preset: expected its name as the second argument, .* got preset='paper'"):
        preset("Swimmer", preset="paper")
    with pytest.raises(ConfigError, match="unknown setting 'colour'"):
        preset("Swimmer", colour=1)


def test_every_system_that_can_be_named_stands_in_the_table():
    assert tuple(SYSTEMS) == typing.get_args(System)
    assert set(systems.PAPER) <= set(SYSTEMS)


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("name", typing.get_args(Preset))
def test_a_system_changes_what_its_row_says_and_nothing_else(system, name):
    config = preset("Swimmer", name, system)
    row = SYSTEMS[system] | (systems.PAPER.get(system, {}) if name == "paper" else {})
    row |= SHORT_BY_CRITICS if system == "actor-critic" else {}  # Swimmer's episodes have 200 steps
    before = flatten(preset("Swimmer", name))
    assert flatten(config) == before | row | {"system": system}
    assert from_json(to_json(config)) == config


def test_the_papers_systems_differ_from_each_other():
    configs = [dataclasses.replace(preset("Swimmer", "paper", s), system="me-trpo") for s in SYSTEMS]
    assert len(set(configs)) == len(SYSTEMS)


def test_an_unknown_system_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"system: expected one of me-trpo, .*svg-inf, actor-critic, got 'a3c'"):
        preset("Swimmer", "fast", "a3c")
