"""Every setting of a run: frozen dataclasses of numbers, strings and tuples.

The defaults are the paper's values (its appendix A.1) or, where it is silent, its authors' settings;
`metrpo.presets` holds what differs from task to task and the `fast` preset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from metrpo.config.checks import nonnegative, positive, require
from metrpo.config.env_kwargs import canonical


@dataclass(frozen=True)
class CollectConfig:
    """Collecting real transitions (paper, appendix A.1.1)."""

    steps: int = 3000
    """Real steps per outer iteration, at least: whole episodes are played until this many are reached."""
    max_std: float = 3.0
    """Exploration noise: the standard deviation is drawn from U[0, max_std]."""
    std_per: Literal["episode", "step"] = "episode"
    """How often that standard deviation is drawn: once an episode (the paper) or at every step (authors' code)."""
    parameter_noise: float = 3.0
    """Scale of the parameter noise: std = scale * |policy - previous policy|, redrawn every episode; 0: none."""
    validation_fraction: float = 1 / 3
    """Share of the new episodes that goes to the validation set."""
    piece: int | None = None
    """Cut episodes into pieces of at most so many steps before a share of them goes to the validation set; None: whole
    episodes go there (the paper)."""
    max_train: int = 200_000
    """Most transitions kept for training; the oldest go first."""
    max_validation: int = 100_000
    """Most transitions kept for validation; the oldest go first."""

    def __post_init__(self) -> None:
        require(self.steps >= 1, "collect.steps", self.steps, "at least 1")
        require(nonnegative(self.max_std), "collect.max_std", self.max_std, "a finite number >= 0")
        require(
            nonnegative(self.parameter_noise), "collect.parameter_noise", self.parameter_noise, "a finite number >= 0"
        )
        require(
            0 < self.validation_fraction < 1,
            "collect.validation_fraction",
            self.validation_fraction,
            "between 0 and 1, both excluded",
        )
        require(self.piece is None or self.piece >= 1, "collect.piece", self.piece, "at least 1")
        require(self.max_train >= 1, "collect.max_train", self.max_train, "at least 1")
        require(self.max_validation >= 1, "collect.max_validation", self.max_validation, "at least 1")


@dataclass(frozen=True)
class EnsembleConfig:
    """The ensemble of dynamics models (paper, section 5 and appendix A.1.2)."""

    members: int = 5
    """K, the number of models."""
    hidden: tuple[int, ...] = (1024, 1024)
    """Sizes of the hidden layers (ReLU)."""
    std_floor: float = 0.1
    """Smallest standard deviation of states and actions that the normaliser divides by."""
    delta_std_floor: float = 0.1
    """Smallest standard deviation of the change of state that the normaliser multiplies the output by."""

    def __post_init__(self) -> None:
        require(self.members >= 1, "ensemble.members", self.members, "at least 1")
        require(all(n >= 1 for n in self.hidden), "ensemble.hidden", self.hidden, "sizes of at least 1")
        for name in ("std_floor", "delta_std_floor"):
            require(positive(getattr(self, name)), f"ensemble.{name}", getattr(self, name), "a finite number > 0")


@dataclass(frozen=True)
class FitConfig:
    """Fitting the ensemble (paper, appendix A.1.2)."""

    learning_rate: float = 1e-3
    """Adam's step size."""
    weight_decay: float = 0.0
    """Decoupled weight decay (AdamW): each step shrinks weights, not biases, by learning_rate * weight_decay."""
    batch_size: int = 1000
    """Transitions per minibatch, drawn with replacement and for each model independently."""
    loss_units: Literal["raw", "std"] = "raw"
    """Units of the squared error, summed over state dimensions: raw state units (the paper), or each one's std."""
    products: Literal["float32", "bfloat16"] = "float32"
    """Type of the matrix products' operands, and so of the weights' gradients; sums and Adam stay float32."""
    validate_every: int = 5
    """Passes over the training set between two validations."""
    patience: int = 25
    """Stop when no model has improved its validation loss for this many passes."""
    max_passes: int = 2000
    """Most passes over the training set in one outer iteration."""
    max_steps: int | None = None
    """Most minibatches in one outer iteration, whatever the size of the training set; with a warm start they add up."""
    reinitialise_every: int = 5
    """Fresh weights in every n-th outer iteration (1, 1+n, ...), warm start in the others; 0: only in the first."""

    def __post_init__(self) -> None:
        require(positive(self.learning_rate), "fit.learning_rate", self.learning_rate, "a finite number > 0")
        require(nonnegative(self.weight_decay), "fit.weight_decay", self.weight_decay, "a finite number >= 0")
        for name in ("batch_size", "validate_every", "patience", "max_passes"):
            require(getattr(self, name) >= 1, f"fit.{name}", getattr(self, name), "at least 1")
        require(self.max_steps is None or self.max_steps >= 1, "fit.max_steps", self.max_steps, "at least 1")
        require(self.reinitialise_every >= 0, "fit.reinitialise_every", self.reinitialise_every, "at least 0")


@dataclass(frozen=True)
class ImagineConfig:
    """Imagined rollouts (paper, section 5, "Policy optimization")."""

    steps: int = 50_000
    """Imagined steps per policy update (TRPO's batch)."""
    sampling: Literal["step_rand", "model_mean_std", "model_mean", "model_med", "eps_rand", "one_model"] = "step_rand"
    """How the next state comes out of the ensemble: of a model drawn per step (step_rand) or per episode (eps_rand), of
    the first model, the models' mean or median, or drawn from a normal distribution fitted to them."""
    start: Literal["dataset", "anywhere", "reset"] = "dataset"
    """Start states of imagined episodes: those of real episodes in the dataset, any state of the training set, or fresh
    real resets (uncounted)."""
    horizon: int | None = None
    """Steps of an imagined episode, fewer than the task's: what would follow is valued by the baseline, then without
    regard to time. Needs advantage.discount < 1; goes with start = "anywhere". None: the task's."""
    products: Literal["float32", "bfloat16"] = "float32"
    """Type of the operands of the ensemble's matrix products, in imagination and in validation."""
    disagreement: float = 0.0
    """Added to every imagined reward: this times how far the models' predictions spread, in each dimension's std."""

    def __post_init__(self) -> None:
        require(self.steps >= 1, "imagine.steps", self.steps, "at least 1")
        require(self.horizon is None or self.horizon >= 1, "imagine.horizon", self.horizon, "at least 1")
        require(nonnegative(self.disagreement), "imagine.disagreement", self.disagreement, "a finite number >= 0")


@dataclass(frozen=True)
class PolicyConfig:
    """The Gaussian policy (paper, appendix A.1.3)."""

    hidden: tuple[int, ...] = (32, 32)
    """Sizes of the hidden layers (tanh)."""
    initial_std: float = 1.0
    """Standard deviation at the start of every policy phase."""
    normalise: bool = False
    """Let the policy see states normalised by the dataset, and not the dimensions that the models do not see."""
    min_std: float = 0.0
    """Above 0: the standard deviation goes on from phase to phase and is at least this where one starts; 0: every phase
    starts from initial_std (the paper)."""
    mean_penalty: float = 0.0
    """Taken from the surrogate of trpo, ppo and vpg: this times the squared excess of mean actions beyond 0.9, over the
    standard deviation."""

    def __post_init__(self) -> None:
        require(all(n >= 1 for n in self.hidden), "policy.hidden", self.hidden, "sizes of at least 1")
        require(positive(self.initial_std), "policy.initial_std", self.initial_std, "a finite number > 0")
        require(nonnegative(self.min_std), "policy.min_std", self.min_std, "a finite number >= 0")
        require(nonnegative(self.mean_penalty), "policy.mean_penalty", self.mean_penalty, "a finite number >= 0")


@dataclass(frozen=True)
class AdvantageConfig:
    """Advantages and their baseline (authors' settings: no discount, lambda 1, linear features)."""

    baseline: Literal["linear", "network"] = "linear"
    """What values a state: linear features, fitted afresh to every batch, or a network that goes on learning."""

    discount: float = 1.0
    """gamma."""
    gae_lambda: float = 1.0
    """lambda of generalised advantage estimation."""
    ridge: float = 1e-5
    """Ridge penalty of the linear-feature baseline."""
    value_hidden: tuple[int, ...] = (64, 64)
    """Sizes of the value network's hidden layers (tanh)."""
    value_steps: int = 40
    """Minibatches that the value network learns from after every policy update."""
    value_batch_size: int = 1000
    """Imagined steps per minibatch of the value network."""
    value_learning_rate: float = 1e-3
    """Adam's step size for the value network."""

    def __post_init__(self) -> None:
        require(0 <= self.discount <= 1, "advantage.discount", self.discount, "between 0 and 1")
        require(0 <= self.gae_lambda <= 1, "advantage.gae_lambda", self.gae_lambda, "between 0 and 1")
        require(positive(self.ridge), "advantage.ridge", self.ridge, "a finite number > 0")
        hidden = self.value_hidden
        require(all(n >= 1 for n in hidden), "advantage.value_hidden", hidden, "sizes of at least 1")
        for name in ("value_steps", "value_batch_size"):
            require(getattr(self, name) >= 1, f"advantage.{name}", getattr(self, name), "at least 1")
        rate = self.value_learning_rate
        require(positive(rate), "advantage.value_learning_rate", rate, "a finite number > 0")


@dataclass(frozen=True)
class TRPOConfig:
    """The trust-region step (Schulman et al. 2015; step size from the paper, appendix A.1.3)."""

    max_kl: float = 0.01
    """Trust region: the largest mean KL divergence from the old to the new policy."""
    cg_iterations: int = 10
    """Conjugate-gradient iterations."""
    fisher_every: int = 1
    """Average the Fisher matrix over every n-th step of the batch only (Schulman et al. 2015, appendix C)."""
    damping: float = 1e-5
    """Added to the Fisher matrix's diagonal."""
    backtrack_ratio: float = 0.8
    """The line search tries backtrack_ratio^i of the full step, i = 0, 1, ..."""
    max_backtracks: int = 15
    """Tries of the line search; when all fail the update is rejected."""

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
    """A gradient longer than this is shortened to it (for SVG: the paper, appendix A.2.1)."""

    def __post_init__(self) -> None:
        require(positive(self.learning_rate), "gradient.learning_rate", self.learning_rate, "a finite number > 0")
        require(self.max_norm > 0, "gradient.max_norm", self.max_norm, "a number > 0")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization on imagined steps (Schulman et al. 2017), for `improver = "ppo"`."""

    clip: float = 0.2
    """Probability ratios beyond 1 +- clip earn nothing more."""
    epochs: int = 10
    """Passes over the batch per policy update."""
    minibatches: int = 32
    """Parts that the batch is cut into in every pass, one gradient step each."""

    def __post_init__(self) -> None:
        require(0 < self.clip < 1, "ppo.clip", self.clip, "between 0 and 1, both excluded")
        require(self.epochs >= 1, "ppo.epochs", self.epochs, "at least 1")
        require(self.minibatches >= 1, "ppo.minibatches", self.minibatches, "at least 1")


@dataclass(frozen=True)
class SVGConfig:
    """Stochastic value gradients (Heess et al. 2015), for `method = "svg"`."""

    horizon: Literal["inf", "1"] = "inf"
    """SVG(inf): through the model along the whole real episode; SVG(1): through one step, then a learned value."""
    model_steps: int = 200
    """Minibatches after every episode, from all data so far."""
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
    horizon: int = 5
    """Steps that an update imagines: for the critics' targets, and for the actor's gradient through the models."""
    branch_steps: int = 20
    """Steps imagined from states of the dataset; updates start in the states that these reach."""
    margin: float = 0.25
    """Imagined states, their changes and learned rewards stay within the data's range, and this times it beyond."""
    block: int = 50
    """Updates in one compiled call; the states that they start in are imagined afresh for each."""
    critics: int = 2
    """Networks that value states and actions; the least of their targets counts."""
    critic_hidden: tuple[int, ...] = (256, 256)
    """Sizes of a critic's hidden layers (SiLU, normalised)."""
    critic_learning_rate: float = 3e-4
    """Adam's step size for the critics."""
    critic_steps: int = 1
    """The first so many states of an imagined episode are what critics learn from, each valued by all that follows."""
    target_rate: float = 0.005
    """Share of the critics that goes into their moving average, the targets, at every update."""
    entropy_weight: float = 0.1
    """What a nat of the actor's entropy is worth in rewards, at first."""
    entropy_target: float = -1.0
    """Nats for each action towards which that weight steers the entropy."""
    entropy_learning_rate: float = 3e-4
    """Adam's step size for the logarithm of that weight."""
    terminal: Literal["mean", "min"] = "mean"
    """How the critics value the actor's last imagined state: by their mean or their minimum."""

    def __post_init__(self) -> None:
        name = "actor_critic"
        for field_ in ("updates_per_step", "critic_learning_rate", "entropy_weight", "entropy_learning_rate"):
            value = getattr(self, field_)
            require(positive(value), f"{name}.{field_}", value, "a finite number > 0")
        for field_ in ("batch_size", "horizon", "branch_steps", "block", "critics", "critic_steps"):
            require(getattr(self, field_) >= 1, f"{name}.{field_}", getattr(self, field_), "at least 1")
        require(self.random_steps >= 0, f"{name}.random_steps", self.random_steps, "at least 0")
        require(nonnegative(self.margin), f"{name}.margin", self.margin, "a finite number >= 0")
        hidden = self.critic_hidden
        require(all(n >= 1 for n in hidden), f"{name}.critic_hidden", hidden, "sizes of at least 1")
        require(0 < self.target_rate <= 1, f"{name}.target_rate", self.target_rate, "above 0 and at most 1")
        target = self.entropy_target
        require(math.isfinite(target), f"{name}.entropy_target", target, "a finite number")


@dataclass(frozen=True)
class ValidateConfig:
    """When to stop improving the policy (paper, section 5, "Policy validation")."""

    rule: Literal["ensemble", "one_model", "real", "trpo_mean", "no_early"] = "ensemble"
    """Who says whether the policy improved on the last accepted one: each model votes (ensemble), the first model, the
    real environment (an oracle; its steps are not counted), the updates' rollouts, or nobody: go on to max_updates."""
    every: int = 5
    """Policy updates between two validations."""
    threshold: float = 0.7
    """Accept while at least this share of the models improves."""
    patience: int = 25
    """Stop when this many updates have passed since the last accepted policy."""
    max_updates: int = 400
    """Most policy updates in one outer iteration."""
    starts: int = 500
    """Fixed start states from which every model evaluates the policy, deterministic, over the full horizon."""
    real_episodes: int = 0
    """Real episodes of an iteration that try its new policy, without noise; one that earns clearly less than the best
    is given up. 0, or so many that they take more than a quarter of `collect.steps`: none."""

    def __post_init__(self) -> None:
        for name in ("every", "patience", "max_updates", "starts"):
            require(getattr(self, name) >= 1, f"validate.{name}", getattr(self, name), "at least 1")
        tries = self.real_episodes
        require(tries == 0 or tries >= 2, "validate.real_episodes", tries, "0, or at least 2")
        require(0 <= self.threshold <= 1, "validate.threshold", self.threshold, "between 0 and 1")


System = Literal[
    "me-trpo",
    "k-1",
    "k-10",
    "k-20",
    "model-ppo",
    "model-vpg",
    "bptt",
    "bptt-stochastic",
    "model_mean_std",
    "model_mean",
    "model_med",
    "eps_rand",
    "one_model",
    "validate-real",
    "validate-trpo_mean",
    "validate-no_early_50",
    "validate-no_early_5",
    "validate-one_model",
    "trpo",
    "ppo",
    "ddpg",
    "svg-1",
    "svg-inf",
    "actor-critic",
]
"""Names of the systems: those that the paper compares, and the actor-critic."""

Method = Literal["model-based", "trpo", "ppo", "ddpg", "svg"]
"""The loops: in the ensemble, or a baseline in the real environment."""

ImproverName = Literal["trpo", "ppo", "vpg", "bptt", "bptt-stochastic", "actor-critic"]
"""The rows of `metrpo.stages.search_table.SEARCHES`."""

Preset = Literal["fast", "paper", "long-horizon"]
"""Names of the presets (see `metrpo.presets`)."""


@dataclass(frozen=True)
class Config:
    """One run, whole: what `config.json` in a run directory holds."""

    task: str
    """Name of a registered task (see `metrpo tasks`)."""
    env_kwargs: tuple[str, ...] = ()
    """Keyword arguments that the task's environment is made with, each KEY=VALUE; in Python a dict will do, too."""
    imports: tuple[str, ...] = ()
    """Modules that are imported before the task is looked up: those that register its environment."""
    preset: Preset = "fast"
    """The preset that the values came from; a label, the values themselves count."""
    seed: int = 0
    """All randomness derives from it."""
    iterations: int = 10
    """Outer iterations; may be raised later to go on with a finished run."""
    real_steps: int | None = None
    """Instead of `iterations`: go on until this many real steps have been collected. 0: collect none, learn from `data`
    alone for `iterations`."""
    data: str | None = None
    """An .npz of logged transitions to start from (see `metrpo.world.offline_data`)."""
    system: System = "me-trpo"
    """Which of the paper's systems the values describe (see `metrpo.systems`); a label, the values themselves count."""
    method: Method = "model-based"
    """The loop: in the ensemble (the paper's Algorithms 1 and 2), or a baseline in the real environment: TRPO,
    Stable-Baselines3's PPO and DDPG, stochastic value gradients."""
    improver: ImproverName = "trpo"
    """How the policy is improved on imagined steps: by the score function (trpo, ppo, vpg) or by backpropagation
    through the models, of the mean action or of reparametrised samples. This ppo is ours; the system ppo is another.
    actor-critic: off-policy, without end of an episode and without validation (`actor_critic`)."""
    learn_reward: bool = False
    """Learn the reward and the end of episodes even where the task has formulas for them."""
    trust_reward: bool = False
    """Do not first hold the formulas of a task of your own against 1,000 (uncounted) real steps."""
    max_action: float = 1.0
    """Actions stay within plus and minus this, in the policy's units: 1 is the end of the environment's range."""
    max_change: float | None = None
    """Most that an action changes from one step to the next, in the same units; from the middle of the range at the
    start of an episode. Whoever plays the policy's file is held to both. None: any."""
    evaluation_episodes: int = 20
    """Real episodes of the deterministic policy that `return_real` averages; a report, never used to learn."""
    deterministic: bool = False
    """One thread, same bytes every time; clock readings are left out of metrics.csv. Slower."""
    collect: CollectConfig = field(default_factory=CollectConfig)
    ensemble: EnsembleConfig = field(default_factory=EnsembleConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    imagine: ImagineConfig = field(default_factory=ImagineConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    advantage: AdvantageConfig = field(default_factory=AdvantageConfig)
    trpo: TRPOConfig = field(default_factory=TRPOConfig)
    gradient: GradientConfig = field(default_factory=GradientConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    svg: SVGConfig = field(default_factory=SVGConfig)
    actor_critic: ActorCriticConfig = field(default_factory=ActorCriticConfig)
    validate: ValidateConfig = field(default_factory=ValidateConfig)

    def __post_init__(self) -> None:
        require(bool(self.task), "task", self.task, "a task name")
        object.__setattr__(self, "env_kwargs", canonical(self.env_kwargs))
        for module in self.imports:
            require(_is_module(module), "imports", module, "the name of a module")
        require(0 <= self.seed < 2**31, "seed", self.seed, "between 0 and 2^31 - 1")
        require(self.iterations >= 1, "iterations", self.iterations, "at least 1")
        require(self.real_steps is None or self.real_steps >= 0, "real_steps", self.real_steps, "at least 0")
        require(0 < self.max_action <= 1, "max_action", self.max_action, "above 0 and at most 1")
        change = self.max_change
        require(change is None or positive(change), "max_change", change, "a finite number > 0")
        require(self.evaluation_episodes >= 1, "evaluation_episodes", self.evaluation_episodes, "at least 1")


def _is_module(name: str) -> bool:
    return all(part.isidentifier() for part in name.split("."))


BUDGET_FIELDS = ("iterations", "real_steps")
"""Fields that say how long to run, not what is run: they may change when a run is resumed."""
