"""The config of a run: frozen dataclasses of numbers, strings and tuples; those of stages and improvers stand beside.

The defaults are the paper's values (its appendix A.1) or, where it is silent, its authors' settings.
`metrpo.presets` holds the values of single tasks and the `fast` preset.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from metrpo.config.checks import positive, require
from metrpo.config.env_kwargs import canonical
from metrpo.config.improver_settings import (
    ActorCriticConfig,
    GradientConfig,
    PPOConfig,
    SVGConfig,
    TRPOConfig,
)
from metrpo.config.stage_settings import (
    AdvantageConfig,
    CollectConfig,
    EnsembleConfig,
    FitConfig,
    ImagineConfig,
    PolicyConfig,
    ValidateConfig,
)

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

    @property
    def by_critics(self) -> bool:
        """Whether the actor-critic learns: it has settings of its own, and reads few of the others."""
        return self.improver == "actor-critic"

    @property
    def takes_votes(self) -> bool:
        """Whether new policies are validated: all are, but the actor-critic's where nothing is asked of them."""
        return not self.by_critics or self.validate.rule != "no_early"

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
