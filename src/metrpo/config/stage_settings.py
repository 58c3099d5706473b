"""Settings of the loop's stages, in the order in which data goes through them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from metrpo.config.checks import nonnegative, positive, require


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
    """Sizes of the hidden layers."""
    activation: Literal["relu", "silu"] = "relu"
    """What hidden units do. silu is smooth: a policy can follow its gradient."""
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
    """Stop when no model has improved its validation loss for this many epochs; not with decay."""
    max_passes: int = 2000
    """Maximum number of epochs in one outer iteration."""
    max_steps: int | None = None
    """Maximum number of minibatches in one outer iteration; two, three or four times as many where it collected so many
    times `collect.steps`. Warm starts carry training on across iterations."""
    decay: bool = False
    """Let the step size fall to 0 within a fit, as half a cosine: large steps learn fast, small ones end well."""
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
class ValidateConfig:
    """When to stop improving the policy (paper, section 5, "Policy validation")."""

    rule: Literal["ensemble", "one_model", "real", "trpo_mean", "no_early"] = "ensemble"
    """What decides whether the policy improved on the last accepted one: a vote of the models (ensemble), the first
    model, the real environment (an oracle; its steps are not counted), the updates' rollouts (trpo_mean), or nothing:
    continue to max_updates (no_early). The actor-critic knows ensemble, one_model and no_early: it never stops, and a
    run evaluates and hands over the policy that was accepted last."""
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
