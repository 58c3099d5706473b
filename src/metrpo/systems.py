"""The systems that the paper compares, by name: what each changes in a task's preset.

Add one by a row here and its name in `metrpo.config.System`; `metrpo train TASK --system NAME` runs it.
"""

from __future__ import annotations

from typing import Any

Overrides = dict[str, Any]
"""Dotted setting -> value."""

_VANILLA: Overrides = {"ensemble.members": 1}
"""One model, and that model decides when to stop (the paper's Algorithm 1 asks for no more)."""

_SVG: Overrides = {
    "method": "svg",
    "iterations": 100,
    "ensemble.members": 1,
    "ensemble.hidden": (512, 512),
    "fit.learning_rate": 1e-4,
    "fit.batch_size": 128,
    "gradient.learning_rate": 1e-3,
    "policy.initial_std": 1.0,
}
"""Networks, batch and step size of the model: the paper, appendix "Baselines"."""

ACTOR_CRITIC: Overrides = {
    "improver": "actor-critic",
    "actor_critic.agreement": 0.2,
    "advantage.discount": 0.995,
    "collect.piece": 50,
    "collect.steps": 250,
    "collect.validation_fraction": 0.1,
    "ensemble.activation": "silu",
    "ensemble.probabilistic": True,
    "evaluation_episodes": 3,
    "fit.decay": True,
    "fit.max_steps": 400,
    "fit.weight_decay": 0.1,
    "gradient.learning_rate": 1e-3,
    "imagine.start": "anywhere",
    "iterations": 189,
    "policy.hidden": (256, 256),
    "policy.normalise": True,
    "validate.real_episodes": 0,
    "validate.rule": "no_early",
    "validate.starts": 10,
}
"""`metrpo.presets` adds what depends on the length of episodes (docs/actor-critic.md)."""

SYSTEMS: dict[str, Overrides] = {
    "me-trpo": {},
    # Figure "num_models-comparison": the size of the ensemble (5 is me-trpo).
    "k-1": _VANILLA,
    "k-10": {"ensemble.members": 10},
    "k-20": {"ensemble.members": 20},
    # Figure "optimization-comparison": ways to improve the policy with one model (TRPO is k-1). bptt is the paper's
    # Algorithm 1, vanilla model-based reinforcement learning.
    "model-ppo": _VANILLA | {"improver": "ppo"},
    "model-vpg": _VANILLA | {"improver": "vpg", "gradient.learning_rate": 1e-2},
    "bptt": _VANILLA | {"improver": "bptt", "gradient.learning_rate": 1e-3},
    "bptt-stochastic": _VANILLA | {"improver": "bptt-stochastic", "gradient.learning_rate": 1e-3},
    # Figure "sampling-comparison": the next imagined state (step_rand is me-trpo).
    "model_mean_std": {"imagine.sampling": "model_mean_std"},
    "model_mean": {"imagine.sampling": "model_mean"},
    "model_med": {"imagine.sampling": "model_med"},
    "eps_rand": {"imagine.sampling": "eps_rand"},
    "one_model": {"imagine.sampling": "one_model"},
    # Figure "validation-comparison": when to stop improving (ensemble is me-trpo).
    "validate-real": {"validate.rule": "real"},
    "validate-trpo_mean": {"validate.rule": "trpo_mean"},
    "validate-no_early_50": {"validate.rule": "no_early", "validate.max_updates": 50},
    "validate-no_early_5": {"validate.rule": "no_early", "validate.max_updates": 5},
    "validate-one_model": {"validate.rule": "one_model"},
    # Figure "data-comparison": learning in the real environment (settings: the paper, appendix "Baselines").
    "trpo": {
        "method": "trpo",
        "iterations": 20,
        "collect.steps": 50_000,
        "trpo.max_kl": 0.05,
        "policy.initial_std": 1.0,
        "advantage.baseline": "linear",
        "advantage.gae_lambda": 1.0,
    },
    "ppo": {"method": "ppo", "iterations": 50, "collect.steps": 20_480, "policy.initial_std": 1.0},
    "ddpg": {"method": "ddpg", "iterations": 60, "collect.steps": 5_000},
    "svg-1": _SVG | {"svg.horizon": "1"},
    "svg-inf": _SVG,
    # Not the paper's: an off-policy actor-critic in the ensemble, for long episodes.
    "actor-critic": ACTOR_CRITIC,
}

PAPER: dict[str, Overrides] = {
    "trpo": {"iterations": 1000},  # "we train the policies for 1000 iterations"
    "ppo": {"iterations": 489},  # "trained for 10^7 steps"
    "ddpg": {"iterations": 800},  # "2000 epochs", each of 20 cycles of 100 steps in that implementation
}
"""What the paper's budgets change on top under the preset `paper`."""
