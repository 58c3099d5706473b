"""Settings that a run never reads, because they are another method's, improver's or rule's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from metrpo.config.schema import Config


class Reader(NamedTuple):
    """Which runs read a setting."""

    reads: Callable[[Config], bool]
    name: str
    """Of these runs or their choice, as it stands after "a setting of"."""


_ENSEMBLE = Reader(lambda c: c.method == "model-based", "methods that learn in the ensemble")
_PHASE = Reader(lambda c: _ENSEMBLE.reads(c) and not c.by_critics, "me-trpo")
_SVG = Reader(lambda c: c.method == "svg", "svg-1 and svg-inf")
_MODEL = Reader(lambda c: _ENSEMBLE.reads(c) or _SVG.reads(c), "methods that learn models")
_CRITICS = Reader(lambda c: _ENSEMBLE.reads(c) and c.by_critics, "actor-critic")
_TRPO = Reader(lambda c: c.method == "trpo" or (_PHASE.reads(c) and c.improver == "trpo"), "the improver trpo")
_SCORES = Reader(lambda c: _PHASE.reads(c) and c.improver in ("trpo", "ppo", "vpg"), "the improvers trpo, ppo and vpg")
_ADVANTAGES = Reader(lambda c: c.method == "trpo" or _PHASE.reads(c), "me-trpo and trpo")
_NETWORK = Reader(
    lambda c: _ADVANTAGES.reads(c) and c.advantage.baseline == "network", 'advantage.baseline = "network"'
)
_LINEAR = Reader(lambda c: _ADVANTAGES.reads(c) and c.advantage.baseline == "linear", 'advantage.baseline = "linear"')
_VOTES = Reader(lambda c: _ENSEMBLE.reads(c) and c.validate.rule != "no_early", 'any validate.rule but "no_early"')

_READERS = {
    "actor_critic": _CRITICS,
    "advantage": _ADVANTAGES,
    "advantage.discount": Reader(lambda c: True, "every run"),
    "advantage.ridge": _LINEAR,
    "advantage.value_batch_size": _NETWORK,
    "advantage.value_hidden": _NETWORK,
    "advantage.value_learning_rate": _NETWORK,
    "advantage.value_steps": _NETWORK,
    "collect.max_std": _PHASE,
    "collect.max_train": _MODEL,
    "collect.max_validation": _ENSEMBLE,
    "collect.noise_correlation": _ENSEMBLE,
    "collect.parameter_noise": _PHASE,
    "collect.piece": _ENSEMBLE,
    "collect.std_per": _PHASE,
    "collect.std_power": _PHASE,
    "collect.validation_fraction": _ENSEMBLE,
    "ensemble": _MODEL,
    "ensemble.members": _ENSEMBLE,
    "fit": _ENSEMBLE,
    "fit.batch_size": _MODEL,
    "fit.learning_rate": _MODEL,
    "fit.loss_units": _MODEL,
    "fit.patience": Reader(lambda c: _ENSEMBLE.reads(c) and not c.fit.decay, "fits without fit.decay"),
    "gradient": Reader(
        lambda c: _SVG.reads(c) or (_ENSEMBLE.reads(c) and c.improver != "trpo"), "every improver but trpo"
    ),
    "imagine": _ENSEMBLE,
    "imagine.start": _PHASE,
    "imagine.steps": _PHASE,
    "improver": _ENSEMBLE,
    "learn_reward": _MODEL,
    "policy.initial_std": Reader(
        lambda c: c.method != "ddpg" and not _CRITICS.reads(c), "every system but actor-critic and ddpg"
    ),
    "policy.mean_penalty": _SCORES,
    "policy.min_std": _PHASE,
    "policy.normalise": _ENSEMBLE,
    "ppo": Reader(lambda c: _PHASE.reads(c) and c.improver == "ppo", "the improver ppo"),
    "svg": _SVG,
    "trpo": _TRPO,
    "validate": _PHASE,
    "validate.real_episodes": _ENSEMBLE,
    "validate.rule": _ENSEMBLE,
    "validate.starts": _ENSEMBLE,
    "validate.threshold": _VOTES,
}
"""Setting or section -> who reads it, where that is not every run; a setting's own row goes before its section's."""


def unread(config: Config, names: Iterable[str]) -> dict[str, str]:
    """Those of the dotted settings `names` that a run with this config never reads, and whose they are."""
    rows = {name: _READERS.get(name) or _READERS.get(name.partition(".")[0]) for name in names}
    return {name: row.name for name, row in rows.items() if row is not None and not row.reads(config)}
