"""The ids under which Gymnasium knows the paper's tasks, "metrpo/Swimmer-v0", as soon as both are imported.

Neither import costs the other: the environment behind an id is imported when it is made.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

HORIZONS = {
    "Swimmer": 200,
    "Snake": 200,
    "Hopper": 100,
    "HopperUpright": 100,
    "HalfCheetah": 100,
    "Ant": 100,
    "Humanoid": 100,
    "HumanoidStandup": 100,
}
"""Steps of an episode, by task (the paper, "Environment details")."""


def env_id(task: str) -> str:
    """The id of one of these tasks."""
    return f"metrpo/{task}-v0"


def register_ids() -> None:
    """Makes Gymnasium know the ids; those that it knows stay as they are."""
    import gymnasium

    for task, horizon in HORIZONS.items():
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                env_id(task),
                entry_point="metrpo.world.tasks.rllab.environment:MujocoTask",
                max_episode_steps=horizon,
                disable_env_checker=True,  # it costs every step of every run what the tests check once
                kwargs={"task": task},
            )


def register_ids_with_gymnasium() -> None:
    """Registers the ids now if Gymnasium has been imported, or else as soon as it is.

    `import metrpo` must not import it: programs that only load a policy have no use for it.
    """
    if "gymnasium" in sys.modules:
        register_ids()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """Registers the ids when Gymnasium has been imported, and finds no module itself."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                register_ids()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
