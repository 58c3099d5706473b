"""The paper's figures as tables: which systems, on which tasks, how long. Extend them by adding a row.

A run is named by task, system (see `metrpo.systems`) and seed; figures share runs: the five models of `ensemble-size`
are the `me-trpo` of `comparison`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from metrpo.errors import ConfigError
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import rows_of
from metrpo.systems import Overrides

PAPER_TASKS = ("Swimmer", "Snake", "Hopper", "HalfCheetah", "Ant", "Humanoid")


@dataclass(frozen=True)
class Figure:
    """One comparison of the paper."""

    title: str
    claim: str
    """What the paper says that it shows."""
    systems: dict[str, str]
    """Name in the legend (the paper's) -> system, in the order of the legend; the first one is what others are held
    against."""
    tasks: tuple[str, ...]
    """The panels."""
    kind: Literal["curves", "overfitting", "wall-clock"] = "curves"
    log_steps: bool = False
    """Real steps on a logarithmic axis."""


FIGURES: dict[str, Figure] = {
    "comparison": Figure(
        "ME-TRPO and other methods",
        "ME-TRPO reaches the level of model-free methods with about 100 times less data; SVG(∞) stays below them.",
        {"ME-TRPO": "me-trpo", "TRPO": "trpo", "PPO": "ppo", "DDPG": "ddpg", "SVG(∞)": "svg-inf", "SVG(1)": "svg-1"},
        PAPER_TASKS,
        log_steps=True,
    ),
    "optimizers": Figure(
        "Ways to improve the policy, with one model",
        "Score-function methods are more stable than BPTT and end much higher; TRPO is the best.",
        {
            "TRPO": "k-1",
            "PPO": "model-ppo",
            "VPG": "model-vpg",
            "BPTT": "bptt",
            "BPTT, stochastic": "bptt-stochastic",
        },
        ("Swimmer", "HalfCheetah", "Hopper", "Ant"),
    ),
    "ensemble-size": Figure(
        "Number of models",
        "More models regularise better, and the return goes up with their number, most of all on HalfCheetah and Ant.",
        {"5 models": "me-trpo", "1 model": "k-1", "10 models": "k-10", "20 models": "k-20"},
        ("Swimmer", "HalfCheetah", "Hopper", "Ant"),
    ),
    "overfitting": Figure(
        "Imagined and real return with one model",
        "With one model the imagined return rises in each policy phase while the real one falls.",
        {"1 model": "k-1", "5 models": "me-trpo"},
        PAPER_TASKS,  # the paper shows Swimmer
        kind="overfitting",
    ),
    "sampling": Figure(
        "How the next state is imagined",
        "A model drawn at every step is the most robust; mean and median do not prevent overfitting.",
        {
            "step_rand": "me-trpo",
            "model_mean_std": "model_mean_std",
            "model_mean": "model_mean",
            "model_med": "model_med",
            "eps_rand": "eps_rand",
            "one_model": "one_model",
        },
        ("HalfCheetah", "Ant", "Swimmer"),
    ),
    "validation": Figure(
        "When to stop improving the policy",
        "The ensemble does well everywhere without a number to be set; the real return is over-cautious.",
        {
            "ensemble": "me-trpo",
            "real": "validate-real",
            "trpo_mean": "validate-trpo_mean",
            "no_early_50": "validate-no_early_50",
            "no_early_5": "validate-no_early_5",
            "one_model": "validate-one_model",
        },
        ("HalfCheetah", "Ant", "Swimmer"),
    ),
    "wall-clock": Figure(
        "Wall-clock time",
        "Hours on a K80 and 4 virtual CPUs, most of them spent on fitting the models.",
        {"ME-TRPO": "me-trpo"},
        PAPER_TASKS,
        kind="wall-clock",
    ),
}

PAPER_SECONDS = {
    "Swimmer": 35_300,
    "Snake": 60_800,
    "Hopper": 183_600,
    "HalfCheetah": 103_700,
    "Ant": 395_200,
    "Humanoid": 362_100,
}
"""Wall-clock time of the paper's runs (its appendix "Real-time complexity")."""

PAPER_REAL_STEPS = {**dict.fromkeys(PAPER_TASKS, 300_000), "Ant": 600_000, "Humanoid": 2_400_000}
"""About how many real steps these took (its figure "data-comparison")."""


@dataclass(frozen=True)
class Scale:
    """How much of the paper's work is done."""

    preset: Literal["fast", "paper"]
    seeds: dict[str, int]
    """System -> seeds; "*" stands for any other system."""
    tasks: tuple[str, ...]
    """Those that are run unless others are asked for."""
    iterations: dict[str, dict[str, int]] = field(default_factory=dict)
    """Task -> system -> outer iterations, where they are not the preset's; "*" stands for any other task or system.
    A system's number, of any task, goes before a task's for any system."""
    overrides: Overrides = field(default_factory=dict)
    """For every run."""


SCALES: dict[str, Scale] = {
    # Does every system run at all? Nothing can be learned in so few steps.
    "smoke": Scale(
        "fast",
        seeds={"*": 1},
        tasks=("Swimmer",),
        iterations={"*": {"*": 2}},
        overrides={
            "collect.steps": 400,
            "collect.max_train": 2000,
            "collect.max_validation": 1000,
            "ensemble.hidden": (16, 16),
            "evaluation_episodes": 2,
            "fit.max_steps": 50,
            "imagine.steps": 1000,
            "svg.model_steps": 10,
            "validate.max_updates": 5,
            "validate.starts": 5,
        },
    ),
    # Days on two cores. Budgets are to end where curves are flat, or where a run would take more than an hour or two.
    "laptop": Scale(
        "fast",
        seeds={"*": 3, "me-trpo": 5, "svg-1": 2, "svg-inf": 2},
        tasks=PAPER_TASKS,
        iterations={
            "*": {"*": 15, "me-trpo": 20, "trpo": 200, "ppo": 98, "ddpg": 60, "svg-1": 33, "svg-inf": 33},
            "Swimmer": {"*": 10, "me-trpo": 10, "trpo": 60, "ddpg": 200},
            "Snake": {"*": 10, "me-trpo": 10},
            "HalfCheetah": {"ddpg": 200},
            "Humanoid": {"*": 10, "me-trpo": 10},
        },
    ),
    # As in the paper: weeks on two cores.
    "paper": Scale("paper", seeds={"*": 3}, tasks=PAPER_TASKS),
}


def runs_of(figure: str, scale: str, tasks: tuple[str, ...] = (), seeds: int | None = None) -> list[RunSpec]:
    """The runs that a figure (or "all") needs at a scale, first seeds first; `tasks`, `seeds` instead of the scale's.

    Raises `ConfigError` for an unknown figure or scale, or a task that the figure does not show.
    """
    if scale not in SCALES:
        raise ConfigError(f"scale: expected one of {', '.join(SCALES)}, got {scale!r}")
    of = SCALES[scale]
    names = tuple(FIGURES) if figure == "all" else (figure,)
    if unknown := [n for n in names if n not in FIGURES]:
        raise ConfigError(f"figure: expected one of all, {', '.join(FIGURES)}, got {unknown[0]!r}")
    shown = {task for name in names for task in FIGURES[name].tasks}
    if wrong := [task for task in tasks if task not in shown]:
        raise ConfigError(f"tasks: expected some of {', '.join(sorted(shown))}, got {wrong[0]}")
    found: dict[RunSpec, None] = {}
    for name in names:
        for task in FIGURES[name].tasks:
            if task in (tasks or of.tasks):
                for system in FIGURES[name].systems.values():
                    enough = of.seeds.get(system, of.seeds["*"]) if seeds is None else seeds
                    found |= {run_of(scale, task, system, seed): None for seed in range(enough)}
    return sorted(found, key=lambda run: run.seed)


def run_of(scale: str, task: str, system: str, seed: int) -> RunSpec:
    """The run of a task, system and seed at a scale."""
    of = SCALES[scale]
    rows = (of.iterations.get(task, {}), of.iterations.get("*", {}))
    said = [row[name] for name in (system, "*") for row in rows if name in row]
    overrides = of.overrides | ({"iterations": said[0]} if said else {})
    return RunSpec(task, system, seed, tuple(overrides.items()), of.preset)


def runs_there(figure: str, scale: str, tasks: tuple[str, ...], out: Path) -> list[RunSpec]:
    """The runs of a figure that lie under `out`, of any seed; of all its tasks unless `tasks` names some."""
    found = []
    for task in tasks or FIGURES[figure].tasks:
        for system in FIGURES[figure].systems.values():
            numbers = [d.name.removeprefix("seed-") for d in (out / task / system).glob("seed-*/")]
            found += [run_of(scale, task, system, seed) for seed in sorted(int(n) for n in numbers if n.isdecimal())]
    return [run for run in found if rows_of(run, out)]
