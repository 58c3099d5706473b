"""What `metrpo doctor` finds: whether training works here, and what to install for the rest."""

from __future__ import annotations

import importlib
import os
import platform
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from metrpo.errors import MetrpoError
from metrpo.run import video
from metrpo.run.files import metrpo_version
from metrpo.run.machine import INSTALL_GPU, cores, device_names, has_nvidia
from metrpo.world.opengl import INSTALL_GL, load_mujoco

NEEDED = ("jax", "jaxlib", "mujoco", "gymnasium", "numpy", "optax")


@dataclass
class Installation:
    """What this machine has and lacks."""

    versions: dict[str, str | None]
    """By package; None: not installed."""
    cores: int
    devices: list[str]
    """As JAX names them."""
    gl: str | None
    """The OpenGL backend that renders."""
    encoder: bool
    problems: list[str] = field(default_factory=list)
    """Why training cannot work here; empty: it can."""
    hints: list[str] = field(default_factory=list)
    """What to install for what is missing but not needed."""

    def text(self) -> str:
        """The findings for people."""
        lines = [f"{name:<12} {number or 'missing'}" for name, number in self.versions.items()]
        lines += [f"{'cores':<12} {self.cores}", f"{'devices':<12} {', '.join(self.devices) or 'none'}"]
        lines += [f"{'OpenGL':<12} {self.gl or 'none'}", f"{'encoder':<12} {'ffmpeg' if self.encoder else 'none'}"]
        lines += [f"problem: {problem}" for problem in self.problems] + [f"hint: {hint}" for hint in self.hints]
        return "\n".join([*lines, "training cannot work here" if self.problems else "training can work here"])


def diagnose() -> Installation:
    """Looks at versions, devices, OpenGL and the encoder of this machine."""
    versions: dict[str, str | None] = {"python": platform.python_version(), "metrpo": metrpo_version()}
    found = Installation(
        versions | {n: _version(n) for n in NEEDED}, cores(), [], video.gl_backend(), video.has_encoder()
    )
    for name in NEEDED:
        try:
            load_mujoco() if name == "mujoco" else importlib.import_module(name)
        except Exception as error:  # a broken package fails in its own way
            found.problems.append(f"{name} does not import ({error}): pip install --force-reinstall {name}")
    if not found.problems:
        _look_for_devices(found)
    if found.gl is None:
        asked = f" that MUJOCO_GL={os.environ['MUJOCO_GL']} names" if os.environ.get("MUJOCO_GL") else ""
        found.hints.append(f"no OpenGL{asked}, so no videos: {INSTALL_GL}")
    if not found.encoder:
        found.hints.append(f"no video encoder, .gif only: {video.INSTALL_EXTRA}")
    if find_spec("pygame") is None:
        found.hints.append(f"no pygame, so no videos of Pendulum-v1 and its like: {video.INSTALL_EXTRA}")
    return found


def _look_for_devices(found: Installation) -> None:
    try:
        found.devices = device_names()
    except MetrpoError as error:
        found.problems.append(f"{error}: unset JAX_PLATFORMS or use --device cpu")
    if has_nvidia() and not any(device.startswith("gpu") for device in found.devices):
        found.hints.append(f"there is an NVIDIA GPU, but JAX does not use it: {INSTALL_GPU}")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
