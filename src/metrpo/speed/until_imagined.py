"""`python -m metrpo.speed.until_imagined ARGUMENTS...`: `metrpo train ARGUMENTS...`, up to its first imagined steps."""

from __future__ import annotations

import sys
from typing import Any

from metrpo.commands import main as command_line

SAID = "imagined"
"""What it prints then."""


def run(arguments: list[str]) -> int:
    """Runs until the first updates are made, and returns the exit code."""
    parse = command_line.parse

    def with_a_bell(arguments: list[str]) -> Any:
        command = parse(arguments)  # sets JAX's environment
        import jax

        from metrpo import policy_phase

        updates = policy_phase.run_updates

        def imagined(*given: Any) -> Any:
            jax.block_until_ready(updates(*given))
            print(SAID, flush=True)
            raise SystemExit(0)

        policy_phase.run_updates = imagined
        return command

    command_line.parse = with_a_bell
    return command_line.main(["train", *arguments])


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
