"""The peer PyTorch: the same work as one would write it by hand, without a library."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from peer_data import (
    ACTION,
    FIT_STEPS,
    HIDDEN,
    HORIZON,
    LEARNING_RATE,
    MEMBERS,
    ROLLOUTS,
    STATE,
    draw,
    mean_network,
    minibatches,
    reward,
    starts,
)
from peer_loop import Repetition, serve, timed
from torch.nn.utils import parameters_to_vector, vector_to_parameters

MAX_KL, DAMPING, CG_ITERATIONS, RATIO, TRIES = 0.01, 1e-5, 10, 0.8, 15


def networks(name: str) -> list[tuple[Any, Any]]:
    """Weights [5, in, out] and biases [5, 1, out] of every layer."""
    torch.manual_seed(2)
    sizes = (STATE + ACTION, *HIDDEN[name], STATE)
    return [
        ((torch.randn(MEMBERS, i, o) / (2 * i**0.5)).requires_grad_(), torch.zeros(MEMBERS, 1, o, requires_grad=True))
        for i, o in pairwise(sizes)
    ]


def predict(layers: list[tuple[Any, Any]], inputs: Any) -> Any:
    """Each member for its own batch: [5, B, 24] -> [5, B, 18]."""
    *inner, (last_weights, last_biases) = layers
    for weights, biases in inner:
        inputs = torch.baddbmm(biases, inputs, weights).relu_()
    return torch.baddbmm(last_biases, inputs, last_weights)


def fit(name: str, bfloat16: bool = False) -> Repetition:
    """A training step of all members, each on its own minibatch."""
    layers = networks(name)
    optimizer = torch.optim.Adam([x for layer in layers for x in layer], lr=LEARNING_RATE, fused=True)
    pairs = minibatches()

    def step() -> None:
        inputs, targets = next(pairs)
        optimizer.zero_grad()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
            outputs = predict(layers, inputs)
        (outputs.float() - targets).square().mean(dim=(1, 2)).sum().backward()
        optimizer.step()

    return lambda: timed(step, FIT_STEPS)


def imagine(name: str, bfloat16: bool = False) -> Repetition:
    """Rollouts; at each step the states are shuffled and dealt to the models in equal groups."""
    layers, policy, first = networks(name), mean_network(), starts()
    precision = torch.bfloat16 if bfloat16 else torch.float32

    @torch.inference_mode()
    def rollouts() -> tuple[Any, ...]:
        # Cast once: autocast would do so at every step.
        cast = [(weights.to(precision), biases.to(precision)) for weights, biases in layers]
        states, steps = first, []
        for _ in range(HORIZON):
            actions = draw(policy(states))
            clipped = actions.clamp(-1.0, 1.0)
            order = torch.randperm(ROLLOUTS)
            inputs = torch.cat([states, clipped], dim=1)[order].view(MEMBERS, -1, STATE + ACTION)
            deltas = predict(cast, inputs.to(precision))
            following = states.index_add(0, order, deltas.float().view(ROLLOUTS, STATE))
            steps.append((states, actions, reward(clipped, following)))
            states = following
        return tuple(torch.stack(values) for values in zip(*steps, strict=True))

    return lambda: timed(rollouts)


def trpo() -> Repetition:
    """One update on 50,000 samples, every time from the same parameters."""
    policy, log_std = mean_network(), torch.zeros(ACTION, requires_grad=True)
    parameters = [*policy.parameters(), log_std]
    start = parameters_to_vector(parameters).detach()
    states, advantages = torch.randn(ROLLOUTS * HORIZON, STATE), torch.randn(ROLLOUTS * HORIZON)
    with torch.no_grad():
        actions = draw(policy(states))

    def repetition() -> float:
        vector_to_parameters(start, parameters)
        return timed(partial(_update, policy, log_std, parameters, states, actions, advantages))

    return repetition


def _update(policy: Any, log_std: Any, parameters: list[Any], states: Any, actions: Any, advantages: Any) -> bool:
    means = policy(states)
    old_means, old_log_std = means.detach(), log_std.detach().clone()
    old_log_probability = _log_probability(old_means, old_log_std, actions)

    def surrogate_of(means: Any) -> Any:
        return ((_log_probability(means, log_std, actions) - old_log_probability).exp() * advantages).mean()

    def kl_of(means: Any) -> Any:
        ratio, distance = (2 * (old_log_std - log_std)).exp(), ((old_means - means) * (-log_std).exp()).square()
        return 0.5 * (ratio + distance - 1 + 2 * (log_std - old_log_std)).sum(dim=1).mean()

    surrogate = surrogate_of(means)
    gradient = _flat_gradient(surrogate, parameters, retain_graph=True)
    slope = _flat_gradient(kl_of(means), parameters, create_graph=True)
    direction, residual = conjugate_gradient(
        lambda v: _flat_gradient(slope @ v, parameters, retain_graph=True) + DAMPING * v, gradient
    )
    step = direction * (2 * MAX_KL / (direction @ (gradient - residual))).sqrt()
    old = parameters_to_vector(parameters).detach()
    with torch.no_grad():
        for i in range(TRIES):
            vector_to_parameters(old + RATIO**i * step, parameters)
            means = policy(states)
            if surrogate_of(means) > surrogate and kl_of(means) <= MAX_KL:
                return True
        vector_to_parameters(old, parameters)
    return False


def _log_probability(means: Any, log_std: Any, actions: Any) -> Any:
    # The constant cancels out in ratios.
    return -0.5 * ((actions - means) * (-log_std).exp()).square().sum(dim=1) - log_std.sum()


def _flat_gradient(value: Any, parameters: list[Any], **options: Any) -> Any:
    return torch.cat([x.reshape(-1) for x in torch.autograd.grad(value, parameters, **options)])


def conjugate_gradient(product: Callable[[Any], Any], target: Any) -> tuple[Any, Any]:
    """Solves product(x) = target from x = 0: (x, residual target - product(x))."""
    x, residual, direction = torch.zeros_like(target), target.clone(), target.clone()
    square = residual @ residual
    for _ in range(CG_ITERATIONS):
        image = product(direction)
        alpha = square / (direction @ image)
        x, residual = x + alpha * direction, residual - alpha * image
        square, previous = residual @ residual, square
        direction = residual + square / previous * direction
    return x, residual


CRITICS, STARTS, STEPS, DISCOUNT, WEIGHT, TARGET_RATE = 2, 256, 3, 0.99, 0.1, 0.005


class TorchCritic(torch.nn.Module):
    """Values states and actions: layers of 256 and 256, normalised."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[Any] = []
        for size in (STATE + ACTION, 256):
            layers += [torch.nn.Linear(size, 256), torch.nn.LayerNorm(256, elementwise_affine=False), torch.nn.SiLU()]
        self.layers = torch.nn.Sequential(*layers, torch.nn.Linear(256, 1))

    def forward(self, states: Any, actions: Any) -> Any:
        """[..., S], [..., A] -> [...]."""
        return self.layers(torch.cat([states, actions], dim=-1))[..., 0]


