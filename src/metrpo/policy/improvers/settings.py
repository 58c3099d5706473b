"""What decides the compiled code of a policy phase, and nothing else: another seed or budget compiles nothing anew."""

from __future__ import annotations

from dataclasses import dataclass

from metrpo.config import AdvantageConfig, Config, GradientConfig, PPOConfig, TRPOConfig


@dataclass(frozen=True)
class PhaseSettings:
    """Every setting that an improver may read. There are no defaults: what is not here cannot be read by mistake."""

    improver: str
    mean_penalty: float
    advantage: AdvantageConfig
    trpo: TRPOConfig
    gradient: GradientConfig
    ppo: PPOConfig
    cut: bool
    """Whether imagined episodes end before the task's do, and are valued there."""

    @classmethod
    def of(cls, config: Config, cut: bool) -> PhaseSettings:
        """The settings of `config`, for episodes that are `cut` or whole."""
        return cls(
            improver=config.improver,
            mean_penalty=config.policy.mean_penalty,
            advantage=config.advantage,
            trpo=config.trpo,
            gradient=config.gradient,
            ppo=config.ppo,
            cut=cut,
        )
