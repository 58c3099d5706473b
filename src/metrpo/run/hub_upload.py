"""Uploads a finished run's policy to the Hugging Face hub."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.hub import asked, library, repository
from metrpo.policy_zoo import is_name
from metrpo.run.card import model_card, task_name
from metrpo.run.find import SeenRun, is_finished, read
from metrpo.run.policy_export import export
from metrpo.run.policy_file import FILE

CARD = "model_card.md"
"""In the run directory; on the hub it is README.md."""
_NEEDED = (FILE, "policy.json", "config.json", "metrics.csv")
# The hub shows a replay.mp4 on the model's page.
_WHERE_THERE = {"curve.png": "curve.png", "video.mp4": "replay.mp4"}


@dataclass(frozen=True)
class Parcel:
    """The upload: names on the hub, each with its content or the file that has it."""

    repo: str
    files: dict[str, bytes | Path]

    @property
    def card(self) -> str:
        """The model card."""
        content = self.files["README.md"]
        assert isinstance(content, bytes)
        return content.decode()


def parcel(run_dir: Path, repo: str | None, owner: str = "OWNER") -> Parcel:
    """The files that `push` uploads; without `repo`, to `owner`'s repository metrpo-TASK.

    Raises `RunDirectoryError` unless it is the directory of a finished run, `MetrpoError` for an impossible `repo`.
    """
    run = _finished(run_dir)
    repo = repository(repo or f"{owner}/{_default_name(run)}")
    files: dict[str, bytes | Path] = {name: run_dir / name for name in _NEEDED}
    files |= {there: run_dir / here for here, there in _WHERE_THERE.items() if (run_dir / here).is_file()}
    with TemporaryDirectory() as folder:
        files["policy.py"] = export(run_dir, Path(folder) / "policy.py").read_bytes()
    files["README.md"] = model_card(run, repo, list(files)).encode()
    return Parcel(repo, dict(sorted(files.items())))


def owner_of_token() -> str:
    """The user who is logged in. Raises `MetrpoError` without the extra, without a login or without a connection."""
    hub = library()
    _require_token(hub)
    with asked("expected the hub to say whose token this is"):
        return str(hub.HfApi().whoami()["name"])


def send(sent: Parcel, private: bool = False) -> str:
    """Uploads it as one commit, to a repository that is created if there is none; returns its address.

    Raises `MetrpoError` without the extra or when nobody is logged in, `RunDirectoryError` when the hub refuses it or
    cannot be reached.
    """
    hub = library()
    _require_token(hub)
    api = hub.HfApi()
    operations = [hub.CommitOperationAdd(name, content) for name, content in sent.files.items()]
    with asked(f"{sent.repo}: expected the hub to take it"):
        address = api.create_repo(sent.repo, private=private or None, exist_ok=True)
        api.create_commit(sent.repo, operations, commit_message="A policy that metrpo trained")
    return str(address)


def _require_token(hub: object) -> None:
    if not hub.get_token():  # type: ignore[attr-defined]
        raise MetrpoError(
            "expected a login to the Hugging Face hub, got no token; run: hf auth login, or set HF_TOKEN to a token "
            "with write access"
        )


def _finished(run_dir: Path) -> SeenRun:
    if is_name(run_dir):
        raise RunDirectoryError(f"{run_dir}: expected the directory of your own run, got a policy's name")
    if missing := [name for name in _NEEDED if not (run_dir / name).is_file()]:
        raise RunDirectoryError(f"{run_dir}: expected the directory of a finished run, got one without {missing[0]}")
    run = read(run_dir)
    if not is_finished(run):
        raise RunDirectoryError(
            f"{run_dir}: expected a finished run, got one of {len(run.rows)} iterations whose budget is not spent; "
            "resume it with its own command, or give it a smaller budget"
        )
    return run


def _default_name(run: SeenRun) -> str:
    task = re.sub(r"\.py\b|[^A-Za-z0-9_.]+", "-", task_name(run.config.task))
    return f"metrpo-{re.sub('-+', '-', task).strip('-.')[:80] or 'policy'}"
