"""Every setting of a run: frozen dataclasses of numbers, strings and tuples.

The defaults are the paper's values (its appendix A.1) or, where it is silent, its authors' settings.
`metrpo.presets` holds the values of single tasks and the `fast` preset.
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
    """Minimum number of real steps per outer iteration; the last episode is played to its end."""
    max_std: float = 3.0
    """Exploration noise: its standard deviation is max_std times a draw from U[0, 1] raised to std_power."""
    std_power: float = 1.0
    """1: every standard deviation is equally likely (the paper). Larger: most are small, a few are large."""
    std_per: Literal["episode", "step"] = "episode"
    """How often to draw that standard deviation: once an episode (the paper) or at every step (authors' code)."""
    noise_correlation: float = 0.0
    """Correlation of the noise from one step to the next, at least 0 and below 1. 0: independent noise at each step
    (the paper); 0.9: noise that keeps its direction for some ten steps, and so moves a body further."""
    parameter_noise: float = 3.0
    """Scale of the parameter noise: std = scale * |policy - previous policy|, redrawn every episode; 0: none."""
    validation_fraction: float = 1 / 3
    """Fraction of the new episodes that goes to the validation set."""
    piece: int | None = None
    """Cut episodes into pieces of at most so many steps, of which a fraction goes to the validation set; None: whole
    episodes go there (the paper)."""
    max_train: int = 200_000
    """Maximum number of transitions kept for training; the oldest go first."""
    max_validation: int = 100_000
    """Maximum number of transitions kept for validation; the oldest go first."""

    def __post_init__(self) -> None:
        require(self.steps >= 1, "collect.steps", self.steps, "at least 1")
        require(nonnegative(self.max_std), "collect.max_std", self.max_std, "a finite number >= 0")
        require(positive(self.std_power), "collect.std_power", self.std_power, "a finite number > 0")
        require(
            0 <= self.noise_correlation < 1,
            "collect.noise_correlation",
            self.noise_correlation,
            "at least 0 and below 1",
        )
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
    """The normaliser divides states and actions by their standard deviation, but at least by this."""
    delta_std_floor: float = 0.1
    """The normaliser multiplies outputs by the standard deviation of state changes, but at least by this."""
    probabilistic: bool = False
    """Members also predict how far off they are; imagined steps are drawn with that spread."""

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
    """Transitions per minibatch, drawn with replacement, independently for each model."""
    loss_units: Literal["raw", "std"] = "raw"
    """Units of the squared error, summed over state dimensions: raw units (the paper), or each dimension's std."""
    products: Literal["float32", "bfloat16"] = "float32"
    """Type of the operands of matrix products, and so of the weights' gradients; sums and Adam stay float32."""
    validate_every: int = 5
    """Epochs between two validations."""
    patience: int = 25
    """Stop when no model has improved its validation loss for this many epochs."""
    max_passes: int = 2000
    """Maximum number of epochs in one outer iteration."""
    max_steps: int | None = None
    """Maximum number of minibatches in one outer iteration. Warm starts carry training on across iterations."""
    decay: bool = False
    """Let the step size fall to 0 over max_steps, as half a cosine: large steps learn fast, small ones end well."""
    reinitialise_every: int = 5
    """Start from fresh weights in every n-th outer iteration (1, 1+n, ...), else from the last ones; 0: fresh only in
    the first."""

    def __post_init__(self) -> None:
        require(positive(self.learning_rate), "fit.learning_rate", self.learning_rate, "a finite number > 0")
        require(nonnegative(self.weight_decay), "fit.weight_decay", self.weight_decay, "a finite number >= 0")
        for name in ("batch_size", "validate_every", "patience", "max_passes"):
            require(getattr(self, name) >= 1, f"fit.{name}", getattr(self, name), "at least 1")
        require(self.max_steps is None or self.max_steps >= 1, "fit.max_steps", self.max_steps, "at least 1")
        needed = not self.decay or self.max_steps is not None
        require(needed, "fit.max_steps", self.max_steps, "a number of steps with fit.decay")
        require(self.reinitialise_every >= 0, "fit.reinitialise_every", self.reinitialise_every, "at least 0")


@dataclass(frozen=True)
class ImagineConfig:
    """Imagined rollouts (paper, section 5, "Policy optimization")."""

    steps: int = 50_000
    """Imagined steps per policy update (TRPO's batch)."""
    sampling: Literal["step_rand", "model_mean_std", "model_mean", "model_med", "eps_rand", "one_model"] = "step_rand"
    """Where the next state comes from: a model drawn per step (step_rand) or per episode (eps_rand), the first model
    (one_model), the models' mean or median, or a normal distribution fitted to them (model_mean_std)."""
    start: Literal["dataset", "anywhere", "reset"] = "dataset"
    """Start states of imagined episodes: those of real episodes (dataset), any state of the training set (anywhere), or
    fresh real resets (reset; not counted)."""
    horizon: int | None = None
    """Steps of an imagined episode, if shorter than the task's: the baseline values what would follow, without regard
    to time. Needs advantage.discount < 1; goes with start = "anywhere". None: the task's."""
    products: Literal["float32", "bfloat16"] = "float32"
    """Type of the operands of the ensemble's matrix products in imagination and validation."""
    disagreement: float = 0.0
    """Bonus in every imagined reward: this times the spread of the models' predictions, in each dimension's std."""

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
    """Standard deviation of the actions at the start of every policy phase."""
    normalise: bool = False
    """Normalise the policy's states by the dataset, and hide the dimensions that the models do not see."""
    min_std: float = 0.0
    """0: every phase starts from initial_std (the paper). Above 0: a phase starts from the last one's standard
    deviation, but at least from this."""
    mean_penalty: float = 0.0
    """Penalty in the surrogate of trpo, ppo and vpg: this times the squared excess of mean actions beyond 0.9, divided
    by the standard deviation."""

    def __post_init__(self) -> None:
        require(all(n >= 1 for n in self.hidden), "policy.hidden", self.hidden, "sizes of at least 1")
        require(positive(self.initial_std), "policy.initial_std", self.initial_std, "a finite number > 0")
        require(nonnegative(self.min_std), "policy.min_std", self.min_std, "a finite number >= 0")
        require(nonnegative(self.mean_penalty), "policy.mean_penalty", self.mean_penalty, "a finite number >= 0")


@dataclass(frozen=True)
class AdvantageConfig:
    """Advantages and their baseline (authors' settings: no discount, lambda 1, linear features)."""

    baseline: Literal["linear", "network"] = "linear"
    """The baseline: linear features, fitted afresh to every batch, or a network that keeps learning."""

    discount: float = 1.0
    """gamma."""
    gae_lambda: float = 1.0
    """lambda of generalised advantage estimation."""
    ridge: float = 1e-5
    """Ridge penalty of the linear-feature baseline."""
    value_hidden: tuple[int, ...] = (64, 64)
    """Sizes of the value network's hidden layers (tanh)."""
    value_steps: int = 40
    """Minibatches of the value network after every policy update."""
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
    data; 0: never."""
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
    """What decides whether the policy improved on the last accepted one: a vote of the models (ensemble), the first
    model, the real environment (an oracle; its steps are not counted), the updates' rollouts (trpo_mean), or nothing:
    continue to max_updates (no_early)."""
    every: int = 5
    """Policy updates between two validations."""
    threshold: float = 0.7
    """Accept while the policy improves in at least this fraction of the models."""
    patience: int = 25
    """Stop after this many updates without an accepted policy."""
    max_updates: int = 400
    """Maximum number of policy updates in one outer iteration."""
    starts: int = 500
    """Number of fixed start states from which every model evaluates the deterministic policy over the full horizon."""
    real_episodes: int = 0
    """Real episodes that try an iteration's new policy, without noise. A policy that earns clearly less than the best
    is rejected. 0: none; nor where they would take more than a quarter of `collect.steps`."""

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
"""The training loops: model-based, or a baseline in the real environment."""

ImproverName = Literal["trpo", "ppo", "vpg", "bptt", "bptt-stochastic", "actor-critic"]
"""The rows of `metrpo.stages.search_table.SEARCHES`."""

Preset = Literal["fast", "paper", "long-horizon"]
"""Names of the presets (see `metrpo.presets`)."""


@dataclass(frozen=True)
class Config:
    """All settings of one run, as `config.json` in a run directory holds them."""

    task: str
    """Name of a registered task (see `metrpo tasks`)."""
    env_kwargs: tuple[str, ...] = ()
    """Keyword arguments of the task's environment, each KEY=VALUE; in Python, a dict works too."""
    imports: tuple[str, ...] = ()
    """Modules to import before the task is looked up, because they register its environment."""
    preset: Preset = "fast"
    """The preset that the values came from. Only a label: the values count."""
    seed: int = 0
    """Seed of all randomness."""
    iterations: int = 10
    """Outer iterations. Raise it later to continue a finished run."""
    real_steps: int | None = None
    """Instead of `iterations`: train until this many real steps are collected. 0: collect none, learn from `data` alone
    for `iterations`."""
    data: str | None = None
    """Offline data to start from, an .npz of transitions (see `metrpo.world.offline_data`)."""
    system: System = "me-trpo"
    """The paper's system that the values describe (see `metrpo.systems`). Only a label: the values count."""
    method: Method = "model-based"
    """The training loop: model-based (the paper's Algorithms 1 and 2), or a baseline in the real environment: TRPO,
    Stable-Baselines3's PPO and DDPG, stochastic value gradients."""
    improver: ImproverName = "trpo"
    """How to improve the policy on imagined steps: by the score function (trpo, ppo, vpg), or by backpropagation
    through the models with the mean action (bptt) or reparametrised samples (bptt-stochastic). This ppo is ours; the
    system ppo is Stable-Baselines3's. actor-critic: off-policy, without validation (`actor_critic`)."""
    learn_reward: bool = False
    """Learn the reward and the end of episodes even where the task has formulas for them."""
    trust_reward: bool = False
    """Skip the check of your own task's formulas against 1,000 real steps (not counted)."""
    max_action: float = 1.0
    """Limit on the size of actions, in the policy's units: 1 is the end of the environment's range."""
    max_change: float | None = None
    """Limit on the change of an action from one step to the next, in the same units; an episode starts from the middle
    of the range. The exported policy keeps both limits. None: no limit."""
    history: int = 1
    """Number of observations that the policy and the models see at each step, with the actions between them. 1: only
    the newest. 3, for example, makes a delay of two steps learnable, and velocities that no sensor measures."""
    evaluation_episodes: int = 20
    """Real episodes of the deterministic policy that `return_real` averages. They are never learned from."""
    deterministic: bool = False
    """Use one thread and leave clock readings out of metrics.csv: the same bytes every time, but slower."""
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
        require(self.history >= 1, "history", self.history, "at least 1")
        require(self.evaluation_episodes >= 1, "evaluation_episodes", self.evaluation_episodes, "at least 1")


def _is_module(name: str) -> bool:
    return all(part.isidentifier() for part in name.split("."))


BUDGET_FIELDS = ("iterations", "real_steps")
"""Fields that say how long to run: they may change when a run is resumed."""
