"""Whole episodes of the paper's tasks under given actions, thousands at a time: for searches on the true simulator.

`mujoco.rollout` steps them without Python in between. Its sensors hold what was true before each step of the physics,
so that a state's centre of mass is read one step later; one step more than the episode has gives the last one.
"""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from metrpo.world.registry import get_task
from metrpo.world.tasks.rllab.bodies import ROOT, robot_of
from metrpo.world.tasks.rllab.environment import MujocoTask

_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
CHUNK = 2**22
"""Numbers that one call may hand out for each of its arrays: 32 MB."""


class OpenLoop:
    """Episodes of a task from one start, under any actions; equal to its environment step by step."""

    def __init__(self, task: str, seed: int, threads: int | None = None) -> None:
        """Starts where the environment's reset by `seed` does. `threads`: by default as many as there are cores."""
        self.task = get_task(task)
        self._env = MujocoTask(self.task.name)
        self._robot, self._model = robot_of(self.task.name)
        threads = threads or len(os.sched_getaffinity(0))
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._first = self._env.reset(seed=seed)[0]
        self._start = np.empty(mujoco.mj_stateSize(self._env.model, _FULL))
        mujoco.mj_getState(self._env.model, self._env.data, self._start, _FULL)

    @property
    def interval(self) -> float:
        """Seconds from one action to the next."""
        return float(self._model.opt.timestep * self._robot.frame_skip)

    def rewards(self, actions: np.ndarray) -> np.ndarray:
        """[N, T]: of each step under `actions` [N, T, A], clipped to [-1, 1]; 0 after the task has ended an episode."""
        size = actions.shape[1] * self._robot.frame_skip * max(self._start.size, self._model.nsensordata)
        parts = np.array_split(actions, max(1, -(-len(actions) * size // CHUNK)))
        return np.concatenate([self._rewards(part) for part in parts if len(part)])

    def _rewards(self, actions: np.ndarray) -> np.ndarray:
        # As the environment gets them.
        actions = np.clip(actions, -1.0, 1.0).astype(np.float32).astype(np.float64)
        states = self.states(actions)
        reward, ends = self.task.reward, self.task.terminated
        assert reward is not None
        rewards = reward(states[:, :-1], actions, states[:, 1:])
        if callable(ends):
            over = np.cumsum(ends(states[:, 1:]), axis=1)
            # The step that ends an episode still counts.
            rewards = np.where(over - ends(states[:, 1:]) > 0, 0.0, rewards)
        # What has diverged is worth nothing to a search.
        return np.where(np.isfinite(states[:, 1:]).all(axis=-1), rewards, -1e6)

    def states(self, actions: np.ndarray) -> np.ndarray:
        """[N, T + 1, S]: the start and the states after each of the actions [N, T, A], in [-1, 1]."""
        skip = self._robot.frame_skip
        controls = np.repeat(self._env.controls(actions), skip, axis=1)
        controls = np.concatenate([controls, controls[:, -1:]], axis=1)
        start = np.tile(self._start, (len(actions), 1))
        full, sensed = rollout.rollout(
            self._model, self._data if len(self._data) > 1 else self._data[0], start, controls, persistent_pool=True
        )
        states = self._robot.state(self._model, self._recorded(full[:, skip - 1 : -1 : skip], sensed[:, skip::skip]))
        return np.concatenate([np.broadcast_to(self._first, (len(states), 1, self._first.size)), states], axis=1)

    def _recorded(self, full: np.ndarray, sensed: np.ndarray) -> Any:
        """What stands for MuJoCo's data: [N, T, ...] of each field that states are made of."""
        nq, nv = self._model.nq, self._model.nv

        def sensor(name: str) -> np.ndarray:
            at = self._model.sensor(name).adr[0]
            return sensed[..., at : at + 3]

        heads = {self._model.geom("head").id: sensor("head")} if self.task.name.startswith("Humanoid") else {}
        return SimpleNamespace(
            qpos=full[..., 1 : 1 + nq],  # time stands first
            qvel=full[..., 1 + nq : 1 + nq + nv],
            subtree_com={ROOT: sensor("com")},
            subtree_linvel={ROOT: sensor("velocity")},
            geom_xpos=heads,
        )
