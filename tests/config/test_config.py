"""Settings: JSON both ways, and errors that name what was expected and what was got."""

from __future__ import annotations

import dataclasses
import json
import types
import typing

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from metrpo.config import ADDED, BUDGET_FIELDS, Config, difference, flatten, from_json, to_json
from metrpo.config.env_kwargs import canonical
from metrpo.errors import ConfigError
from metrpo.presets import override
from metrpo.run.files import folder_name
from places import RESULTS

# A share, a rate, a penalty: what lies between 0 and 1 is possible for every number with a fraction.
KINDS = {
    int: st.integers(1, 10**6),
    float: st.floats(0.0, 1.0, exclude_min=True, exclude_max=True),
    bool: st.booleans(),
    str: st.text(min_size=1),
}

_names = st.from_regex(r"[a-z_]{1,4}", fullmatch=True)
_values = st.none() | st.booleans() | st.integers() | st.text()
OWN = {
    "env_kwargs": st.dictionaries(_names, _values, max_size=3).map(canonical),
    "imports": st.lists(_names, max_size=2).map(tuple),
    "max_steps": st.integers(1, 10**6),
    "real_episodes": st.just(0) | st.integers(2, 10**6),
}
"""Settings that are not any value of their type."""


def strategy(kind):
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return st.builds(
            kind,
            **{f.name: OWN[f.name] if f.name in OWN else strategy(hints[f.name]) for f in dataclasses.fields(kind)},
        )
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin in (types.UnionType, typing.Union):
        return st.one_of(st.none(), strategy(arguments[0]))
    if origin is tuple:
        return st.lists(strategy(arguments[0]), max_size=4).map(tuple)
    return KINDS[kind]


configs = strategy(Config)
NAMES = list(flatten(Config(task="x")))


@given(configs)
@settings(max_examples=50, deadline=None)
def test_json_round_trip(config):
    again = from_json(to_json(config))
    assert again == config
    assert hash(again) == hash(config)
    for ours, theirs in zip(flatten(again).values(), flatten(config).values(), strict=True):
        assert type(ours) is type(theirs)
    assert to_json(again) == to_json(config)
    assert difference(again, config) == {}


@given(configs, configs)
@settings(max_examples=50, deadline=None)
def test_difference_names_exactly_what_differs_but_the_budget(old, new):
    ours, theirs = flatten(old), flatten(new)
    assert difference(old, new) == {
        n: (ours[n], theirs[n]) for n in NAMES if ours[n] != theirs[n] and n not in ("iterations", "real_steps")
    }
    assert difference(old, dataclasses.replace(old, iterations=new.iterations, real_steps=new.real_steps)) == {}


def test_difference_of_one_nested_setting():
    old = Config(task="x")
    assert difference(old, override(old, {"trpo.max_kl": 0.5})) == {"trpo.max_kl": (0.01, 0.5)}
    assert BUDGET_FIELDS == ("iterations", "real_steps")


