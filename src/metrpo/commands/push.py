"""`metrpo push` uploads a run's policy to the Hugging Face hub."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from metrpo.commands.options import Switch


@dataclass(frozen=True)
class Push:
    """Upload a finished run's policy to the Hugging Face hub, with a model card, its settings and its metrics.

    Needs: pip install 'metrpo[hub]', and a login (hf auth login, or HF_TOKEN).
    For example:
        metrpo push runs/Swimmer-fast-seed0 --dry-run
        metrpo push runs/Swimmer-fast-seed0 --repo me/swimmer
        metrpo evaluate hub:me/swimmer
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """The run directory."""
    repo: Annotated[str | None, arg(metavar="OWNER/NAME")] = None
    """The repository, created if there is none; default: metrpo-TASK of the user who is logged in."""
    private: Switch = False
    """Create the repository as a private one."""
    dry_run: Switch = False
    """Only write model_card.md into the run directory and list the files; needs no network."""


def run(command: Push) -> int:
    """Returns the exit code."""
    from metrpo.run.files import atomic_write
    from metrpo.run.hub_upload import CARD, owner_of_token, parcel, send

    if command.dry_run:
        made = parcel(command.dir, command.repo)
        atomic_write(command.dir / CARD, made.card)
        sizes = {name: len(c) if isinstance(c, bytes) else c.stat().st_size for name, c in made.files.items()}
        print("\n".join(f"{name:<14}{size:>12,} bytes" for name, size in sizes.items()))
        print(f"would upload to {made.repo}; the card (README.md): {command.dir / CARD}")
        return 0
    made = parcel(command.dir, command.repo)  # before anybody is asked for a token
    if command.repo is None:
        made = parcel(command.dir, None, owner_of_token())
    print(send(made, command.private))
    return 0
