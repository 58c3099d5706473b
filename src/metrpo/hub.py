"""The Hugging Face hub: its library, which is an extra, and policies that lie there, `hub:OWNER/NAME`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from metrpo.errors import MetrpoError, RunDirectoryError

_PREFIX = "hub:"
_POLICY = "policy.npz"
"""The one file of a repository that is read."""
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)


def is_on_hub(place: str | Path) -> bool:
    """Whether a place is meant that begins with "hub:"."""
    return str(place).startswith(_PREFIX)


def repository(name: str) -> str:
    """The name of a repository as it was given. Raises `MetrpoError` when it is none."""
    if not _REPOSITORY.fullmatch(name) or "--" in name or ".." in name:
        raise MetrpoError(
            f"expected a repository as OWNER/NAME, of letters, digits, dots and single dashes, got {name!r}"
        )
    return name


def downloaded(place: str | Path) -> Path:
    """The folder in the hub's cache with the policy of `hub:OWNER/NAME`.

    Raises `MetrpoError` without the extra, `RunDirectoryError` when the hub has no such policy or cannot be reached.
    """
    repo = repository(str(place).replace("\\", "/").removeprefix(_PREFIX))
    hub = library()
    with asked(f"{place}: expected a repository on the Hugging Face hub that holds {_POLICY}"):
        return Path(hub.hf_hub_download(repo, _POLICY)).parent


def library() -> Any:
    """The hub's library. Raises `MetrpoError` without the extra."""
    try:
        import huggingface_hub
    except ImportError as error:
        raise MetrpoError("no package huggingface_hub: pip install 'metrpo[hub]'") from error
    return huggingface_hub


@contextmanager
def asked(expected: str) -> Iterator[None]:
    """Within it, whatever the hub or the way to it has against something becomes a `RunDirectoryError`."""
    try:
        yield
    except Exception as error:  # the errors of its HTTP library, which changes with its version, among them
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise RunDirectoryError(f"{expected}; {' '.join(lines)}") from error
