"""Our own work, timed: the three loops that a run consists of and the rates that bound them, at HalfCheetah's size.

Every piece is made of the package's own functions, called as a run calls them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from metrpo import devices, policy_phase
from metrpo.actor_critic_phase import branches, run_block
from metrpo.config import AdvantageConfig, CollectConfig, Config, FitConfig, TRPOConfig
from metrpo.devices import FIRST, SECOND, WHOLE
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble
from metrpo.model.fit import fit
from metrpo.model.imagine import Simulator, imagine
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers import actor_critic, trpo
from metrpo.policy.improvers.actor_critic import Steps, UpdateSettings
from metrpo.policy.improvers.batch import Batch
from metrpo.policy.value import linear
from metrpo.policy.value.critics import ValueScale
from metrpo.presets import override, preset
from metrpo.types import Array, Trajectories, Transitions
from metrpo.world import collection as real
from metrpo.world.registry import get_task
from metrpo.world.task import Task

TASK = "HalfCheetah"
STATE, ACTION, MEMBERS, BATCH = 18, 6, 5, 1000
ROLLOUTS, HORIZON = 500, 100
HIDDEN = {
    "1024": (1024, 1024),
    "200x4": (200, 200, 200, 200),
    "200x3": (200, 200, 200),
    "200x2": (200, 200),
}
FIT_STEPS = 5
"""Minibatches of a pass over the training set; the peers average over as many steps, without a validation."""
PRODUCTS = 20
"""Matrix products that one repetition of a rate averages over."""


class Work(NamedTuple):
    """A piece of work to time."""

    run: Callable[[], float]
    """Does it once and returns its seconds."""
    operations: float | None = None
    """Floating-point operations in its matrix products."""
    bound: str | None = None
    """The rate that bounds it, by name."""
    units: float | None = None
    """Samples or steps that it handles."""


def works() -> dict[str, Callable[[], Work]]:
    """Every piece of work by name; making one compiles and warms it up."""
    table: dict[str, Callable[[], Work]] = {
        "products": lambda: _products(BATCH, "float32"),
        "products-100": lambda: _products(ROLLOUTS // MEMBERS, "float32"),
        "products-bfloat16": lambda: _products(BATCH, "bfloat16"),
    }
    for width in ("1024", "200x4"):
        for kind, suffix in (("float32", ""), ("bfloat16", "-bfloat16")):
            table[f"fit-{width}{suffix}"] = partial(_fit, width, kind)
            table[f"imagine-{width}{suffix}"] = partial(_imagine, width, kind)
    return table | {
        "trpo": lambda: _trpo(TRPOConfig()),
        "trpo-1-cg": lambda: _trpo(TRPOConfig(cg_iterations=1)),
        "trpo-no-search": lambda: _trpo(TRPOConfig(cg_iterations=1, max_backtracks=1)),
        "actor-critic": _actor_critic,
        "baseline": _baseline,
        "validate-1024": lambda: _validate("1024"),
        "validate-200x2": lambda: _validate("200x2"),
        "collect": _collect,
    }


def _timed(run: Callable[[], Any]) -> Callable[[], float]:
    def once() -> float:
        start = time.perf_counter()
        jax.block_until_ready(run())
        return time.perf_counter() - start

    once()
    once()
    return once


def _products(rows: int, dtype: str) -> Work:
    """`PRODUCTS` products [rows, 1024] x [1024, 1024] for each of five members, one after the other."""
    width = 1024
    x, weights = jnp.ones((MEMBERS, rows, width)), jnp.full((MEMBERS, width, width), 1 / width, dtype)

    @jax.jit
    def chain(x: Array, weights: Array) -> Array:
        def product(_: int, x: Array) -> Array:
            if dtype == "float32":
                return jnp.einsum("kbi,kio->kbo", x, weights)
            return jnp.stack(
                [jnp.matmul(a.astype(dtype), w, preferred_element_type=jnp.float32) for a, w in zip(x, weights)]  # noqa: B905
            )

        return jax.lax.fori_loop(0, PRODUCTS, product, x)

    return Work(_timed(lambda: chain(x, weights)), PRODUCTS * MEMBERS * 2.0 * rows * width * width)


@cache
def _task() -> Task:
    return get_task(TASK)


@cache
def _ensemble(width: str) -> Ensemble:
    networks = ensembles.init(jax.random.key(0), MEMBERS, STATE, ACTION, HIDDEN[width])
    return Ensemble(networks, ensembles.normaliser_of(_data(BATCH), 0.1, 0.1))


@cache
def _policy() -> Policy:
    return gaussian.init(jax.random.key(1), STATE, ACTION, (32, 32), 1.0)


@cache
def _data(count: int) -> Transitions:
    rng = np.random.default_rng(0)
    draw = partial(rng.standard_normal, dtype=np.float32)
    return Transitions(draw((count, STATE)), draw((count, ACTION)), 0.01 * draw((count, STATE)), count)


def _starts(count: int) -> np.ndarray:
    return np.asarray(0.1 * _data(BATCH).states[:count])


def operations(width: str) -> float:
    """Of one prediction by one network."""
    sizes = (STATE + ACTION, *HIDDEN[width], STATE)
    return float(sum(2 * i * o for i, o in pairwise(sizes)))


def _fit(width: str, products: str) -> Work:
    """One training step of all members: the second of two blocks of `fit` (the first copies).

    A block is what a run has: five passes and a validation.
    """
    train, validation = _data(FIT_STEPS * BATCH), _data(BATCH)
    passes = FitConfig.validate_every
    config = FitConfig(products=products, batch_size=BATCH, patience=99, max_passes=2 * passes)  # type: ignore[arg-type]
    ensemble = _ensemble(width)

    def steps() -> float:
        stamps: list[float] = []

        def stamp(_: int, losses: Array) -> None:
            losses.block_until_ready()
            stamps.append(time.perf_counter())

        fit(ensemble, train, validation, config, jax.random.key(0), stamp)
        return (stamps[1] - stamps[0]) / (passes * FIT_STEPS)

    steps()
    # Forward, and backward to the weights of every layer and to the inputs of every layer but the first.
    first = 2.0 * (STATE + ACTION) * HIDDEN[width][0]
    of_a_step = MEMBERS * BATCH * (3 * operations(width) - first)
    return Work(steps, of_a_step, _rate(products), MEMBERS * BATCH)


def _rate(products: str) -> str:
    return "products" if products == "float32" else "products-bfloat16"


def _imagine(width: str, products: str) -> Work:
    """50,000 imagined steps: 500 rollouts of 100."""
    ensemble, policy, task = _ensemble(width), _policy(), _task()
    ensemble = ensemble._replace(networks=ensembles.with_products(ensemble.networks, products))
    simulator, mesh = Simulator(ensemble, task.reward, task.terminated, HORIZON), devices.mesh(ROLLOUTS)

    def rollouts(simulator: Simulator, policy: Policy, starts: Array, key: Array) -> Any:
        return imagine(simulator, partial(gaussian.sample, policy), starts, key)

    imagined = Trajectories(SECOND, SECOND, SECOND, SECOND, last=FIRST, going_on=FIRST)
    run = jax.jit(devices.spread(rollouts, mesh, (WHOLE, WHOLE, FIRST, WHOLE), (imagined, WHOLE)))
    given = (*devices.copied((simulator, policy), mesh), _starts(ROLLOUTS), jax.random.key(0))
    steps = ROLLOUTS * HORIZON
    return Work(_timed(lambda: run(*given)), steps * operations(width), _rate(products), steps)


def _trpo(config: TRPOConfig) -> Work:
    """One policy update on 50,000 samples, without the baseline."""
    count = ROLLOUTS * HORIZON
    rng, policy = np.random.default_rng(0), _policy()
    states = rng.standard_normal((count, STATE), dtype=np.float32)
    noise = rng.standard_normal((count, ACTION), dtype=np.float32)
    actions = np.asarray(gaussian.mean(policy, jnp.asarray(states))) + noise
    ones = np.ones(count, np.float32)
    batch = Batch(states, actions, rng.standard_normal(count, dtype=np.float32), ones)
    mesh = devices.mesh(count)

    def update(policy: Policy, batch: Batch) -> Any:
        return trpo.improve(policy, batch, config)

    run = jax.jit(devices.spread(update, mesh, (WHOLE, FIRST), WHOLE))
    policy, batch = devices.copied(policy, mesh), devices.shared(batch, mesh)
    return Work(_timed(lambda: run(policy, batch)), units=count)


def _actor_critic() -> Work:
    """An update of actor, critics and entropy weight, in a block of as many as a run has; the states are given."""
    config = preset(TASK, "fast", "actor-critic")
    settings, task, a = UpdateSettings.of(config), _task(), config.actor_critic
    learner = actor_critic.init(settings, jax.random.key(2), STATE, ACTION, config.policy.hidden)
    learner = learner._replace(scale=ValueScale(*map(jnp.float32, (0.0, 1.0, -100.0, 100.0))))
    models = _ensemble("200x3")
    simulator = Simulator(models, task.reward, task.terminated, a.horizon, trusted=jnp.float32(1e6))
    states, actions, deltas, _ = _data(a.block * a.real_batch)
    shape = a.block, a.real_batch
    real = Steps(
        states.reshape(*shape, STATE),
        actions.reshape(*shape, ACTION),
        actions[:, 0].reshape(shape),
        (states + deltas).reshape(*shape, STATE),
        np.ones(shape, np.float32),
    )
    keys, starts = jax.random.split(jax.random.key(3), a.block), _starts(branches(settings, a.block))
    run = _timed(lambda: run_block(settings, simulator, learner, starts, real, keys))
    return Work(lambda: run() / a.block, units=a.batch_size + a.real_batch)


def _baseline() -> Work:
    """Advantages and the baseline's normal equations for 500 episodes of 100 steps."""
    rng, shape = np.random.default_rng(0), (HORIZON, ROLLOUTS)
    states = rng.standard_normal((*shape, STATE), dtype=np.float32)
    rewards, ones = rng.standard_normal(shape, dtype=np.float32), np.ones(shape, np.float32)
    mesh = devices.mesh(ROLLOUTS)

    def solve(states: Array, rewards: Array, ones: Array, baseline: Array) -> Any:
        t = Trajectories(states, states[..., :ACTION], rewards, ones)
        return linear.advantages_and_value(t, baseline, AdvantageConfig())

    run = jax.jit(devices.spread(solve, mesh, (SECOND, SECOND, SECOND, WHOLE), (SECOND, WHOLE)))
    given = (states, rewards, ones, np.asarray(linear.init(STATE)))
    return Work(_timed(lambda: run(*given)), units=ROLLOUTS * HORIZON)


def _validate(width: str) -> Work:
    """Every model's return of the policy, from as many starts as the preset of that width takes."""
    starts = preset(TASK, "paper" if width == "1024" else "fast").validate.starts
    task, policy = _task(), _policy()
    simulator = Simulator(_ensemble(width), task.reward, task.terminated, task.horizon)
    steps = MEMBERS * starts * HORIZON
    run = _timed(lambda: policy_phase.values_of(simulator, policy, _starts(starts)))
    return Work(run, steps * operations(width), "products", steps)


def _collect() -> Work:
    """3,000 real steps with exploration."""
    policy, config = jax.tree.map(np.asarray, _policy()), CollectConfig()
    steps = config.steps

    def run() -> None:
        mean = partial(gaussian.mean, policy)
        explorer = lambda rng: real.explore(mean, config, rng)  # noqa: E731
        real.collect(_task(), explorer, config.steps, np.random.default_rng(0))

    return Work(_timed(run), units=steps)


def small_iteration() -> Config:
    """The run of which whole iterations are timed: HalfCheetah, `fast`, three iterations."""
    return override(preset(TASK, "fast"), {"iterations": 3})
