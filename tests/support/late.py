"""The probe with actions that take effect two steps late: three observations and two actions tell all, one does not."""

from __future__ import annotations

import dataclasses

import gymnasium
import numpy as np

import probe
from helpers import identity_normaliser
from metrpo.history import History
from metrpo.model.ensemble import Carried, Ensemble

DELAY = 2
LENGTH = 3
LAYOUT = History(LENGTH, 2, 2)


class Late(gymnasium.Wrapper):
    """Remembers its actions in a list, and executes the one of `DELAY` steps before."""

    def reset(self, **given):
        self.actions = [np.zeros(2, np.float32)] * DELAY
        return self.env.reset(**given)

    def step(self, action):
        self.actions.append(np.array(action))
        state, _, *rest = self.env.step(self.actions[-1 - DELAY])
        # What is paid is a formula of the present action.
        return state, probe.reward(None, np.asarray(action, float), state), *rest


LATE = dataclasses.replace(
    probe.PROBE, name="Late", make=lambda **given: Late(gymnasium.make(probe.PROBE.env_id, **given))
)


def true_models(members=2):
    """The ensemble of networks that are the late probe's dynamics: s' = A s + B a of two steps before."""
    weights = np.zeros((LAYOUT.state_size + 2, 2))
    weights[:2] = (probe.A - np.eye(2)).T
    weights[LAYOUT.state_size - 2 : LAYOUT.state_size] = probe.B.T  # the oldest action of a state
    layer = np.tile(weights.astype(np.float32), (members, 1, 1)), np.zeros((members, 1, 2), np.float32)
    n = identity_normaliser(LAYOUT.state_size, 2)
    return Ensemble(
        (layer,), n._replace(delta_mean=n.delta_mean[:2], delta_std=n.delta_std[:2]), Carried(LAYOUT.carried)
    )
