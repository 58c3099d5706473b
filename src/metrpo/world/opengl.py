"""OpenGL: MuJoCo is imported whether or not it is there, and what a machine without it lacks is said."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator
from ctypes.util import find_library

INSTALL_GL = "apt install libosmesa6 (software) or libegl1 (GPU), then set MUJOCO_GL=osmesa or MUJOCO_GL=egl"
_OFF = ("disable", "disabled", "off", "false", "0")
_DEFAULT = ("", "glfw", "glx", "cgl", "wgl", "enable", "enabled", "on", "true", "1")


def load_mujoco() -> None:
    """Imports MuJoCo, without its rendering where the OpenGL library that MUJOCO_GL names does not load.

    MuJoCo loads that library as it is imported, and would be lost with it to those who only want to simulate.
    """
    try:
        importlib.import_module("mujoco")
    except Exception:
        asked = os.environ.get("MUJOCO_GL")
        if asked is None:
            raise
        os.environ["MUJOCO_GL"] = _OFF[0]
        try:
            importlib.import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = asked  # rendering will say what is wrong with it


def gl_library() -> str | None:
    """The module of mujoco that holds the GL context to use, None for its default.

    OSMesa goes first because it needs neither a display nor a GPU; libEGL may be there without a device to open.

    Raises `ValueError` when MUJOCO_GL switches rendering off, or names nothing.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in _OFF:
        raise ValueError(f"MUJOCO_GL={asked} switches rendering off: unset it")
    if asked not in (*_DEFAULT, "egl", "osmesa"):
        raise ValueError(f"MUJOCO_GL: expected osmesa, egl or glfw, got {asked}: set it to one of them, or unset it")
    # PyOpenGL serves one library per process, and another environment may have chosen already.
    chosen = asked or os.environ.get("PYOPENGL_PLATFORM")
    if chosen or sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return chosen if chosen in ("egl", "osmesa") else None
    return "osmesa" if find_library("OSMesa") else "egl" if find_library("EGL") else None


@contextlib.contextmanager
def gl_for_others() -> Iterator[None]:
    """Gymnasium's and dm_control's environments draw by the library that ours would take.

    Where nobody says which one, they take GLFW, which fails without a display only once it is too late for another.
    dm_control settles for one as it is imported.
    """
    chosen = None
    with contextlib.suppress(ValueError):  # the renderer says what is wrong with MUJOCO_GL
        chosen = None if os.environ.get("MUJOCO_GL") else gl_library()
    if chosen is None:
        yield
        return
    os.environ["MUJOCO_GL"] = chosen
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
