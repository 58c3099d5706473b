"""How to launch many runs: the options that `metrpo sweep` and `metrpo reproduce` share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from metrpo.errors import ConfigError

Backend = Literal["local", "ray"]
Storage = Literal["shared", "sent"]


@dataclass(frozen=True)
class Means:
    """Where to run, how many runs at a time, and how much of a machine each gets."""

    backend: Backend = "local"
    """local: processes on this machine, each on its own cores. ray: tasks on a Ray cluster (pip install
    'metrpo[ray]'); a run whose machine is lost resumes on another, from its last checkpoint."""
    jobs: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None
    """Runs at a time; default: as many as the cores allow."""
    cpus: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None
    """Cores for each run; default: local divides its cores among the jobs, ray gives 1."""
    gpus: float = 0.0
    """GPUs for each run, which ray assigns: 1, or a fraction such as 0.25 if runs share one."""
    address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """The Ray cluster, to which this machine must belong; default: $RAY_ADDRESS, else the one that was started here,
    else a new one on this machine alone, which ends with the command."""

    storage: Storage = "shared"
    """shared: the machines of the Ray cluster share the disk of --out. sent: they need not. Each works in a temporary
    folder; a run's files are sent there from --out on this machine, and back within seconds of any change."""

    def __post_init__(self) -> None:
        for name in ("jobs", "cpus"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"{name}: expected at least 1, got {value}")
        if not 0 <= self.gpus < float("inf") or (self.gpus > 1 and self.gpus % 1):
            raise ConfigError(f"gpus: expected a whole number or a fraction of 1, got {self.gpus}")
        rays = {"gpus": self.gpus, "address": self.address, "storage": self.storage != "shared"}
        if self.backend == "local" and (given := [name for name, value in rays.items() if value]):
            raise ConfigError(f"{given[0]}: works with --backend ray only; add that, or leave --{given[0]} out")
        if self.address and "://" in self.address:
            raise ConfigError(
                f"address: expected HOST:PORT or auto, got {self.address}; run this on a machine of the cluster"
            )
