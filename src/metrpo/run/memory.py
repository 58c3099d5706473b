"""Checks that a run's arrays fit into memory, before the first of them is created."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from metrpo.config import Config
from metrpo.errors import ConfigError
from metrpo.run import machine
from metrpo.world.task import Task

_FLOAT = 4
"""Bytes of a number."""
_COPIES = 4
"""Copies of every weight during training: itself, the best so far, and the optimizer's two."""


@dataclass(frozen=True)
class Need:
    """The least memory that a setting asks for."""

    setting: str
    """Its name, "imagine.steps"."""
    value: object
    what: str
    """What takes the memory."""
    size: int
    """Bytes."""


def require_memory(config: Config, task: Task) -> None:
    """Raises `ConfigError`, naming the setting and the size, when what the run must hold exceeds the memory."""
    there = machine.memory()
    for need in _needs(config, task):
        if need.size > there:
            raise ConfigError(
                f"{need.setting}: expected a value that fits into {_gib(there)} of memory, got {need.value}, for which "
                f"{need.what} alone take {_gib(need.size)}; choose a smaller one"
            )


def _needs(config: Config, task: Task) -> list[Need]:
    s, a, e = task.state_size, task.action_size, config.ensemble
    network = _weights((s + a, *e.hidden, task.predicted)) * _FLOAT * _COPIES
    policy = _weights((s, *config.policy.hidden, a)) * _FLOAT * _COPIES
    value = _weights((s, *config.advantage.value_hidden, 1)) * _FLOAT * _COPIES
    needs = [Need("policy.hidden", config.policy.hidden, "the policy's weights", policy)]
    if config.method == "model-based":
        batch = e.members * config.fit.batch_size * (s + a + task.observation_size) * _FLOAT
        imagined = config.imagine.steps * (2 * s + a) * _FLOAT
        starts = e.members * config.validate.starts * s * _FLOAT
        needs += [
            Need("ensemble.hidden", e.hidden, "one model's weights and optimizer state", network),
            Need("ensemble.members", e.members, "the models' weights and optimizer states", e.members * network),
            Need("imagine.steps", config.imagine.steps, "imagined transitions", imagined),
            Need("fit.batch_size", config.fit.batch_size, "the minibatches of a step", batch),
            Need("validate.starts", config.validate.starts, "the start states of validation", starts),
        ]
        if config.by_critics:
            needs += _actor_critic_needs(config, task)
        elif config.advantage.baseline == "network":
            needs.append(Need("advantage.value_hidden", config.advantage.value_hidden, "the value network", value))
    return needs


def _actor_critic_needs(config: Config, task: Task) -> list[Need]:
    a, row = config.actor_critic, 2 * task.state_size + task.action_size
    critics = a.critics * _weights((task.state_size + task.action_size, *a.critic_hidden, 1)) * _FLOAT * _COPIES
    states = a.batch_size * max(a.horizon * row, a.block * task.state_size) * _FLOAT
    real = a.block * a.real_batch * row * _FLOAT
    return [
        Need("actor_critic.critic_hidden", a.critic_hidden, "the critics' weights", critics),
        Need("actor_critic.batch_size", a.batch_size, "imagined transitions", states),
        Need("actor_critic.real_batch", a.real_batch, "the real transitions of a block", real),
    ]


def _weights(sizes: tuple[int, ...]) -> int:
    return sum((inputs + 1) * outputs for inputs, outputs in pairwise(sizes))


def _gib(size: int) -> str:
    return f"{size / 2**30:,.1f} GiB"
