"""What compiled code may read, and that every choice of a setting has its row in one table."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import re
import typing

import jax
import pytest

import metrpo
from metrpo.config import AdvantageConfig, Config, ImagineConfig, ValidateConfig
from metrpo.model.sampling import SAMPLINGS
from metrpo.policy.improvers.settings import PhaseSettings
from metrpo.policy.stopping import RULES
from metrpo.policy.value.value_table import VALUE_FUNCTIONS
from metrpo.presets import override
from metrpo.stages.search_table import SEARCHES

ROOMS = ("algorithm", "stages", "policy_phase", "actor_critic_phase", "model", "policy", "baselines")
CHOICES = [
    (Config, "improver", SEARCHES),
    (AdvantageConfig, "baseline", VALUE_FUNCTIONS),
    (ImagineConfig, "sampling", SAMPLINGS),
    (ValidateConfig, "rule", RULES),
]


@pytest.mark.parametrize(("config", "setting", "table"), CHOICES, ids=[setting for _, setting, _ in CHOICES])
def test_a_setting_offers_the_rows_of_its_table(config, setting, table):
    assert set(typing.get_args(typing.get_type_hints(config)[setting])) == set(table)


def compiled():
    """{name: function} of all that JAX compiles in the rooms of the learned side."""
    found = {}
    for module in pkgutil.walk_packages(metrpo.__path__, "metrpo."):
        if module.name.split(".")[1] in ROOMS and "stable_baselines" not in module.name and "openai" not in module.name:
            for name, value in vars(importlib.import_module(module.name)).items():
                if isinstance(value, type(jax.jit(abs))) and value.__module__ == module.name:
                    found[f"{module.name}.{name}"] = value
    return found


def test_no_compiled_function_takes_the_whole_config():
    """A Config made up for it, with defaults where nobody looked, would be read by mistake."""
    functions = compiled()
    assert "metrpo.policy_phase._compiled_updates" in functions
    for name, function in functions.items():
        for argument, annotation in function.__wrapped__.__annotations__.items():
            assert not re.search(r"\bConfig\b", str(annotation)), f"{name} takes {argument}: {annotation}"


def test_a_phases_settings_have_no_defaults_and_know_no_seed():
    assert all(f.default is f.default_factory is dataclasses.MISSING for f in dataclasses.fields(PhaseSettings))
    config = Config("Probe")
    settings = PhaseSettings.of(config, cut=False)
    others = {"seed": 3, "iterations": 7, "fit.patience": 3, "validate.max_updates": 9, "collect.steps": 5}
    assert hash(PhaseSettings.of(override(config, others), cut=False)) == hash(settings)
    assert PhaseSettings.of(override(config, others), cut=False) == settings
    for name, value in {"trpo.damping": 0.1, "policy.mean_penalty": 1.0, "ppo.epochs": 3, "improver": "vpg"}.items():
        assert PhaseSettings.of(override(config, {name: value}), cut=False) != settings, name
