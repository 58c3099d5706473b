"""Gymnasium's pendulum without its speed: a history of two or three observations shows it.

    metrpo train examples/half_seen.py:pendulum --history 3

The reward depends on the speed, which no formula of the observation can know: it is learned.
"""

import gymnasium
import numpy as np

import metrpo


def angle_alone(**given):
    """Pendulum-v1, of which cosine and sine of the angle are seen."""
    env = gymnasium.make("Pendulum-v1", **given)
    seen = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    return gymnasium.wrappers.TransformObservation(env, lambda observation: observation[:2], seen)


pendulum = metrpo.task_of(angle_alone, terminated=None)
