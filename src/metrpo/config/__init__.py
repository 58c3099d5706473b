"""Every setting of a run, and its JSON."""

from metrpo.config.schema import (
    BUDGET_FIELDS,
    AdvantageConfig,
    CollectConfig,
    Config,
    EnsembleConfig,
    FitConfig,
    GradientConfig,
    ImagineConfig,
    PolicyConfig,
    PPOConfig,
    Preset,
    SVGConfig,
    System,
    TRPOConfig,
    ValidateConfig,
)
from metrpo.config.serialise import ADDED, convert, difference, flatten, from_json, to_json

__all__ = [
    "ADDED",
    "BUDGET_FIELDS",
    "AdvantageConfig",
    "CollectConfig",
    "Config",
    "EnsembleConfig",
    "FitConfig",
    "GradientConfig",
    "ImagineConfig",
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
    "to_json",
]
