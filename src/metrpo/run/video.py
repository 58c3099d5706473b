"""One real episode of a policy as a video, and whether this machine can make one."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from metrpo.errors import MetrpoError
from metrpo.run.files import temporary_path
from metrpo.world import env_returns
from metrpo.world.env_wrapper import Guarded
from metrpo.world.opengl import INSTALL_GL, gl_for_others

INSTALL_EXTRA = "pip install 'metrpo[video]'"
_GL = ("mujoco", "OpenGL", "glfw", "pyglet")
"""Packages that draw by OpenGL."""

FRAMES = 2000
"""Steps of an episode after which its video ends: they are kept in memory, some 700 kB each."""


class VideoError(MetrpoError):
    """This machine lacks what a video needs; the message says what to install."""


def record(make_env: Callable[..., Any], policy: Callable[[np.ndarray], np.ndarray], path: Path, seed: int = 0) -> Path:
    """Renders one episode, or its first `FRAMES` steps, started with `seed`, to `path` (.mp4, or .gif) and returns it.

    `make_env(render_mode="rgb_array")` gives a Gymnasium environment; `policy` maps [S] -> [A].

    Raises `VideoError` when there is no OpenGL or no encoder, or the file cannot be written.
    """
    writers = {".mp4": _write_mp4, ".gif": _write_gif}
    if path.suffix not in writers:
        raise VideoError(f"{path}: expected a file name that ends in .mp4 or .gif, got {path.suffix or 'no ending'}")
    if path.suffix == ".mp4" and not has_encoder():
        raise VideoError(f"no video encoder: {INSTALL_EXTRA}, or choose a .gif")
    with gl_for_others():
        frames, fps = _episode(make_env, policy, seed)
    temporary = temporary_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writers[path.suffix](temporary, frames, fps)
        os.replace(temporary, path)
    except OSError as error:
        raise VideoError(f"cannot write {path}: {error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return path


def has_encoder() -> bool:
    """Whether imageio-ffmpeg is installed and finds an ffmpeg (it brings its own on most systems)."""
    try:
        import imageio_ffmpeg  # the extra `video`

        return bool(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return False


def gl_backend() -> str | None:
    """The OpenGL backend that renders here: $MUJOCO_GL or the first that works of OSMesa, EGL and GLFW.

    Each is tried in a process of its own: MuJoCo settles for one when imported, and a broken driver may crash.
    """
    asked = os.environ.get("MUJOCO_GL")
    candidates = [asked] if asked else ["osmesa", "egl", "glfw"]
    return next((name for name in candidates if _renders(name)), None)


_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>")
with mujoco.Renderer(model, 16, 16) as renderer:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer.update_scene(data)
    assert renderer.render().any()
"""


def _renders(backend: str) -> bool:
    environment = os.environ | {"MUJOCO_GL": backend}
    return subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True).returncode == 0


def _episode(
    make_env: Callable[..., Any], policy: Callable[[np.ndarray], np.ndarray], seed: int
) -> tuple[list[Any], int]:
    # pygame would greet, and complain of a screen that is not there, among what the command says.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    try:
        env = make_env(render_mode="rgb_array")
    except Exception as error:  # whatever somebody's constructor raises
        raise _blame(error, 'cannot create the environment with render_mode="rgb_array"') from error
    with env_returns.closing(env, "the environment"):
        _follow(env)
        observation, _ = env.reset(seed=seed)
        frames, over = [_frame(env)], False
        while not over and len(frames) <= FRAMES:
            observation, _, terminated, truncated, _ = env.step(policy(observation))
            over = terminated or truncated
            frames.append(_frame(env))
        return frames, int(env.metadata.get("render_fps", 30))


