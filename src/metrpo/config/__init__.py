"""Every setting of a run, and its JSON."""

from metrpo.config.contradictions import require_consistent
from metrpo.config.improver_settings import ActorCriticConfig, GradientConfig, PPOConfig, SVGConfig, TRPOConfig
from metrpo.config.schema import BUDGET_FIELDS, Config, ImproverName, Method, Preset, System
from metrpo.config.serialise import ADDED, convert, difference, flatten, from_json, to_json, types_of
from metrpo.config.stage_settings import (
    AdvantageConfig,
    CollectConfig,
    EnsembleConfig,
    FitConfig,
    ImagineConfig,
    PolicyConfig,
    ValidateConfig,
)
from metrpo.config.unread import unread

__all__ = [
    "ADDED",
    "BUDGET_FIELDS",
    "ActorCriticConfig",
    "AdvantageConfig",
    "CollectConfig",
    "Config",
    "EnsembleConfig",
    "FitConfig",
    "GradientConfig",
    "ImagineConfig",
    "ImproverName",
    "Method",
    "PPOConfig",
    "PolicyConfig",
    "Preset",
    "SVGConfig",
    "System",
    "TRPOConfig",
    "ValidateConfig",
    "convert",
    "difference",
    "flatten",
    "from_json",
    "require_consistent",
    "to_json",
    "types_of",
    "unread",
]