def test_json_is_one_setting_a_line_with_the_dotted_structure():
    data = json.loads(to_json(Config(task="Swimmer")))
    assert data["task"] == "Swimmer"
    assert data["fit"]["learning_rate"] == 1e-3
    assert data["policy"]["hidden"] == [32, 32]
    flat = {}
    for name, value in data.items():
        flat |= {f"{name}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {name: value}
    assert list(flat) == NAMES


def test_configs_are_frozen_and_hashable():
    config = Config(task="x")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.seed = 3
    assert len({config, Config(task="x"), Config(task="y")}) == 2


IMPOSSIBLE = {
    "task": [""],
    "seed": [-1, 2**31],
    "iterations": [0, -3],
    "real_steps": [-1],
    "evaluation_episodes": [0],
    "history": [0, -1],
    "max_action": [0.0, 1.5, float("nan")],
    "max_change": [0.0, -0.1, float("inf")],
    "collect.steps": [0],
    "collect.max_std": [-0.1, float("inf"), float("nan")],
    "collect.std_power": [0.0, -1.0, float("inf"), float("nan")],
    "collect.noise_correlation": [-0.1, 1.0, float("nan")],
    "collect.parameter_noise": [-1.0, float("nan")],
    "collect.validation_fraction": [0.0, 1.0, -0.5, float("nan")],
    "collect.piece": [0, -1],
    "collect.max_train": [0],
    "collect.max_validation": [0],
    "ensemble.members": [0, -1],
    "ensemble.hidden": [(0,), (32, -1)],
    "ensemble.std_floor": [0.0, -1.0, float("inf")],
    "ensemble.delta_std_floor": [0.0, float("nan")],
    "fit.learning_rate": [0.0, -1e-3, float("nan"), float("inf")],
    "fit.weight_decay": [-1.0, float("nan")],
    "fit.batch_size": [0],
    "fit.validate_every": [0],
    "fit.patience": [0],
    "fit.max_passes": [0],
    "fit.max_steps": [0, -5],
    "fit.reinitialise_every": [-1],
    "imagine.steps": [0],
    "imagine.horizon": [0, -1],
    "imagine.disagreement": [-1.0, float("nan"), float("inf")],
    "policy.hidden": [(0,)],
    "policy.initial_std": [0.0, -1.0, float("nan")],
    "policy.min_std": [-0.1, float("inf"), float("nan")],
    "policy.mean_penalty": [-0.1, float("inf"), float("nan")],
    "validate.real_episodes": [-1, 1],
    "advantage.discount": [-0.1, 1.1, float("nan")],
    "advantage.gae_lambda": [-0.1, 1.1, float("nan")],
    "advantage.ridge": [0.0, -1.0],
    "advantage.value_hidden": [(0,), (64, -1)],
    "advantage.value_steps": [0],
    "advantage.value_batch_size": [0, -1],
    "advantage.value_learning_rate": [0.0, -1e-3, float("nan"), float("inf")],
    "trpo.max_kl": [0.0, -0.01, float("nan")],
    "trpo.cg_iterations": [0],
    "trpo.fisher_every": [0],
    "trpo.damping": [-1e-5, float("nan")],
    "trpo.backtrack_ratio": [0.0, 1.0, 1.5, float("nan")],
    "trpo.max_backtracks": [0],
    "gradient.learning_rate": [0.0, -1e-3, float("nan"), float("inf")],
    "gradient.max_norm": [0.0, -1.0, float("nan")],
    "ppo.clip": [0.0, 1.0, float("nan")],
    "ppo.epochs": [0],
    "ppo.minibatches": [0],
    "svg.model_steps": [0],
    "svg.value_steps": [0],
    "svg.value_learning_rate": [0.0, float("nan")],
    "actor_critic.updates_per_step": [0.0, float("inf")],
    "actor_critic.random_steps": [-1],
    "actor_critic.batch_size": [0],
    "actor_critic.real_batch": [-1],
    "actor_critic.horizon": [-1],
    "actor_critic.trust": [-0.1, float("inf")],
    "actor_critic.agreement": [-0.1, float("inf")],
    "actor_critic.branch_steps": [0],
    "actor_critic.margin": [-0.1, float("nan")],
    "actor_critic.block": [0],
    "actor_critic.critics": [0],
    "actor_critic.critic_hidden": [(0,), (64, -1)],
    "actor_critic.critic_learning_rate": [0.0, float("nan")],
    "actor_critic.critic_steps": [0],
    "actor_critic.target_rate": [0.0, 1.1, float("nan")],
    "actor_critic.entropy_weight": [0.0, -1.0],
    "actor_critic.entropy_target": [float("inf"), float("nan")],
    "actor_critic.entropy_learning_rate": [0.0, float("nan")],
    "validate.every": [0],
    "validate.threshold": [-0.1, 1.1, float("nan")],
    "validate.patience": [0],
    "validate.max_updates": [0],
    "validate.starts": [0],
}
FREE = {
    "preset",
    "improver",
    "deterministic",
    "collect.std_per",
    "fit.loss_units",
    "imagine.sampling",
    "imagine.start",
    "policy.normalise",
}
FREE |= {
    "ensemble.activation",
    "ensemble.probabilistic",
    "fit.decay",
    "validate.rule",
    "actor_critic.terminal",
    "fit.products",
    "imagine.products",
    "system",
    "method",
    "svg.horizon",
    "advantage.baseline",
    "trust_reward",
    "data",
    "learn_reward",
    "env_kwargs",
    "imports",
}


def test_every_number_has_its_impossible_values_listed_here():
    assert set(NAMES) == set(IMPOSSIBLE) | FREE


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, values in IMPOSSIBLE.items() for v in values])
def test_an_impossible_value_is_refused_by_name(name, value):
    with pytest.raises(ConfigError) as error:
        override(Config(task="x"), {name: value})
    message = str(error.value)
    assert message.startswith(f"{name}: expected ")
    assert message.endswith(f", got {value!r}")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("collect.max_std", 0.0),
        ("collect.parameter_noise", 0.0),
        ("fit.weight_decay", 0.0),
        ("fit.reinitialise_every", 0),
        ("fit.max_steps", None),
        ("trpo.damping", 0.0),
        ("advantage.discount", 0.0),
        ("advantage.gae_lambda", 1.0),
        ("validate.threshold", 0.0),
        ("validate.threshold", 1.0),
        ("ensemble.hidden", ()),
        ("policy.hidden", ()),
        ("advantage.value_hidden", ()),
        ("seed", 2**31 - 1),
        ("real_steps", None),
    ],
)
def test_values_at_the_edge_are_possible(name, value):
    config = override(Config(task="x"), {name: value})
    assert flatten(config)[name] == value
    assert from_json(to_json(config)) == config


def test_steps_can_only_fall_to_0_over_a_number_of_them():
    with pytest.raises(ConfigError, match=r"^fit.max_steps: expected a number of steps with fit.decay, got None$"):
        override(Config(task="x"), {"fit.decay": True})
    assert override(Config(task="x"), {"fit.max_steps": 10, "fit.decay": True}).fit.decay


