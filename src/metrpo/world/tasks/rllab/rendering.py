"""Frames of the paper's tasks, drawn off screen."""

from __future__ import annotations

import importlib

import mujoco
import numpy as np
from numpy.typing import NDArray

from metrpo.errors import TaskError
from metrpo.world.opengl import INSTALL_GL, gl_library
from metrpo.world.tasks.rllab.bodies import ROOT

_FRAME_SIZE = 480


class Painter:
    """Draws off screen; raises `TaskError` when there is no GL to draw with.

    Not `mujoco.Renderer`, whose GL library is whatever MUJOCO_GL named when somebody first imported mujoco.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        try:
            name = gl_library()
        except ValueError as error:
            raise TaskError(str(error)) from None
        try:
            source = importlib.import_module(f"mujoco.{name}") if name else mujoco
            self._gl = source.GLContext(_FRAME_SIZE, _FRAME_SIZE)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each GL library fails in its own way
            raise TaskError(
                f"no OpenGL to render with (tried {name or 'the default of mujoco'}: {error}): {INSTALL_GL}"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        for costly in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[costly] = 0  # a frame without a GPU takes 0.03 s instead of 0.2 s
        self._rect = mujoco.MjrRect(0, 0, _FRAME_SIZE, _FRAME_SIZE)

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData, view: tuple[float, float, float]) -> NDArray[np.uint8]:
        """A frame around the robot, [480, 480, 3]; `view` is distance (m), azimuth and elevation (degrees)."""
        camera = mujoco.MjvCamera()
        camera.lookat = data.subtree_com[ROOT]
        camera.distance, camera.azimuth, camera.elevation = view
        mujoco.mj_camlight(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, self._scene)
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._context)
        frame = np.empty((_FRAME_SIZE, _FRAME_SIZE, 3), np.uint8)
        mujoco.mjr_readPixels(frame, None, self._rect, self._context)
        return frame[::-1].copy()

    def close(self) -> None:
        """Frees what OpenGL holds."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
