"""The peer mbrl-lib: its ensembles' training step and its `ModelEnv`."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from mbrl.models import BasicEnsemble, GaussianMLP, ModelEnv, OneDTransitionRewardModel
from omegaconf import OmegaConf
from peer_data import (
    ACTION,
    FIT_STEPS,
    HIDDEN,
    HORIZON,
    LEARNING_RATE,
    MEMBERS,
    STATE,
    draw,
    mean_network,
    minibatches,
    reward,
    starts,
)
from peer_loop import Repetition, serve, timed


def _settings(name: str) -> dict[str, Any]:
    hidden = HIDDEN[name]
    return {
        "in_size": STATE + ACTION,
        "out_size": STATE,
        "device": "cpu",
        "num_layers": len(hidden),
        "hid_size": hidden[0],
        "deterministic": True,
    }


def batched(name: str) -> Any:
    """All members in one `GaussianMLP`, by its batched `EnsembleLinearLayer`."""
    return GaussianMLP(**_settings(name), ensemble_size=MEMBERS, propagation_method="random_model")


def basic(name: str) -> Any:
    """A `BasicEnsemble` of members that are `GaussianMLP`s of their own, one after the other."""
    return BasicEnsemble(MEMBERS, "cpu", OmegaConf.create({"_target_": "mbrl.models.GaussianMLP", **_settings(name)}))


def fit(model: Any) -> Repetition:
    """The library's training step of all members, each on its own minibatch."""
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    pairs = minibatches()

    def step() -> None:
        inputs, targets = next(pairs)
        model.update(inputs, optimizer, target=targets)

    return lambda: timed(step, FIT_STEPS)


def imagine(name: str) -> Repetition:
    """Rollouts in `ModelEnv`, each next state by a model drawn at random ("random_model")."""
    model = OneDTransitionRewardModel(batched(name), target_is_delta=True, learned_rewards=False)
    # ModelEnv asks its environment for two attributes only.
    spaces = SimpleNamespace(observation_space=None, action_space=None)
    env = ModelEnv(spaces, model, termination_fn=_never, reward_fn=reward)
    policy, states = mean_network(), starts()

    @torch.no_grad()
    def rollouts() -> tuple[Any, ...]:
        observation, state = states, env.reset(states.numpy(), return_as_np=False)
        steps = []
        for _ in range(HORIZON):
            actions = draw(policy(observation))
            following, rewards, _, state = env.step(actions.clamp(-1.0, 1.0), state)
            steps.append((observation, actions, rewards))
            observation = following
        return tuple(torch.stack(values) for values in zip(*steps, strict=True))

    return lambda: timed(rollouts)


def _never(_: Any, next_states: Any) -> Any:
    return torch.zeros(len(next_states), 1, dtype=torch.bool)


WORK = {
    "fit-1024": lambda: fit(batched("1024")),
    "fit-200x4": lambda: fit(batched("200x4")),
    "fit-1024-basic": lambda: fit(basic("1024")),
    "imagine-1024": partial(imagine, "1024"),
    "imagine-200x4": partial(imagine, "200x4"),
}

if __name__ == "__main__":
    serve(WORK)
