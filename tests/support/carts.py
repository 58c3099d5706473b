"""A task in a file that any process can load (`carts.py:CART`), as slow as METRPO_TEST_STEP_SECONDS says."""

import os
import time

import gymnasium
import numpy as np
from gymnasium.spaces import Box

import metrpo

HORIZON = 20
SECONDS = float(os.environ.get("METRPO_TEST_STEP_SECONDS", "0"))


def reward(state, action, next_state):
    return -(next_state**2).sum(-1)


class Cart(gymnasium.Env):
    observation_space = Box(-np.inf, np.inf, (2,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 2)
        return self.state.astype(np.float32), {}

    def step(self, action):
        time.sleep(SECONDS)
        position, velocity = self.state
        velocity += 0.1 * float(action[0])
        self.state = np.array([position + 0.1 * velocity, velocity])
        next_state = self.state.astype(np.float32)
        return next_state, float(reward(None, None, next_state)), False, False, {}


CART = metrpo.task_of(Cart, reward, None, name="cart", horizon=HORIZON)
