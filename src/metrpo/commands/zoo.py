"""`metrpo zoo` lists the trained policies that come with the package."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import Positional, arg

from metrpo.commands.options import Switch


@dataclass(frozen=True)
class Zoo:
    """List the trained policies that come with metrpo, or show the card of one.

    evaluate, render and export take zoo:NAME in place of a run directory. For example:
        metrpo zoo
        metrpo zoo Snake
        metrpo evaluate zoo:Snake
        metrpo render zoo:Snake --out snake.mp4
        metrpo export zoo:Snake --out snake.py
    """

    name: Annotated[Positional[str | None], arg(metavar="NAME")] = None
    """Show the card of this policy; default: list all, one per line."""
    json: Switch = False
    """Print JSON."""


def run(command: Zoo) -> int:
    """Returns the exit code."""
    from metrpo import policy_zoo as zoo

    cards = [zoo.card(name) for name in ([command.name] if command.name else zoo.names())]
    if command.json:
        print(json.dumps(cards[0] if command.name else cards, indent=1))
    elif command.name:
        print("\n".join(_lines(cards[0])))
    else:
        print(f"{'name':<26}{'return':>10}{'no skill':>10}{'real steps':>12}  preset")
        for card in cards:
            numbers = f"{card['return']:>10.1f}{_number(card['no_skill']):>10}{card['real_steps']:>12,}"
            print(f"{card['name']:<26}{numbers}  {card['preset']}")
        print("\nmetrpo evaluate, render and export take zoo:NAME; metrpo zoo NAME shows a policy's card")
    return 0


def _lines(card: Mapping[str, Any]) -> list[str]:
    curve = ", ".join(f"{value:.0f} after {steps:,}" for steps, value in card["curve"])
    no_skill = _number(card["no_skill"])
    return [
        f"zoo:{card['name']}: a policy for {card['task']}",
        f"  return      {card['return']:.1f} in its run's last evaluation; without skill: {no_skill}",
        f"  chosen      the best of {card['chosen_of']} runs, whose mean is {card['mean_of_runs']:.1f}",
        f"  learned     from {card['real_steps']:,} real steps, {card['system']}, preset {card['preset']}",
        f"  from        {card['run']}, commit {card['commit'] or 'unknown'}, {card['created'] or 'date unknown'}",
        f"  curve       {curve} real steps",
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
