"""`python -m metrpo.commands.until_imagined ...`: `metrpo train ...` up to its first imagined steps (for the bench)."""

from __future__ import annotations

import sys
from typing import Any

from metrpo.commands.command_table import handler
from metrpo.commands.parse import parse
from metrpo.run.machine import settle_libraries


def run(arguments: list[str]) -> int:
    """Trains until the first updates are made, says "imagined", and raises `SystemExit`."""
    settle_libraries()
    options = parse(["train", *arguments])  # sets JAX's environment
    import jax

    from metrpo import policy_phase

    updates = policy_phase.run_updates

    def imagined(*given: Any) -> Any:
        jax.block_until_ready(updates(*given))
        print("imagined", flush=True)
        raise SystemExit(0)

    policy_phase.run_updates = imagined  # type: ignore[assignment]
    return handler("train")(options)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
