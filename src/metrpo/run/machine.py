"""The machine: environment variables that must be set before JAX and NumPy are imported."""

from __future__ import annotations

import os
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from metrpo.errors import MetrpoError

MAX_CPU_DEVICES = 8
"""More would have few rollouts each."""

PATIENT = (
    "--xla_cpu_collective_call_warn_stuck_timeout_seconds=1000000",
    "--xla_cpu_collective_call_terminate_timeout_seconds=1000000",
)
"""A device of a CPU may wait for another as long as it takes. By itself XLA aborts the process after a minute, which
large batches, an overloaded machine or a process stopped for a while (Ctrl-Z) can take."""

INSTALL_GPU = "pip install 'jax[cuda13]', or 'jax[cuda12]' for older NVIDIA drivers"
_CUDA_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")


def prepare(device: Literal["cpu", "gpu"] | None, deterministic: bool) -> None:
    """Sets JAX's environment variables; those already set by the user stay, but for what the arguments demand.

    Must run before JAX and NumPy are imported. A CPU becomes one JAX device per core, up to 8, which share the
    imagined rollouts (see `metrpo.devices`); `deterministic` takes XLA down to one device and one thread. Compiled code
    is kept between processes in $JAX_COMPILATION_CACHE_DIR (default: metrpo/jax in the user's cache directory). Where
    there may be a GPU, float32 products are taken in float32 ($JAX_DEFAULT_MATMUL_PRECISION says otherwise).

    Raises `MetrpoError` when `device` is "gpu" and JAX finds none, and when JAX cannot use what the user's
    JAX_PLATFORMS names.
    """
    set_variables(device, deterministic)
    if device == "gpu" or os.environ.get("JAX_PLATFORMS", "cpu") not in ("", "cpu"):
        _require_device(device)


def set_variables(device: Literal["cpu", "gpu"] | None, deterministic: bool) -> None:
    """What `prepare` sets, without a look at the devices, which imports JAX."""
    if device is not None:
        os.environ["JAX_PLATFORMS"] = {"cpu": "cpu", "gpu": f"{_gpu_platform()},cpu"}[device]
    elif not may_have_gpu():
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    if deterministic:
        _add_flags("--xla_force_host_platform_device_count=1", "--xla_cpu_multi_thread_eigen=false")
        os.environ["NPROC"] = "1"  # the size of XLA's thread pool; no XLA flag sets it
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
    elif "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        _add_flags(f"--xla_force_host_platform_device_count={min(cores(), MAX_CPU_DEVICES)}")
    if "xla_cpu_collective" not in os.environ.get("XLA_FLAGS", ""):
        _add_flags(*PATIENT)
    if device == "gpu" or (device is None and may_have_gpu()):
        # By itself JAX multiplies float32 matrices in TF32 there, whose 10 bits conjugate gradients and line search do
        # not survive.
        os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder() / "jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")


def divide_gpu(jobs: int) -> None:
    """Gives each of `jobs` processes that are started from here its part of a GPU's memory, unless the user has said.

    By itself JAX takes three quarters of it in every process, so that the second of two runs finds none. A tenth is
    left for the driver.
    """
    if jobs > 1 and may_have_gpu() and os.environ.get("JAX_PLATFORMS") != "cpu":
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{0.9 / jobs:.3f}")


def _add_flags(*flags: str) -> None:
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags]).strip()


def cache_folder() -> Path:
    """Where metrpo keeps what can be made again: metrpo in the user's cache directory.

    A user without a home to write to has one in the temporary directory: in a container, say, under a number that
    passwd does not name.
    """
    if named := os.environ.get("XDG_CACHE_HOME"):
        return Path(named) / "metrpo"
    with suppress(RuntimeError):  # no home at all
        if _may_write(folder := Path.home() / ".cache"):
            return folder / "metrpo"
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return Path(tempfile.gettempdir()) / f"metrpo-cache-{user}"


def settle_libraries() -> None:
    """Lets Matplotlib keep its fonts where metrpo keeps its cache, if the user has no home to write to."""
    if cache_folder().name != "metrpo":
        os.environ.setdefault("MPLCONFIGDIR", str(cache_folder() / "matplotlib"))


def _may_write(folder: Path) -> bool:
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return os.access(there, os.W_OK)


def device_names() -> list[str]:
    """JAX's devices, equal ones counted: ["2 x cpu: cpu"]. Raises `MetrpoError` where JAX can use none."""
    import jax

    try:
        devices = jax.devices()
    except Exception as error:  # JAX asserts where its build lacks a platform that it knows
        reason = str(error).split("\n")[0] or f"{type(error).__name__} in JAX"
        raise MetrpoError(
            f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}: JAX cannot use it ({reason})"
        ) from error
    names = Counter(f"{device.platform}: {device.device_kind}" for device in devices)
    return [name if count == 1 else f"{count} x {name}" for name, count in names.items()]


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory() -> int:
    """Bytes of memory that this process may use: the machine's, or its container's where that has less."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")] if hasattr(os, "sysconf") else [sys.maxsize]
    for file in (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes")):
        with suppress(OSError, ValueError):  # not there, or "max"
            limits.append(int(file.read_text()))
    return min(limits)


def _require_device(device: Literal["cpu", "gpu"] | None) -> None:
    """Raises `MetrpoError` unless JAX finds what was asked for: by itself it takes the CPU in silence."""
    try:
        names = device_names()
    except MetrpoError as error:
        raise MetrpoError(f"{error}; unset JAX_PLATFORMS, or install the GPU's JAX: {INSTALL_GPU}") from None
    import jax

    devices = jax.devices()
    if device == "gpu" and devices[0].platform != "gpu":
        cpu = {d.platform for d in devices} == {"cpu"}
        found = "only the CPU" if cpu else f"only {', '.join(names)}"
        raise MetrpoError(
            f"device: expected a GPU, JAX finds {found}; install JAX for it ({INSTALL_GPU}), or use --device cpu"
        )


def _gpu_platform() -> str:
    return "rocm" if Path("/dev/kfd").exists() and not has_nvidia() else "cuda"


def may_have_gpu() -> bool:
    """Whether JAX may find a GPU here; True where nothing cheap can tell."""
    return (
        sys.platform != "linux"
        or (has_nvidia() and any(find_spec(plugin) is not None for plugin in _CUDA_PLUGINS))
        or Path("/dev/kfd").exists()
    )


def has_nvidia() -> bool:
    """Whether this machine has an NVIDIA GPU with its driver; under WSL 2 it is /dev/dxg."""
    return Path("/dev/nvidiactl").exists() or Path("/dev/dxg").exists()
