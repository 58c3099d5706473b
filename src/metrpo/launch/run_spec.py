"""One run of many: its settings, its folder and the command that runs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from metrpo.config import Config, Preset, flatten
from metrpo.presets import bare, configured
from metrpo.run.files import folder_name


@dataclass(frozen=True)
class RunSpec:
    """One training run among many."""

    task: str
    system: str
    seed: int
    overrides: tuple[tuple[str, Any], ...]
    """On top of the preset."""
    preset: Preset
    variant: str = ""
    """Its folder, where the system's name does not say what it is."""

    @property
    def name(self) -> str:
        """Where it lies under the folder of all runs."""
        return f"{folder_name(self.task)}/{self.variant or self.system}/seed-{self.seed}"

    @property
    def config(self) -> Config:
        """All its settings."""
        return configured(self.task, self.preset, self.system, {"seed": self.seed, **dict(self.overrides)})

    @property
    def arguments(self) -> list[str]:
        """What follows `metrpo train` to run it."""
        words = [self.task, "--system", self.system, "--preset", self.preset, "--seed", str(self.seed)]
        usual = flatten(bare(self.task, self.preset, self.system, dict(self.overrides)))
        for name, value in self.overrides:
            group, dot, own = (option := name.replace("_", "-")).rpartition(".")
            if not isinstance(value, bool):
                words += [f"--{option}", *map(str, value if isinstance(value, tuple) else (value,))]
            elif value != usual[name]:
                words.append(f"--{option}" if value else f"--{group}{dot}no-{own}")
        return words
