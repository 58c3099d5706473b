"""Settings of the ways to improve a policy; `method` and `improver` decide which of them a run reads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from metrpo.config.checks import nonnegative, positive, require


@dataclass(frozen=True)
class TRPOConfig:
    """The trust-region step (Schulman et al. 2015; step size from the paper, appendix A.1.3)."""

    max_kl: float = 0.01
    """Trust region: the maximum mean KL divergence from the old to the new policy."""
    cg_iterations: int = 10
    """Conjugate-gradient iterations."""
    fisher_every: int = 1
    """Average the Fisher matrix over only every n-th step of the batch (Schulman et al. 2015, appendix C)."""
    damping: float = 1e-5
    """Added to the Fisher matrix's diagonal."""
    backtrack_ratio: float = 0.8
    """The line search tries backtrack_ratio^i of the full step, i = 0, 1, ..."""
    max_backtracks: int = 15
    """Steps of the line search; if all fail, the update is rejected."""

    def __post_init__(self) -> None:
        require(positive(self.max_kl), "trpo.max_kl", self.max_kl, "a finite number > 0")
        require(self.cg_iterations >= 1, "trpo.cg_iterations", self.cg_iterations, "at least 1")
        require(self.fisher_every >= 1, "trpo.fisher_every", self.fisher_every, "at least 1")
        require(nonnegative(self.damping), "trpo.damping", self.damping, "a finite number >= 0")
        require(
            0 < self.backtrack_ratio < 1, "trpo.backtrack_ratio", self.backtrack_ratio, "between 0 and 1, both excluded"
        )
        require(self.max_backtracks >= 1, "trpo.max_backtracks", self.max_backtracks, "at least 1")


@dataclass(frozen=True)
class GradientConfig:
    """Adam on the policy's parameters, for every improver but TRPO."""

    learning_rate: float = 3e-4
    """Adam's step size."""
    max_norm: float = 10.0
    """Clip gradients to this norm (for SVG: the paper, appendix A.2.1)."""

    def __post_init__(self) -> None:
        require(positive(self.learning_rate), "gradient.learning_rate", self.learning_rate, "a finite number > 0")
        require(self.max_norm > 0, "gradient.max_norm", self.max_norm, "a number > 0")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization on imagined steps (Schulman et al. 2017), for `improver = "ppo"`."""

    clip: float = 0.2
    """Clip probability ratios to 1 +- clip."""
    epochs: int = 10
    """Epochs over the batch per policy update."""
    minibatches: int = 32
    """Minibatches per epoch, one gradient step each."""

    def __post_init__(self) -> None:
        require(0 < self.clip < 1, "ppo.clip", self.clip, "between 0 and 1, both excluded")
        require(self.epochs >= 1, "ppo.epochs", self.epochs, "at least 1")
        require(self.minibatches >= 1, "ppo.minibatches", self.minibatches, "at least 1")


@dataclass(frozen=True)
class SVGConfig:
    """Stochastic value gradients (Heess et al. 2015), for `method = "svg"`."""

    horizon: Literal["inf", "1"] = "inf"
    """SVG(inf): gradients through the model along the whole real episode; SVG(1): through one step, then a learned
    value."""
    model_steps: int = 200
    """Minibatches of the model after every episode, from all data so far."""
    value_steps: int = 50
    """SVG(1): gradient steps of the value network after every episode, on that episode's returns."""
    value_learning_rate: float = 1e-3
    """SVG(1): Adam's step size for the value network."""

    def __post_init__(self) -> None:
        require(self.model_steps >= 1, "svg.model_steps", self.model_steps, "at least 1")
        require(self.value_steps >= 1, "svg.value_steps", self.value_steps, "at least 1")
        rate = self.value_learning_rate
        require(positive(rate), "svg.value_learning_rate", rate, "a finite number > 0")


@dataclass(frozen=True)
class ActorCriticConfig:
    """The off-policy actor-critic in the ensemble, for `improver = "actor-critic"` (docs/actor-critic.md).

    Its actor is of `policy.hidden` and learns by `gradient`; its discount is `advantage.discount`.
    """

    updates_per_step: float = 1.0
    """Updates of actor and critics for every real step collected."""
    random_steps: int = 3000
    """Real steps of uniformly random actions, at least, which the first iteration collects."""
    batch_size: int = 256
    """States from which an update imagines."""
    real_batch: int = 256
    """Real transitions from which the critics learn in every update, besides imagined ones."""
    horizon: int = 3
    """Steps that an update imagines: for the critics' targets, and for the actor's gradient through the models. 0:
    none, the critics learn from real transitions alone (soft actor-critic)."""
    branch_steps: int = 20
    """Steps imagined from states of the dataset; updates start in the states that these reach."""
    trust: float = 1.0
    """Imagined steps end where members disagree by more than this times their disagreement on 95 % of the held-out
    data, and by more than `agreement`; 0: never."""
    agreement: float = 0.0
    """Disagreement that is trusted in any case, in standard deviations of a step's change."""
    margin: float = 0.25
    """Imagined states, their changes and learned rewards stay within the data's range, and this times it beyond."""
    block: int = 50
    """Updates in one compiled call; the states that they start in are imagined afresh for each."""
    critics: int = 2
    """Networks that value states and actions; the least of their targets counts."""
    critic_hidden: tuple[int, ...] = (256, 256)
    """Sizes of a critic's hidden layers (SiLU, normalised)."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critics."""
    critic_steps: int = 1
    """The first so many states of an imagined episode are what critics learn from, each valued by all that follows."""
    target_rate: float = 0.02
    """Share of the critics that goes into their moving average, the targets, at every update."""
    entropy_weight: float = 0.15
    """What a nat of the actor's entropy is worth at first, in standard deviations of the first rewards."""
    entropy_target: float = -1.0
    """Nats for each action towards which that weight steers the entropy."""
    entropy_learning_rate: float = 3e-4
    """Adam's step size for the logarithm of that weight."""
    terminal: Literal["mean", "min"] = "min"
    """How the critics value the actor's last imagined state: by their mean or their minimum."""

    def __post_init__(self) -> None:
        name = "actor_critic"
        for field_ in ("updates_per_step", "critic_learning_rate", "entropy_weight", "entropy_learning_rate"):
            value = getattr(self, field_)
            require(positive(value), f"{name}.{field_}", value, "a finite number > 0")
        for field_ in ("batch_size", "branch_steps", "block", "critics", "critic_steps"):
            require(getattr(self, field_) >= 1, f"{name}.{field_}", getattr(self, field_), "at least 1")
        require(self.horizon >= 0, f"{name}.horizon", self.horizon, "at least 0")
        least = 0 if self.horizon else 1
        require(self.real_batch >= least, f"{name}.real_batch", self.real_batch, f"at least {least}")
        require(nonnegative(self.trust), f"{name}.trust", self.trust, "a finite number >= 0")
        require(nonnegative(self.agreement), f"{name}.agreement", self.agreement, "a finite number >= 0")
        require(self.random_steps >= 0, f"{name}.random_steps", self.random_steps, "at least 0")
        require(nonnegative(self.margin), f"{name}.margin", self.margin, "a finite number >= 0")
        hidden = self.critic_hidden
        require(all(n >= 1 for n in hidden), f"{name}.critic_hidden", hidden, "sizes of at least 1")
        require(0 < self.target_rate <= 1, f"{name}.target_rate", self.target_rate, "above 0 and at most 1")
        target = self.entropy_target
        require(math.isfinite(target), f"{name}.entropy_target", target, "a finite number")
