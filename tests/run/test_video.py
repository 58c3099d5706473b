"""Videos: frames of a real episode in a file that players open, or a message that says what to install."""

import dataclasses
import os
import re
import subprocess
import sys
import types

import gymnasium
import mujoco
import numpy as np
import pytest
from PIL import Image

from helpers import random_policy
from metrpo.run import video
from metrpo.run.metrics import to_csv
from metrpo.run.policy_file import Learned, save_policy
from metrpo.run.video import VideoError, gl_backend, has_encoder, record
from metrpo.world import opengl
from metrpo.world.registry import get_task

needs_encoder = pytest.mark.skipif(not has_encoder(), reason="no video encoder (extra `video`)")


class Pictures:
    """Five frames of an odd size."""

    metadata = {"render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str) -> None:
        assert render_mode == "rgb_array"
        self.seen: list[np.ndarray] = []

    def reset(self, seed):
        self.step_number = seed
        return np.zeros(3), {}

    def step(self, action):
        self.seen.append(action)
        self.step_number += 1
        return np.zeros(3), 0.0, False, len(self.seen) == 4, {}

    def render(self):
        picture = np.zeros((65, 97, 3), np.uint8)
        picture[:, : 20 * len(self.seen)] = (250, 120, 10)
        return picture

    def close(self):
        pass


def zero(observation):
    return np.zeros(2, np.float32)


def test_a_video_of_an_endless_episode_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "FRAMES", 3)
    env = Pictures("rgb_array")
    env.seen = [zero(None)] * 10  # past the step at which it ends
    frames, _ = video._episode(lambda render_mode: env, zero, 0)
    assert len(frames) == 4


@needs_encoder
def test_mp4_holds_every_frame_in_h264(tmp_path):
    import imageio_ffmpeg

    path = record(Pictures, zero, tmp_path / "new" / "v.mp4")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(command, capture_output=True, check=True)
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 64, 96, 3)
    assert len(frames) == 5
    for part in (b"Video: h264", b"yuv420p", b"10 fps"):
        assert part in decoded.stderr
    assert frames[0].mean() < 10
    assert abs(frames[-1][:, :70].reshape(-1, 3).mean(0) - (250, 120, 10)).max() < 25
    assert [p.name for p in path.parent.iterdir()] == ["v.mp4"]


