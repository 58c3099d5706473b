"""Actions that come two steps late, as a real robot's do: a history of three makes them learnable.

    metrpo train examples/delayed.py:cart --history 3
    metrpo train examples/delayed.py:cheetah --history 3

What an action does shows two steps later only. Whoever sees one observation cannot know what is still on its way; three
observations and the two actions between them tell.
"""

from collections import deque

import gymnasium
import numpy as np

import metrpo

STEPS = 2


class Delayed(gymnasium.Wrapper):
    """`env` in which an action arrives `steps` steps late; before the first one arrives, the motors rest."""

    def __init__(self, env, steps=STEPS):
        super().__init__(env)
        self.steps = steps

    def reset(self, **given):
        space = self.env.action_space
        rest = ((space.low + space.high) / 2).astype(space.dtype)
        self.under_way = deque([rest] * self.steps)
        return self.env.reset(**given)

    def step(self, action):
        self.under_way.append(action)
        return self.env.step(self.under_way.popleft())


class Cart(gymnasium.Env):
    """A cart on a rail: its motor accelerates it by 4 m/s^2 at most, ten times a second. It is to stand at 0."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-1, 1), 0.0])
        return self.state.copy(), {}

    def step(self, action):
        position, speed = self.state
        speed += 0.1 * 4 * float(action[0])
        before, self.state = self.state, np.array([position + 0.1 * speed, speed])
        return self.state.copy(), float(reward(before, action, self.state)), False, False, {}


def reward(state, action, following):
    return -(following[..., 0] ** 2) - 0.1 * following[..., 1] ** 2


def late_cart():
    return Delayed(Cart())


def late_cheetah(**given):
    return Delayed(gymnasium.make("metrpo/HalfCheetah-v0", **given))


cart = metrpo.task_of(late_cart, reward, terminated=None, horizon=50)
# What it pays for an action, it pays when that arrives: no formula of the present one, so that the reward is learned.
cheetah = metrpo.task_of(late_cheetah, terminated=None, unseen=metrpo.get_task("HalfCheetah").unseen)
