"""A run that learns nothing: each iteration saves numbers that tell which one it was, and costs no time."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from metrpo.config import Config
from metrpo.run.directory import RunDirectory

CONFIG = Config("Swimmer", iterations=5)
DETERMINISTIC = dataclasses.replace(CONFIG, deterministic=True)


class Weights(NamedTuple):
    layers: tuple
    log_std: Any


class State(NamedTuple):
    iteration: int
    real_steps: int
    policy: Weights
    data: Any


def a_state(iteration: int = 0) -> State:
    layers = (
        (np.full((3, 4), iteration, np.float32), np.zeros(4, np.float32)),
        (np.ones((4, 2), np.float32), np.zeros(2, np.float32)),
    )
    return State(
        iteration,
        100 * iteration,
        Weights(layers, np.zeros(2, np.float32)),
        np.arange(10 * iteration, dtype=np.float32),
    )


def a_row(iteration: int) -> dict[str, Any]:
    return {
        "iteration": iteration,
        "real_steps": 100 * iteration,
        "return_real": np.float32(iteration) / 3,
        "gap": float("nan") if iteration == 1 else 0.1 * iteration,
        "seconds_fit": 0.5,
    }


def train(path: Path, config: Config = CONFIG, until: int = 5) -> list[int]:
    """What training.train does with a directory; returns the iterations it ran."""
    ran = []
    with RunDirectory(path, config) as run:
        state = run.load(a_state()) or a_state()
        while state.iteration < until:
            state = a_state(state.iteration + 1)
            run.save(state, a_row(state.iteration))
            ran.append(state.iteration)
    return ran
