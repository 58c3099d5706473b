"""A policy's card: what it earns on what task and where it comes from, for `metrpo zoo` and the Hugging Face hub."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from metrpo.run.about import about
from metrpo.run.find import SeenRun
from metrpo.run.loaded_policy import PolicyInfo
from metrpo.run.policy_file import load_policy

POINTS = 12
"""Of a card's learning curve."""


def card_of(run: SeenRun) -> dict[str, Any]:
    """What is known of a run's policy. Raises `RunDirectoryError` when there is no sound policy."""
    info, made = load_policy(run.path).info, about(run.path)
    steps, returns = run.column("real_steps"), run.column("return_real")
    measured = np.flatnonzero(np.isfinite(returns))
    shown = measured[np.unique(np.linspace(0, len(measured) - 1, POINTS).astype(int))] if len(measured) else measured
    return {
        "task": info.task,
        "return": _finite(info.return_real),
        "no_skill": max(run.yardsticks.values(), default=None),
        "real_steps": info.real_steps,
        "system": run.config.system,
        "preset": run.config.preset,
        "seed": run.config.seed,
        "commit": made.get("commit"),
        "created": str(made.get("created", ""))[:10] or None,
        "curve": [[int(steps[i]), round(float(returns[i]), 2)] for i in shown],
    }


def model_card(run: SeenRun, repo: str, files: Sequence[str]) -> str:
    """The README.md of a repository `repo` on the hub with the run's policy and the other `files`.

    Its head is YAML, of which JSON is a part: whatever a task is called, it stays a text.
    """
    card = card_of(run)
    task, system = task_name(card["task"]), card["system"]
    info = load_policy(run.path).info
    earned = _earned(run, card, info.iteration)
    head: dict[str, Any] = {
        "library_name": "metrpo",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["metrpo", "reinforcement-learning", "model-based", "continuous-control", "jax", task],
    }
    if earned:
        result = {
            "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
            "dataset": {"name": task, "type": task},
            "metrics": [{"type": "mean_reward", "name": "mean_reward", "value": earned, "verified": False}],
        }
        head["model-index"] = [{"name": system, "results": [result]}]
    lines = [f"{name}: {json.dumps(value)}" for name, value in head.items()]
    return "\n".join(["---", *lines, "---", "", *_body(run, info, card, earned, repo, files), ""])


def task_name(text: str) -> str:
    """A task's name without the folder of its file, which says more about its author's machine than about the task."""
    plain = " ".join(text.split())
    file, colon, name = plain.rpartition(":")
    return f"{file.replace(chr(92), '/').rpartition('/')[2]}:{name}" if colon and ".py" in file else plain


def _method(run: SeenRun) -> str:
    if run.config.method != "model-based":
        return f"{run.config.method}, without models"
    if run.config.by_critics:
        return "an off-policy actor-critic in an ensemble of learned models"
    return "Model-Ensemble Trust-Region Policy Optimization, arXiv 1802.10592"


def _body(
    run: SeenRun, info: PolicyInfo, card: dict[str, Any], earned: str, repo: str, files: Sequence[str]
) -> list[str]:
    """The card's text, line by line."""
    task = task_name(info.task)
    code = f"`{task.replace('`', chr(39))}`"
    episodes = run.config.evaluation_episodes
    over = f", mean and standard deviation over {episodes} real episodes without noise" if earned else ""
    no_skill = [f"- {name}: {value:.1f}" for name, value in run.yardsticks.items()]
    return [
        f"# {card['system']} for {code}",
        "",
        f"A policy for {code}, trained by metrpo ({_method(run)}).",
        "",
        f"- return: {earned or 'not measured'}{over}",
        *(no_skill or ["- doing nothing, random actions: not measured"]),
        f"- learned from: {card['real_steps']:,} real steps",
        f"- system {card['system']}, preset {card['preset']}, seed {card['seed']}",
        f"- metrpo's commit: {card['commit'] or 'unknown'}; {card['created'] or 'date unknown'}",
        "",
        "## Use",
        "",
        "After `pip install 'metrpo[hub]'`:",
        "",
        "```python",
        "import metrpo",
        f'policy = metrpo.load_policy("hub:{repo}")',
        "```",
        "",
        "`policy(observation)` is the action in [-1, 1], `policy.to_env(action)` the same in the environment's units.",
        *_limits_and_memory(info),
        f"`metrpo evaluate hub:{repo}{_asks_for_task(task)}` plays it.",
        "`policy.py` is the same policy for machines that have NumPy alone.",
        *(["", "![Learning curve](curve.png)"] if "curve.png" in files else []),
    ]


def _limits_and_memory(info: PolicyInfo) -> list[str]:
    """A line on the limits of its actions, and on what it remembers within an episode; none where neither is."""
    said = []
    if info.max_action < 1 or info.max_change is not None:
        change = "" if info.max_change is None else f", each within {info.max_change:g} of the one before"
        said.append(f"Its actions stay within {info.max_action:g} of 0{change}.")
    if info.history > 1:
        said.append(f"It sees the last {info.history} observations and the actions between them.")
    if info.history > 1 or info.max_change is not None:
        said.append("Call it once a step, and `policy.reset()` before each episode.")
    return [" ".join(said)] if said else []


def _asks_for_task(task: str) -> str:
    """A task of its author's own has to be named: no downloaded name runs code."""
    return f" --task PATH/{task}" if ".py:" in task else f" --task {task}" if ":" in task else ""


def _earned(run: SeenRun, card: dict[str, Any], at: int) -> str:
    """The return with its standard deviation, of the evaluation that the policy's file has; empty for none."""
    if card["return"] is None:
        return ""
    spread = [std for i, std in zip(run.column("iteration"), run.column("return_real_std"), strict=True) if i == at]
    return f"{card['return']:.2f}" + "".join(f" +/- {std:.2f}" for std in spread if np.isfinite(std))


def _finite(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and np.isfinite(value) else None
