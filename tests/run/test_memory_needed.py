"""Settings that ask for more memory than there is are refused before they take any."""

import dataclasses

import pytest

import probe
from metrpo.errors import ConfigError
from metrpo.external import begin
from metrpo.presets import preset
from metrpo.run import machine
from metrpo.run.memory import require_memory
from metrpo.training import init
from metrpo.world.registry import tasks

PLAIN = dataclasses.replace(preset("Swimmer"), task="Probe")
HUGE = [
    ("ensemble", "members", 100_000_000, r"the models' weights and optimizer states alone take [\d,.]+ GiB"),
    ("ensemble", "hidden", (10**6, 10**6), "one model's weights and optimizer state alone take 14,901"),
    ("imagine", "steps", 10**12, "imagined transitions alone take 22,351.7 GiB"),
    ("imagine", "steps", 10**30, "imagined transitions alone take"),
    ("fit", "batch_size", 10**12, "the minibatches of a step alone take"),
    ("validate", "starts", 10**12, "the start states of validation alone take"),
    ("policy", "hidden", (10**6, 10**6), "the policy's weights alone take"),
]


def with_setting(room, name, value):
    return dataclasses.replace(PLAIN, **{room: dataclasses.replace(getattr(PLAIN, room), **{name: value})})


@pytest.mark.parametrize(("room", "name", "value", "message"), HUGE)
def test_what_cannot_fit_is_one_sentence_with_its_size(room, name, value, message, tmp_path):
    config = with_setting(room, name, value)
    with probe.registered():
        with pytest.raises(ConfigError, match=rf"^{room}\.{name}: expected a value that fits into .* GiB .*{message}"):
            init(config)
        with pytest.raises(ConfigError, match=message):
            begin(config, tmp_path / "run")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("critic_hidden", (10**6, 10**6), "the critics' weights alone take"),
        ("batch_size", 10**12, "imagined transitions alone take"),
        ("real_batch", 10**12, "the real transitions of a block alone take"),
    ],
)
def test_an_actor_critic_that_cannot_fit_is_refused_too(name, value, message):
    plain = dataclasses.replace(preset("Swimmer", "fast", "actor-critic"), task="Probe")
    config = dataclasses.replace(plain, actor_critic=dataclasses.replace(plain.actor_critic, **{name: value}))
    with probe.registered(), pytest.raises(ConfigError, match=rf"^actor_critic\.{name}: expected .*{message}"):
        init(config)


@pytest.mark.parametrize("name", ["fast", "paper", "long-horizon"])
def test_every_preset_fits_into_two_gib(name, monkeypatch):
    monkeypatch.setattr(machine, "memory", lambda: 2 * 2**30)
    for task in tasks().values():
        require_memory(preset(task.name, name), task)


def test_a_container_may_have_less_than_its_machine(monkeypatch):
    assert machine.memory() > 2**26
    monkeypatch.setattr(machine.Path, "read_text", lambda self: "123456789\n")
    assert machine.memory() == 123456789
    monkeypatch.setattr(machine.Path, "read_text", lambda self: "max\n")
    assert machine.memory() == machine.os.sysconf("SC_PAGE_SIZE") * machine.os.sysconf("SC_PHYS_PAGES")