def actor_critic() -> Repetition:
    """An update of actor, critics and entropy weight on short rollouts, and on as many real transitions."""
    torch.manual_seed(3)
    layers, critics = networks("200x3"), [TorchCritic() for _ in range(CRITICS)]
    targets = [TorchCritic() for _ in range(CRITICS)]
    actor = torch.nn.Sequential(
        *(torch.nn.Linear(STATE, 256), torch.nn.Tanh(), torch.nn.Linear(256, 256), torch.nn.Tanh()),
        torch.nn.Linear(256, 2 * ACTION),
    )
    log_weight = torch.tensor(WEIGHT).log().requires_grad_()
    of_critics = [x for critic in critics for x in critic.parameters()]
    groups = (list(actor.parameters()), of_critics, [log_weight])
    optimizers = [torch.optim.Adam(group, lr=3e-4, fused=True) for group in groups]
    real = [torch.randn(STARTS, size) for size in (STATE, ACTION, STATE)]
    real_rewards, first = torch.randn(STARTS), 0.1 * torch.randn(STARTS, STATE)
    frozen = [(weights.detach(), biases.detach()) for weights, biases in layers]

    def sample(states: Any) -> tuple[Any, Any]:
        means, log_std = actor(states).chunk(2, dim=-1)
        log_std = log_std.clamp(-5.0, 2.0)
        noise = torch.randn_like(means)
        drawn = means + log_std.exp() * noise
        slope = 2.0 * (0.6931 - drawn - torch.nn.functional.softplus(-2.0 * drawn))
        return drawn.tanh(), (-0.5 * noise.square() - log_std - 0.9189 - slope).sum(dim=-1)

    def spread(states: Any, actions: Any) -> Any:
        """How far the members' predictions lie apart."""
        with torch.no_grad():
            inputs = torch.cat([states, actions], dim=1).expand(MEMBERS, -1, -1)
            return predict(frozen, inputs).std(dim=0).mean(dim=1)

    def step() -> None:
        weight, states, rewards, entropies, trusted = log_weight.exp().detach(), first, [], [], []
        kept = None
        for _ in range(STEPS):
            actions, log_probability = sample(states)
            kept = kept or (states, actions.detach())
            order = torch.randperm(STARTS)[: STARTS // MEMBERS * MEMBERS]
            inputs = torch.cat([states, actions], dim=1)[order].view(MEMBERS, -1, STATE + ACTION)
            following = states.index_add(0, order, predict(frozen, inputs).view(-1, STATE))
            trusted.append(spread(states, actions))
            rewards.append(reward(actions, following)[:, 0])
            entropies.append(log_probability)
            states = following
        actions, log_probability = sample(states)
        value = torch.stack([critic(states, actions) for critic in critics]).amin(dim=0) - weight * log_probability
        with torch.no_grad():
            least = torch.stack([target(states, actions) for target in targets]).amin(dim=0)
            aim = least - weight * log_probability
        for i in reversed(range(STEPS)):
            value = rewards[i] + DISCOUNT * value - weight * entropies[i]
            aim = rewards[i].detach() + DISCOUNT * (aim if i == STEPS - 1 else aim - weight * entropies[i + 1].detach())
        optimizers[0].zero_grad()
        (-value.mean()).backward()
        with torch.no_grad():
            next_actions, next_log = sample(real[2])
            after = torch.stack([target(real[2], next_actions) for target in targets]).amin(dim=0) - weight * next_log
            aims = torch.cat([aim.detach(), real_rewards + DISCOUNT * after])
        assert kept is not None
        seen, done = torch.cat([kept[0], real[0]]), torch.cat([kept[1], real[1]])
        optimizers[1].zero_grad()
        sum((critic(seen, done) - aims).square().mean() for critic in critics).backward()  # type: ignore[union-attr]
        optimizers[2].zero_grad()
        (log_weight * (-entropies[0].detach().mean() + ACTION)).backward()
        torch.nn.utils.clip_grad_norm_(groups[0], 10.0)
        for optimizer in optimizers:
            optimizer.step()
        with torch.no_grad():
            for critic, target in zip(critics, targets, strict=True):
                for new, slow in zip(critic.parameters(), target.parameters(), strict=True):
                    slow.lerp_(new, TARGET_RATE)

    return lambda: timed(step, FIT_STEPS)


WORK = {
    "actor-critic": actor_critic,
    "fit-1024": partial(fit, "1024"),
    "fit-200x4": partial(fit, "200x4"),
    "fit-1024-bfloat16": partial(fit, "1024", bfloat16=True),
    "imagine-1024": partial(imagine, "1024"),
    "imagine-200x4": partial(imagine, "200x4"),
    "imagine-1024-bfloat16": partial(imagine, "1024", bfloat16=True),
    "trpo": trpo,
}

if __name__ == "__main__":
    serve(WORK)
