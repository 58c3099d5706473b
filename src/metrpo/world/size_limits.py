"""What is too large to be learned, refused before the first real step."""

from __future__ import annotations

from metrpo.config import CollectConfig
from metrpo.errors import TaskError

MOST_NUMBERS = 4000
"""Of an observation: dense networks learn what joints and sensors say, not pictures."""
LONGEST = 100_000
"""Steps of an episode: every policy update imagines, and every evaluation plays, whole ones."""

RECORDED = 10_000
"""Steps after which an episode is cut that is played for the record only (evaluation, yardsticks)."""


def require_size(name: str, size: int, most: str = "") -> None:
    """Raises `TaskError` for observations of more than `MOST_NUMBERS` numbers, with the room that they would take.

    `most` says where most of them stand.
    """
    if size > MOST_NUMBERS:
        kept = CollectConfig.max_train + CollectConfig.max_validation
        raise TaskError(
            f"{name}: expected observations of at most {MOST_NUMBERS:,} numbers, got {size:,}{most and f', {most}'}: a "
            f"full dataset of {kept:,} transitions would take {kept * size * 8 / 2**30:,.0f} GiB; pictures cannot be "
            "learned here: observe positions and velocities instead, or features that your own network extracts (in a "
            "gymnasium.ObservationWrapper)"
        )


def require_horizon(name: str, horizon: int) -> None:
    """Raises `TaskError` for episodes of less than one step or of more than `LONGEST`."""
    if not 1 <= horizon <= LONGEST:
        raise TaskError(
            f"{name}: expected episodes of 1 to {LONGEST:,} steps, got a time limit of {horizon:,}; cut them with "
            "metrpo.task_of(..., horizon=1000), or with gymnasium.wrappers.TimeLimit(env, 1000); for the models, "
            "that does not end the task"
        )
