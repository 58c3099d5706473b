"""The paper's six tasks on MuJoCo (its appendix "Environment details"; the physics are rllab's)."""

from metrpo.environment_ids import HORIZONS, env_id, register_ids
from metrpo.types import EndFormula, RewardFormula
from metrpo.world.interface import of_paper_task
from metrpo.world.registry import register
from metrpo.world.task import Task
from metrpo.world.tasks.rllab.bodies import ANT, CHEETAH, HOPPER, HUMANOID, LYING, ROBOTS, SNAKE, SWIMMER, Robot
from metrpo.world.tasks.rllab.rewards import (
    ant_terminated,
    hopper_reward,
    hopper_upright_reward,
    humanoid_reward,
    velocity_reward,
)


def _add(
    robot: Robot,
    name: str,
    sizes: tuple[int, int],
    reward: RewardFormula,
    unseen: tuple[int, ...],
    description: str,
    terminated: EndFormula | None = None,
) -> None:
    """Makes a task known to metrpo; Gymnasium knows it by `metrpo.environment_ids`, with its time limit."""
    ROBOTS[name] = robot
    shows = of_paper_task(name, sizes[1])
    register(Task(name, env_id(name), *sizes, HORIZONS[name], reward, terminated, unseen, description, interface=shows))


register_ids()
_add(SWIMMER, "Swimmer", (10, 2), velocity_reward(5, 0.005), (0, 1), "3 links swim along x in a viscous fluid")
_add(SNAKE, "Snake", (14, 4), velocity_reward(7, 0.005), (0, 1), "5 links swim along x in a viscous fluid")
_add(HOPPER, "Hopper", (11, 3), hopper_reward, (), "one leg hops along x without sinking below 0.45 m")
_add(HOPPER, "HopperUpright", (11, 3), hopper_upright_reward, (), "Hopper that must also stay upright")
_add(CHEETAH, "HalfCheetah", (18, 6), velocity_reward(9, 0.05), (0,), "two legs in a plane run along x")
_add(ANT, "Ant", (29, 8), velocity_reward(15, 0.005, 0.05), (0, 1), "four legs walk along x", ant_terminated)
_add(HUMANOID, "Humanoid", (47, 17), humanoid_reward, (), "keep the head at 1.5 m, starting upright")
_add(LYING, "HumanoidStandup", (47, 17), humanoid_reward, (), "bring the head to 1.5 m, starting on the floor")
