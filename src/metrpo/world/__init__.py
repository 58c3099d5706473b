"""The real side: tasks with known reward and unknown dynamics. Importing it registers the MuJoCo tasks."""

from metrpo.world import mujoco as mujoco