def edited(**changes):
    """The JSON of a config with nested settings changed, e.g. fit__patience=3; ... removes."""
    data = json.loads(to_json(Config(task="Swimmer")))
    for path, value in changes.items():
        *outer, last = path.split("__")
        node = data
        for key in outer:
            node = node[key]
        if value is ...:
            del node[last]
        else:
            node[last] = value
    return json.dumps(data)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["config: expected JSON"]),
        ("{", ["config: expected JSON"]),
        ("[]", ["config: expected an object", "got []"]),
        ("3", ["config: expected an object", "got 3"]),
        ("{}", ["missing task", "missing fit"]),
        (edited(fit=...), ["config: expected exactly", "missing fit"]),
        (edited(fit__patience=...), ["config.fit: expected exactly", "missing patience"]),
        (edited(fit__colour=1), ["config.fit: expected exactly", "unknown colour"]),
        (edited(fit=3), ["config.fit: expected an object", "got 3"]),
        (edited(fit__patience="many"), ["config.fit.patience: expected int, got 'many'"]),
        (edited(fit__patience=2.5), ["config.fit.patience: expected int, got 2.5"]),
        (edited(fit__patience=True), ["config.fit.patience: expected int, got True"]),
        (edited(fit__patience=None), ["config.fit.patience: expected int, got None"]),
        (edited(fit__learning_rate="fast"), ["config.fit.learning_rate: expected float, got 'fast'"]),
        (edited(fit__learning_rate=False), ["config.fit.learning_rate: expected float, got False"]),
        (edited(deterministic=1), ["config.deterministic: expected bool, got 1"]),
        (edited(task=7), ["config.task: expected str, got 7"]),
        (edited(real_steps="all"), ["config.real_steps: expected int, got 'all'"]),
        (edited(policy__hidden=32), ["config.policy.hidden: expected a list, got 32"]),
        (edited(policy__hidden=[32, "x"]), ["config.policy.hidden: expected int, got 'x'"]),
        (edited(imagine__sampling="dice"), ["config.imagine.sampling: expected one of step_rand", "got 'dice'"]),
        (edited(collect__std_per=1), ["config.collect.std_per: expected one of episode, step, got 1"]),
        (edited(ensemble__members=0), ["ensemble.members: expected at least 1, got 0"]),
        (edited(trpo__max_kl=float("nan")), ["trpo.max_kl: expected a finite number > 0, got nan"]),
    ],
)
def test_a_wrong_file_is_refused_with_place_expected_and_got(text, parts):
    with pytest.raises(ConfigError) as error:
        from_json(text)
    for part in parts:
        assert part in str(error.value)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.just(10**400) | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=3,
)


@given(st.sampled_from(NAMES), anything)
@settings(max_examples=200, deadline=None)
def test_any_file_makes_a_config_or_one_clear_error(name, value):
    try:
        config = from_json(edited(**{name.replace(".", "__"): value}))
    except ConfigError as error:
        assert name in str(error)  # noqa: PT017 (either outcome is right)
    else:
        assert from_json(to_json(config)) == config


def test_whole_numbers_are_accepted_for_fractions():
    config = from_json(edited(collect__max_std=3))
    assert config.collect.max_std == 3.0
    assert type(config.collect.max_std) is float


def test_override_replaces_only_what_it_names():
    base = Config(task="x")
    config = override(base, {"fit.patience": 7, "seed": 3, "policy.hidden": (8,)})
    assert (config.fit.patience, config.seed, config.policy.hidden) == (7, 3, (8,))
    assert set(difference(base, config)) == {"fit.patience", "seed", "policy.hidden"}


@pytest.mark.parametrize("name", ["colour", "fit.colour", "fit.patience.more", "seed.more", "fit.", "", "Fit.patience"])
def test_override_refuses_an_unknown_setting(name):
    with pytest.raises(ConfigError, match=f"unknown setting '{name}'"):
        override(Config(task="x"), {name: 1})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("validate.rule", "nobody"),
        ("imagine.sampling", "dice"),
        ("improver", "luck"),
        ("fit.patience", "many"),
        ("fit.patience", 2.5),
        ("deterministic", 1),
        ("policy.hidden", 32),
        ("fit", 3),
    ],
)
def test_override_refuses_a_value_of_the_wrong_kind(name, value):
    with pytest.raises(ConfigError, match=rf"{name}: expected"):
        override(Config(task="x"), {name: value})


def test_only_settings_newer_than_a_file_may_be_missing_from_it():
    added = {"__".join(name.split(".")[1:]): ... for name in ADDED}
    assert from_json(edited(**added)) == from_json(edited())
    committed = sorted(RESULTS.glob("*/*/*/seed-*/config.json"))
    assert committed
    assert [path for path in committed if folder_name(from_json(path.read_text()).task) not in path.parts] == []
