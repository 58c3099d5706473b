"""What every process of the fast tests has: cheap compilation, kept for the others, and array shapes that are checked.

Most of the suite's time would be XLA's. These flags spare its optimisations, which tiny arrays do not need, and what
one worker or command has compiled is found by the others and by the next session. JAX finds it by the program, its
options and the versions: a change of the code compiles anew what it changes. It counts as a compilation all the same
(`/jax/core/compile/backend_compile_duration`), so that a test which counts them sees each. XLA_FLAGS and
JAX_COMPILATION_CACHE_DIR of the user's are taken instead.

The slow tests have what the product has: its own flags, which `tests/guarantees/test_signals.py` has too.
"""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Iterator
from contextlib import suppress

import pytest
from jaxtyping import install_import_hook

from places import ROOT

CACHE, LIMIT = ROOT / ".pytest_cache" / "jax", 2**30
CHEAP = (
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
)
CHECKED = ("metrpo.model", "metrpo.policy", "metrpo.policy_phase")


def pytest_configure(config: pytest.Config) -> None:
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    if config.option.markexpr == "not slow":
        os.environ.setdefault("XLA_FLAGS", " ".join(CHEAP))
        install_import_hook(CHECKED, "shapes.check")
    if not hasattr(config, "workerinput"):  # once a session, not once a worker
        _tidy()


@pytest.fixture(scope="module")
def plain_curve() -> Iterator[None]:
    """`curve.png` is a text: drawn, it takes half a second of every iteration."""
    from metrpo.run import derived_files
    from metrpo.run.files import atomic_write

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(derived_files, "draw_curve", lambda rows, path, *_: atomic_write(path, f"{len(rows)} rows"))
        yield


def _tidy() -> None:
    """Drops what a killed process left unfinished, and everything where it has grown beyond a GiB."""
    entries = {path: path.read_bytes() for path in CACHE.glob("*-cache")}
    if sum(map(len, entries.values())) > LIMIT:
        shutil.rmtree(CACHE, ignore_errors=True)
    for path, content in entries.items():
        if not _is_whole(content):
            with suppress(FileNotFoundError):
                path.unlink()


def _is_whole(content: bytes) -> bool:
    if content[:1] != b"\x78":  # zlib's first byte; JAX takes zstd where Python has it
        return len(content) > 0
    unpacking = zlib.decompressobj()
    try:
        unpacking.decompress(content)
    except zlib.error:
        return False
    return unpacking.eof
