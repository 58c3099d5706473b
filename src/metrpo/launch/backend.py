"""By what means many runs are run, as it is typed: `metrpo sweep` and `metrpo reproduce` take the same options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from metrpo.errors import ConfigError

Backend = Literal["local", "ray"]
Storage = Literal["shared", "sent"]


@dataclass(frozen=True)
class Means:
    """Where the runs are run, how many at a time, and with how much of a machine each."""

    backend: Backend = "local"
    """local: processes of this machine, on cores of their own. ray: tasks of a Ray cluster (pip install
    'metrpo[ray]'); a run whose machine is lost goes on on another, from its last checkpoint."""
    jobs: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None
    """Runs at a time; default: as many as there are cores for."""
    cpus: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None
    """Cores for each run; default: local divides its cores among the jobs, ray gives 1."""
    gpus: float = 0.0
    """GPUs for each run, which ray assigns: 1, or a part such as 0.25 where runs share one."""
    address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """The Ray cluster, to which this machine must belong; default: $RAY_ADDRESS, else the one that was started here,
    else a new one of this machine alone, which ends with the command."""

    storage: Storage = "shared"
    """shared: the machines of the Ray cluster share the disk of --out. sent: they need not; each works in a temporary
    folder, to which a run's files are sent from --out on this machine, and back within seconds of any change."""

    def __post_init__(self) -> None:
        for name in ("jobs", "cpus"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"{name}: expected at least 1, got {value}")
        if not 0 <= self.gpus < float("inf") or (self.gpus > 1 and self.gpus % 1):
            raise ConfigError(f"gpus: expected a whole number or a part of 1, got {self.gpus}")
        rays = {"gpus": self.gpus, "address": self.address, "storage": self.storage != "shared"}
        if self.backend == "local" and (given := [name for name, value in rays.items() if value]):
            raise ConfigError(f"{given[0]}: only --backend ray knows it; add that, or leave --{given[0]} out")
        if self.address and "://" in self.address:
            raise ConfigError(
                f"address: expected HOST:PORT or auto, got {self.address}; run this on a machine of the cluster"
            )