def test_gif_needs_no_encoder(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with Image.open(record(Pictures, zero, tmp_path / "v.gif")) as picture:
        assert (picture.n_frames, picture.size, picture.info["duration"]) == (5, (96, 64), 100)


def test_no_encoder_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(VideoError, match=r"no video encoder: pip install 'metrpo\[video\]', or choose a \.gif"):
        record(Pictures, zero, tmp_path / "v.mp4")


def test_what_an_opengl_library_raises_is_opengl_that_is_missing(tmp_path, monkeypatch):
    library = types.ModuleType("OpenGL.fake")
    exec("def draw():\n    raise RuntimeError('no display')", library.__dict__)
    monkeypatch.setattr(Pictures, "render", lambda self: library.draw())
    with pytest.raises(VideoError, match=r"cannot render here \(RuntimeError: no display\): apt install libosmesa6"):
        record(Pictures, zero, tmp_path / "v.gif")
    assert not any(tmp_path.iterdir())


def test_other_failures_are_not_blamed_on_opengl(tmp_path, monkeypatch):
    def broken(self):
        raise RuntimeError("no paint")

    monkeypatch.setattr(Pictures, "render", broken)
    with pytest.raises(VideoError, match=r"render\(\) failed \(RuntimeError: no paint\): repair") as error:
        record(Pictures, zero, tmp_path / "v.gif")
    assert "osmesa" not in str(error.value)
    monkeypatch.setattr(Pictures, "render", gymnasium.Env.render)
    with pytest.raises(VideoError, match=r"has no render\(\), so there is nothing to see$"):
        record(Pictures, zero, tmp_path / "v.gif")


@pytest.mark.parametrize("name", ["Pendulum-v1", "MountainCarContinuous-v0"])
def test_without_pygame_that_is_what_is_missing(name, tmp_path, monkeypatch):
    for module in [m for m in sys.modules if m.split(".")[0] == "pygame"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "pygame", None)
    task = get_task(name)
    with pytest.raises(VideoError, match=r"a package is missing .*pygame.*: pip install 'metrpo\[video\]'") as error:
        record(task.make_env, lambda _: np.zeros(1, np.float32), tmp_path / "v.gif")
    assert "osmesa" not in str(error.value)


def test_with_pygame_the_pendulum_is_seen(tmp_path):
    pytest.importorskip("pygame")
    task = dataclasses.replace(get_task("Pendulum-v1"), make=lambda **kw: gymnasium.make("Pendulum-v1", 5, **kw))
    with Image.open(record(task.make_env, lambda _: np.zeros(1, np.float32), tmp_path / "v.gif")) as picture:
        assert picture.n_frames == 6


def test_an_environment_without_pictures_is_named(tmp_path, monkeypatch):
    with pytest.raises(VideoError, match=r"cannot create the environment with render_mode.*TypeError.*render_mode$"):
        record(lambda: None, zero, tmp_path / "v.gif")
    monkeypatch.setattr(Pictures, "render", lambda self: None)
    with pytest.raises(VideoError, match=r"expected a picture \[height, width, 3\], got NoneType.*rgb_array\"$"):
        record(Pictures, zero, tmp_path / "v.gif")


NO_LIBRARY = """
import ctypes, ctypes.util, sys
load, find = ctypes.CDLL.__init__, ctypes.util.find_library
def absent(name):
    return any(library in str(name) for library in ("OSMesa", "EGL"))
def cannot_load(self, name, *rest, **more):
    if absent(name):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *rest, **more)
ctypes.CDLL.__init__ = cannot_load
ctypes.util.find_library = lambda name: None if absent(name) else find(name)
from metrpo.commands.main import main
for command in (["tasks"], ["doctor"], ["render", sys.argv[1], "--out", "v.gif"]):
    print("exit code", main(command), flush=True)
from pathlib import Path
from metrpo.commands.train import say_outcome
say_outcome(Path(sys.argv[1]), video=True)  # what a finished run says
"""


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("osmesa", r"no OpenGL to render with \(tried osmesa: .*\): apt install libosmesa6"),
        ("egl", r"no OpenGL to render with \(tried egl: .*\): apt install libosmesa6"),
        ("nonsense", "MUJOCO_GL: expected osmesa, egl or glfw, got nonsense"),
        ("off", "MUJOCO_GL=off switches rendering off: unset it"),
    ],
)
def test_an_opengl_that_is_not_there_costs_the_video_only(asked, said, tmp_path):
    policy = random_policy(0, 10, 2)
    save_policy(tmp_path, policy, "Swimmer", Learned(1, 200, 1.5))
    row = {"iteration": 1, "real_steps": 200, "return_real": 1.5, "return_real_std": 0.5}
    (tmp_path / "metrics.csv").write_text(to_csv([row]))
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": asked}
    command = [sys.executable, "-W", "ignore", "-c", NO_LIBRARY, str(tmp_path)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert re.findall("exit code ([0-9])", ran.stdout) == ["0", "0", "2"]
    assert "training can work here" in ran.stdout
    assert re.search(f"^metrpo: {said}", ran.stderr, re.MULTILINE)
    assert ran.stderr.count("\n") == 1
    assert re.search(f"video    none: {said}", ran.stdout)


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(VideoError, match=r"ends in \.mp4 or \.gif"):
        record(Pictures, zero, tmp_path / "v.avi")


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(VideoError, match=r"cannot write .*v\.gif"):
        record(Pictures, zero, tmp_path / "file" / "v.gif")


def test_the_first_backend_that_renders_is_named(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(video, "_renders", lambda name: name == "egl")
    assert gl_backend() == "egl"
    monkeypatch.setattr(video, "_renders", lambda name: False)
    assert gl_backend() is None


_SWIM = """
import sys
from pathlib import Path
import numpy as np
from metrpo.run.video import record
from metrpo.world.registry import get_task
task = get_task("Swimmer")
def short(**kwargs):
    env = task.make_env(**kwargs)
    env._max_episode_steps = 3
    return env
record(short, lambda state: np.ones(task.action_size, np.float32), Path(sys.argv[1]))
"""


@pytest.mark.skipif(gl_backend() is None, reason="no OpenGL")
def test_the_swimmer_is_seen(tmp_path):
    path = tmp_path / "swim.gif"
    subprocess.run([sys.executable, "-c", _SWIM, str(path)], check=True)
    with Image.open(path) as picture:
        assert picture.n_frames == 4
        assert len(set(picture.convert("L").tobytes())) > 20


@pytest.mark.parametrize(
    ("own", "found", "seen"), [(None, "osmesa", "osmesa"), ("egl", "osmesa", "egl"), (None, None, None)]
)
def test_other_environments_draw_by_the_library_that_ours_would_take(own, found, seen, tmp_path, monkeypatch):
    """Gymnasium would take GLFW, which fails where there is no display."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if own:
        monkeypatch.setenv("MUJOCO_GL", own)
    monkeypatch.setattr(opengl, "gl_library", lambda: found)
    asked = []

    class Drawn(Pictures):
        def render(self):
            asked.append(os.environ.get("MUJOCO_GL"))
            return super().render()

    record(Drawn, zero, tmp_path / "video.gif")
    assert set(asked) == {seen}
    assert os.environ.get("MUJOCO_GL") == own


@pytest.mark.parametrize(
    ("name", "asked", "camera"),
    [
        ("HalfCheetah-v5", {}, "track"),
        ("Hopper-v5", {}, "track"),
        ("mbbl/HalfCheetah", {}, "track"),
        ("mbbl/Swimmer", {}, "track"),
        ("InvertedPendulum-v5", {}, None),  # it has none
        ("HalfCheetah-v5", {"camera_id": -1}, None),
        ("mbbl/Hopper", {"camera_id": -1}, None),
        ("Hopper-v5", {"default_camera_config": {"distance": 9.0}}, None),
    ],
)
def test_the_camera_follows_a_robot_unless_another_is_asked_for(name, asked, camera, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "FRAMES", 1)
    env = get_task(name, env_kwargs=asked).make_env(render_mode="rgb_array")
    renderer, still = getattr(env, "inner", env.unwrapped).mujoco_renderer, np.zeros(env.action_space.shape, np.float32)
    env.render = lambda: np.zeros((16, 16, 3), np.uint8)  # what is drawn needs OpenGL, the choice of a camera does not
    record(lambda render_mode: env, lambda state: still, tmp_path / "video.gif")
    assert mujoco.mj_id2name(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, renderer.camera_id) == camera


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "mbbl/HalfCheetah", "Ant-v5"])
def test_whoever_is_followed_never_leaves_the_floor_and_moves_as_ever(name, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "FRAMES", 1)
    plain = get_task(name).make_env()
    env = get_task(name).make_env(render_mode="rgb_array")
    env.render = lambda: np.zeros((16, 16, 3), np.uint8)
    record(lambda render_mode: env, lambda state: np.zeros(env.action_space.shape), tmp_path / "video.gif")
    inner, untouched = (getattr(x, "inner", x.unwrapped) for x in (env, plain))
    planes = inner.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    assert planes.any()
    assert not inner.model.geom_size[planes, :2].any()
    # As many tiles a metre as before.
    size, material = untouched.model.geom_size[planes][0, :2], untouched.model.geom_matid[planes][0]
    np.testing.assert_allclose(
        inner.model.mat_texrepeat[material] * 2 * size, untouched.model.mat_texrepeat[material], rtol=1e-6
    )
    env, plain = get_task(name).make_env(render_mode="rgb_array"), get_task(name).make_env()
    video._follow(env)
    states = []
    for each in (env, plain):
        each.reset(seed=0)
        data = getattr(each, "inner", each.unwrapped).data
        data.qpos[0] = 1_000.0
        states.append([each.step(np.full(each.action_space.shape, 0.5, np.float32))[0] for _ in range(40)])
    np.testing.assert_array_equal(*states)


def test_an_error_of_the_environment_passes_whatever_draws_it(tmp_path, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(opengl, "gl_library", lambda: "osmesa")

    class Broken(Pictures):
        def step(self, action):
            raise ValueError("a joint")

    with pytest.raises(ValueError, match="a joint"):
        record(Broken, zero, tmp_path / "video.gif")
    assert "MUJOCO_GL" not in os.environ
