"""No random key is used twice: every draw of a whole run is traced, down to those inside compiled code."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

import metrpo
import probe
from metrpo import algorithm, seeds, training
from metrpo.config import Config
from metrpo.presets import override
from metrpo.stages import actor_critic_search, ensemble_fit, policy_search, real_steps, records

TINY = override(
    Config(task="Probe", iterations=2, evaluation_episodes=2),
    {
        "collect.steps": 40,
        "ensemble.members": 2,
        "ensemble.hidden": (4,),
        "fit.batch_size": 20,
        "fit.max_passes": 4,
        "imagine.steps": 60,
        "policy.hidden": (4,),
        "validate.max_updates": 4,
        "validate.every": 2,
        "validate.starts": 4,
        "advantage.value_steps": 5,
    },
)
BRIEFLY = {
    "actor_critic.batch_size": 4,
    "actor_critic.block": 2,
    "actor_critic.critic_hidden": (4,),
    "actor_critic.random_steps": 40,
    "actor_critic.updates_per_step": 0.1,
}
DRAWS = ("normal", "uniform", "randint", "permutation")
"""All that the package draws with; `test_nothing_else_draws` sees to that."""


class Trace:
    """How often each key, known by its bits, was drawn with, split and folded."""

    def __init__(self):
        self.drawn, self.split, self.folded = Counter(), Counter(), Counter()

    def twice(self):
        """Keys that were drawn with or split more than once, or drawn with and made others from.

        Two names of one key, or one key made twice, come out here wherever both are used.
        """
        again = [key for counter in (self.drawn, self.split) for key, n in counter.items() if n > 1]
        return again + [key for key in self.drawn if key in self.split or key in self.folded]


def traced(monkeypatch):
    trace = Trace()

    def note(counter, keys):
        def write(bits):
            counter.update(tuple(pair) for pair in np.asarray(bits).reshape(-1, 2).tolist())

        jax.debug.callback(write, jax.random.key_data(keys))

    def drawing(original):
        def draw(key, *args, **kwargs):
            note(trace.drawn, key)
            return original(key, *args, **kwargs)

        return draw

    for name in DRAWS:
        monkeypatch.setattr(jax.random, name, drawing(getattr(jax.random, name)))
    split, fold_in = jax.random.split, jax.random.fold_in

    def splitting(key, num=2):
        note(trace.split, key)
        return split(key, num)

    def folding(key, data):
        note(trace.folded, key)
        return fold_in(key, data)

    monkeypatch.setattr(jax.random, "split", splitting)
    monkeypatch.setattr(jax.random, "fold_in", folding)
    return trace


@pytest.fixture(autouse=True)
def _compiled_anew():
    # What was compiled without the trace has none, and what is compiled with it must not stay.
    jax.clear_caches()
    with probe.registered():
        yield
    jax.clear_caches()


@pytest.mark.parametrize(
    "options",
    [
        {"learn_reward": True, "imagine.horizon": 7, "advantage.baseline": "network", "advantage.discount": 0.9},
        {"imagine.sampling": "model_mean_std", "improver": "ppo"},
        {"improver": "actor-critic", "advantage.discount": 0.9, **BRIEFLY},
    ],
    ids=lambda options: ", ".join(map(str, options.values())),
)
def test_nothing_random_is_used_twice(options, monkeypatch):
    """No key and no generator, in two iterations. (`eps_rand` would: the same draw in every step is what it is.)"""
    trace, made = traced(monkeypatch), Counter()

    def noted(original):
        def make(*args):
            made[(original.__name__, *args)] += 1
            return original(*args)

        return make

    stages = (algorithm, actor_critic_search, ensemble_fit, policy_search, real_steps, records)
    for name in ("rng_of", "key_of"):
        for module in stages:
            if hasattr(module, name):
                monkeypatch.setattr(module, name, noted(getattr(seeds, name)))
    config = override(TINY, options)
    state = training.init(config)
    for _ in range(config.iterations):
        state, _ = training.step(config, state)
    jax.effects_barrier()
    assert len(trace.drawn) > 50
    assert trace.twice() == []
    assert len(made) > 10
    assert {key: n for key, n in made.items() if n > 1} == {}


def test_the_trace_sees_a_key_used_twice(monkeypatch):
    trace = traced(monkeypatch)

    @jax.jit
    def careless(key):
        draw = jax.vmap(lambda k: jax.random.normal(k))(jax.random.split(key, 3))
        return draw.sum() + jax.random.uniform(key)

    careless(jax.random.key(0)).block_until_ready()
    jax.effects_barrier()
    assert len(trace.drawn) == 4
    assert trace.twice() == [tuple(jax.random.key_data(jax.random.key(0)).tolist())]


def test_nothing_else_draws():
    source = Path(metrpo.__file__).parent
    used = {
        name
        for path in source.rglob("*.py")
        for name in re.findall(r"jax\.random\.(\w+)", path.read_text())
        if "bench" not in path.parts
    }
    assert used <= {*DRAWS, "key", "split", "fold_in", "key_data"}


def test_no_two_generators_of_a_run_are_the_same():
    """Neither another stage, nor another iteration, episode or seed, comes out as the same numbers."""
    draws = {
        tuple(seeds.rng_of(seed, iteration, stage, number).integers(2**63, size=2).tolist())
        for seed in range(4)
        for iteration in range(4)
        for stage in seeds.Stage
        for number in range(4)
    }
    assert len(draws) == 4 * 4 * len(seeds.Stage) * 4
    keys = {
        tuple(jax.random.key_data(seeds.key_of(seed, iteration, stage)).tolist())
        for seed in range(3)
        for iteration in range(3)
        for stage in seeds.Stage
    }
    assert len(keys) == 3 * 3 * len(seeds.Stage)
