"""Settings that a run never reads: to change them all changes nothing, and whoever changes one is told."""

from __future__ import annotations

import logging
import types
import typing

import jax
import numpy as np
import pytest

import probe
from counted_run import run
from metrpo.commands.options import warn_of_unread
from metrpo.config import Config, flatten, unread
from metrpo.errors import ConfigError
from metrpo.launch.grid import Grid
from metrpo.presets import changed, configured, override, preset
from metrpo.systems import SYSTEMS
from metrpo.tune.search import Search
from metrpo.tune.space import Choices, Range

pytestmark = pytest.mark.usefixtures("plain_curve")

SMALL = {
    "actor_critic.batch_size": 8,
    "actor_critic.block": 5,
    "actor_critic.branch_steps": 4,
    "actor_critic.critic_hidden": (4,),
    "actor_critic.random_steps": 40,
    "actor_critic.real_batch": 8,
    "collect.steps": 40,
    "ensemble.hidden": (4,),
    "evaluation_episodes": 1,
    "fit.batch_size": 20,
    "fit.max_steps": 10,
    "imagine.steps": 100,
    "policy.hidden": (4,),
    "svg.model_steps": 3,
    "svg.value_steps": 3,
    "trust_reward": True,
    "validate.max_updates": 5,
    "validate.starts": 4,
}
SEEN = ("me-trpo", "bptt", "actor-critic", "trpo", "svg-1")
"""Systems whose settings are changed, one of each kind that needs no library besides."""
CLOCK = ("seconds_", "wall_seconds")


@pytest.fixture(scope="module", autouse=True)
def _probe_is_a_task():
    with probe.registered():
        yield


def another(name, value):
    """Another possible value of a setting."""
    group, _, own = name.rpartition(".")
    hints = typing.get_type_hints(type(getattr(Config("Probe"), group) if group else Config("Probe")))
    if typing.get_origin(hints[own]) is typing.Literal:
        return next(choice for choice in typing.get_args(hints[own]) if choice not in (value, "actor-critic"))
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return (*value, 3)
    if isinstance(value, float):
        return 0.9 * value or 0.1
    return (value or 1) + 1


def learned(config):
    """The policy's numbers after two iterations, and the rows without their clocks."""
    done = run(config, iterations=2)
    rows = [{k: v for k, v in row.items() if not k.startswith(CLOCK)} for row in done.rows]
    return [np.asarray(x).tobytes() for x in jax.tree.leaves(done.states[-1].policy)], str(rows)


@pytest.mark.parametrize("system", SEEN)
def test_all_unread_settings_together_change_nothing(system):
    config = configured("Probe", "fast", system, SMALL)
    names = unread(config, flatten(config))
    assert {"me-trpo": "ppo.clip", "trpo": "ensemble.members", "svg-1": "trpo.max_kl"}.get(
        system, "svg.horizon"
    ) in names
    values = {name: another(name, flatten(config)[name]) for name in names}
    assert learned(override(config, values)) == learned(config)


def test_every_setting_is_some_systems():
    configs = [preset("Swimmer", name, system) for system in SYSTEMS for name in ("fast", "paper")]
    for name in flatten(configs[0]):
        assert not all(unread(config, [name]) for config in configs), name


def test_what_a_system_changes_is_what_it_reads():
    # That branches begin anywhere, and that one model is enough, is said of them all the same.
    said = {"actor-critic": {"imagine.start"}, "svg-1": {"ensemble.members"}}
    said["svg-inf"] = said["svg-1"]
    for name, settings in SYSTEMS.items():
        assert set(unread(preset("Pendulum-v1", "fast", name), settings)) == said.get(name, set()), name


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trpo.max_kl": 0.02}, "trpo.max_kl is a setting of the improver trpo; it has no effect on this run"),
        ({"validate.patience": 9}, "validate.patience is a setting of me-trpo; it has no effect on this run"),
        ({"actor_critic.block": 10, "seed": 4, "fit.max_steps": 300}, None),
    ],
)
def test_who_changes_a_setting_in_vain_is_told(settings, message, caplog):
    config = configured("Snake", "fast", None, settings)
    assert changed(config) == settings
    with caplog.at_level(logging.WARNING, "metrpo"):
        warn_of_unread(config)
    assert [f"{message} (actor-critic)"] * bool(message) == [r.getMessage() for r in caplog.records]


def test_a_grid_or_search_over_what_no_run_reads_is_refused():
    values = {"trpo.max_kl": (0.01, 0.02)}
    message = (
        r"trpo\.max_kl: expected a setting that some run reads, got one of the improver trpo, and every run is act"
    )
    with pytest.raises(ConfigError, match=message):
        Grid(("Snake",), settings=values).runs()
    with pytest.raises(ConfigError, match=message):
        Search("Snake", {"trpo.max_kl": Range(0.01, 0.02)})
    assert len(Grid(("Snake", "Swimmer"), settings=values).runs()) == 4  # Swimmer's usual system reads it
    assert len(Grid(("Snake",), settings={"trpo.max_kl": (0.01,)}).runs()) == 1
    searched = Search("Swimmer", {"ppo.clip": Range(0.1, 0.3), "improver": Choices(("trpo", "ppo"))})
    assert searched.system == "me-trpo"


def test_the_commands_say_so(monkeypatch):
    from metrpo.commands import init, train

    for module in (train, init):
        said = []
        monkeypatch.setattr(module, "warn_of_unread", said.append)
        command = types.SimpleNamespace(config="a config", directory="a folder")
        with pytest.raises(AttributeError):  # a text is no config: nothing runs
            module.run(command)
        assert said == ["a config"]
