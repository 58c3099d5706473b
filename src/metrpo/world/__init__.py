"""The real side: tasks with known reward and unknown dynamics. Importing it registers the MuJoCo tasks."""

from metrpo.world.opengl import load_mujoco

load_mujoco()  # before anything below imports it: without the OpenGL that MUJOCO_GL names, that fails

from metrpo.world.tasks import rllab as rllab  # noqa: E402
