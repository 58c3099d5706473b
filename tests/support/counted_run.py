"""Iterations of a run one by one, with the compilations that each cost."""

from __future__ import annotations

import types

from metrpo import training
from metrpo.speed.measure import compilations


def run(config, iterations=4):
    """States (the first included), rows and the number of compilations of each iteration."""
    states, rows, counts = [training.init(config)], [], []
    for _ in range(iterations):
        with compilations() as seen:
            state, row = training.step(config, states[-1])
        states.append(state)
        rows.append(row)
        counts.append(len(seen))
    return types.SimpleNamespace(states=states, rows=rows, counts=counts)