def _follow(env: Any) -> None:
    """Lets the model's camera "track" draw, if it has one and nobody asked for another, and a floor without end.

    The camera of Gymnasium's MuJoCo tasks stands still, so that runners leave the picture, and later the floor.
    """
    inner = env.inner if isinstance(env, Guarded) else getattr(env, "unwrapped", env)
    renderer: Any = getattr(inner, "mujoco_renderer", None)
    spec: Any = getattr(inner, "spec", None)
    if getattr(renderer, "camera_id", None) != -1:  # not Gymnasium's, or not its free camera
        return
    if spec is not None and spec.kwargs.keys() & {"camera_id", "camera_name", "default_camera_config"}:
        return
    import mujoco  # only where the environment is of MuJoCo

    model = renderer.model
    renderer.camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    if renderer.camera_id != -1:
        _without_end(model)


def _without_end(model: Any) -> None:
    """The world's planes hold whatever stands on them without end, but are drawn only as far as their size says.

    A size of 0 is drawn without end, with as many tiles a metre as before.
    """
    import mujoco

    for floor in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        material, size = model.geom_matid[floor], model.geom_size[floor, :2].copy()
        if model.geom_bodyid[floor] == 0 and size.all():
            model.geom_size[floor, :2] = 0
            if material >= 0 and not model.mat_texuniform[material]:
                model.mat_texrepeat[material] /= 2 * size


def _frame(env: Any) -> np.ndarray:
    try:
        picture = env.render()
    except Exception as error:  # every GL library fails in its own way
        raise _blame(error, "render() failed") from error
    if np.ndim(picture) != 3:
        raise VideoError(
            f"render: expected a picture [height, width, 3], got {type(picture).__name__}: let the environment return "
            'one where render_mode is "rgb_array"'
        )
    height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2  # what yuv420p can hold
    return np.ascontiguousarray(picture[:height, :width])


def _blame(error: Exception, what: str) -> VideoError:
    """Says what is missing: OpenGL, a package, or a part of the environment."""
    causes = [cause for cause in (error.__cause__, error) if cause is not None]
    cause = causes[0] if isinstance(error, MetrpoError) else error
    said = f"{type(cause).__name__}: {cause}"
    if isinstance(error, MetrpoError) and (cause is error or INSTALL_GL in str(error)):
        return VideoError(str(error))
    if any(map(_comes_from_gl, causes)):
        return VideoError(f"cannot render here ({said}): {INSTALL_GL}; see: metrpo doctor")
    if isinstance(cause, gymnasium.error.DependencyNotInstalled | ImportError):
        install = INSTALL_EXTRA if "pygame" in str(cause) else "install it"
        return VideoError(f"{what}: a package is missing ({said}): {install}")
    if isinstance(cause, NotImplementedError):
        return VideoError("the environment has no render(), so there is nothing to see")
    advice = "let its constructor take render_mode" if isinstance(cause, TypeError) else "repair the environment"
    return VideoError(f"{what} ({said}): {advice}")


def _comes_from_gl(error: BaseException) -> bool:
    """Whether an OpenGL library, or what calls it, was at work when the error was raised."""
    modules = [str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(name.split(".")[0] in _GL or "mujoco_rendering" in name for name in modules)


def _write_mp4(path: Path, frames: list[np.ndarray], fps: int) -> None:
    import imageio_ffmpeg  # the extra `video`

    height, width, _ = frames[0].shape
    # H.264 in yuv420p, the default, with its index at the start: what every browser plays.
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=fps, macro_block_size=2, output_params=["-movflags", "+faststart"]
    )
    with warnings.catch_warnings():
        # It forks only to become ffmpeg at once, which JAX's threads survive.
        warnings.filterwarnings("ignore", message=".*os.fork", category=RuntimeWarning)
        writer.send(None)
    try:
        for frame in frames:
            writer.send(frame)
    finally:
        writer.close()


def _write_gif(path: Path, frames: list[np.ndarray], fps: int) -> None:
    from PIL import Image  # comes with matplotlib

    # Browsers slow down frames shorter than 20 ms.
    step = max(1, round(fps / 25))
    pictures = [Image.fromarray(frame).quantize(64) for frame in frames[::step]]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=1000 * step / fps, loop=0, optimize=True)
