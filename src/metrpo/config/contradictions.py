"""Settings that are possible each, but not together."""

from __future__ import annotations

from metrpo.config.schema import Config
from metrpo.errors import ConfigError

_LIMITED = ("model-based", "trpo")
"""Methods whose real steps `world.collection` plays, and that learn from actions as executed."""

_NO_VOTES = ("real", "trpo_mean")
"""Rules that ask more than the models' values."""


def require_consistent(config: Config) -> None:
    """Raises `ConfigError` for settings that contradict each other, whatever the task."""
    if config.system == "actor-critic" and not config.by_critics:
        raise ConfigError(
            f"improver: expected actor-critic with the system actor-critic, got {config.improver}; "
            "--system me-trpo has the other improvers"
        )
    if config.method != "model-based" and (config.data is not None or config.real_steps == 0):
        raise ConfigError(f"data: expected the method model-based to learn from offline data, got {config.method}")
    learner = config.improver if config.by_critics else config.method
    if learner not in _LIMITED and (config.max_action < 1 or config.max_change is not None):
        limit = "max_action" if config.max_action < 1 else "max_change"
        raise ConfigError(f"{limit}: expected the system me-trpo or trpo to learn under limits, got {learner}")
    if config.by_critics and config.advantage.discount >= 1:
        got = config.advantage.discount
        raise ConfigError(
            f"advantage.discount: expected less than 1 with the improver actor-critic (0.995, say), got {got}"
        )
    if config.by_critics and config.validate.rule in _NO_VOTES:
        raise ConfigError(
            "validate.rule: expected ensemble, one_model or no_early with the improver actor-critic, got "
            f"{config.validate.rule}"
        )
