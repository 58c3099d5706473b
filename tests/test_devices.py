"""Work shared by several devices is the work of one: run in processes whose CPU is several JAX devices."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from helpers import random_ensemble
from metrpo import devices
from metrpo.model.model_parallel import can_share
from metrpo.run import machine
from places import SUPPORT

PREAMBLE = """
import jax, numpy as np
import jax.numpy as jnp
from functools import partial
from jax.sharding import PartitionSpec as P
from helpers import random_ensemble, random_policy
from metrpo.policy import gaussian
from metrpo import devices
"""

FIT = """
from metrpo.config import FitConfig
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble
from metrpo.model.fit import fit
from metrpo.types import Transitions
rng = np.random.default_rng(0)
states, actions = (rng.normal(size=(300, n)).astype(np.float32) for n in (3, 2))
data = Transitions(states, actions, np.tanh(states) * actions[:, :1], 300)
networks = ensembles.init(jax.random.key(0), 6, 3, 2, (16,))
normaliser = ensembles.normaliser_of(data, 0.1, 0.1)
start = Ensemble(networks, normaliser)
fitted, info = fit(start, data, data, FitConfig(batch_size=32, max_passes=5), jax.random.key(1))
weights = fitted.networks[0][0]
assert weights.sharding.shard_shape(weights.shape)[0] == 6 // len(jax.devices()), "every device has members of its own"
np.savez(OUT, *jax.tree.leaves(fitted), *jax.tree.leaves(info))
"""

IMPROVE = """
from metrpo.config import AdvantageConfig, TRPOConfig
from metrpo.policy.improvers import trpo
from metrpo.policy.value import linear
from metrpo.policy.improvers.batch import Batch
from metrpo.types import Trajectories
rng = np.random.default_rng(0)
policy = random_policy(0, 4, 2, hidden=(8,))
states, actions = (rng.normal(size=(7, 6, n)).astype(np.float32) for n in (4, 2))
rewards, mask = rng.normal(size=(7, 6)).astype(np.float32), (rng.uniform(size=(7, 6)) < 0.8).astype(np.float32)
mesh = devices.mesh(6)
assert mesh.size == len(jax.devices())

def work(policy, baseline, *given):
    t = Trajectories(*given)
    advantages, baseline = linear.advantages_and_value(t, baseline, AdvantageConfig("linear", 0.9, 0.9, 0.1))
    flat = [jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]) for x in (t.states, t.actions, advantages, t.mask)]
    return advantages, baseline, trpo.improve(policy, Batch(*flat), TRPOConfig(damping=0.1))

share = devices.SECOND
shared = jax.jit(devices.spread(work, mesh, (P(), P(), share, share, share, share), (share, P(), P())))
out = shared(policy, linear.init(4), states, actions, rewards, mask)
assert out[2][1].accepted
np.savez(OUT, *jax.tree.leaves(out))
"""

IMAGINE = """
from metrpo.model.imagine import Simulator, imagine
from metrpo.types import Trajectories
ensemble = random_ensemble(members=3, scale=0.3)
starts = np.random.default_rng(1).normal(size=(6, 4)).astype(np.float32)
mesh = devices.mesh(6)

def work(starts):
    act = lambda states, key: jnp.zeros((len(states), 2)) + jax.random.normal(key, (len(states), 2))
    return imagine(Simulator(ensemble, lambda s, a, n: n[:, 0], None, 5), act, starts, jax.random.key(0))

second, first = devices.SECOND, devices.FIRST
share = Trajectories(second, second, second, second, last=first, going_on=first)
t, info = jax.jit(devices.spread(work, mesh, first, (share, P())))(starts)
np.testing.assert_array_equal(t.states[0], starts)
np.testing.assert_allclose(info.mean_return, np.sum(t.rewards) / 6, rtol=1e-5)
assert (float(info.diverged), float(info.steps)) == (0, 30)
noise = np.asarray(t.actions).reshape(-1)
assert len(set(noise.tolist())) == noise.size, "two devices drew the same noise"
np.savez(OUT, np.zeros(1))
"""

WIDE = """
from jax.sharding import Mesh
from metrpo.history import History
from metrpo.model import imagine as module
from metrpo.model.ensemble import Activation, Carried, Ensemble
from metrpo.types import Trajectories
module.CORE_CACHE = 100  # bytes; the largest layer has more
policy = random_policy(0, 4, 2, hidden=(8,))
starts = np.random.default_rng(1).normal(size=(24, 4)).astype(np.float32)
second, first = devices.SECOND, devices.FIRST
share = Trajectories(second, second, second, second, last=first, going_on=first)
divide, divided = module.shared, []
module.shared = lambda ensemble: divided.append(1) or divide(ensemble)

def found(ensemble, count, few, sampling, curiosity):
    module.FEW_ROWS = few

    def work(policy, starts):
        def total(policy):
            act = lambda states, key: gaussian.sample(policy, states, key)
            reward = lambda s, a, n: n[:, 0] - a[:, 1]
            simulator = module.Simulator(ensemble, reward, lambda n: n[:, 0] > 0.5, 5, sampling, curiosity)
            t, info = module.imagine(simulator, act, starts, jax.random.key(0))
            return jnp.sum(t.rewards * t.mask), (t, info)

        gradient, out = jax.grad(total, has_aux=True)(policy)
        return *out, devices.across(gradient)

    mesh = Mesh(np.array(jax.devices()[:count]), (devices.AXIS,))
    out = jax.jit(devices.spread(work, mesh, (P(), first), (share, P(), P())))(policy, starts)
    assert 0 < float(out[1].steps) < 120, "some rollouts ended"
    return jax.device_get(out)

def of_one_observation(ensemble):
    # A state of 4 is two observations of a number and the two actions between them.
    (*inner, (weights, biases)), n = ensemble.networks, ensemble.normaliser
    n = n._replace(delta_mean=n.delta_mean[:1], delta_std=n.delta_std[:1])
    return Ensemble((*inner, (weights[..., :1], biases[..., :1])), n, Carried(History(2, 1, 2).carried))

def probabilistic(ensemble):
    *inner, (weights, biases) = ensemble.networks
    spread = (0.1 * weights, biases - 2.0)
    doubled = tuple(np.concatenate(pair, axis=-1) for pair in zip((weights, biases), spread, strict=True))
    return ensemble._replace(networks=(*inner, doubled))

for members, count, hidden, sampling, curiosity in CASES:
    ensemble = random_ensemble(members=members, scale=0.3, hidden=hidden)
    if curiosity == "history":
        ensemble, curiosity = of_one_observation(ensemble), 0.0
    if curiosity == "noise":
        ensemble, curiosity = probabilistic(ensemble), 0.0
    if curiosity == "silu":
        ensemble, curiosity = ensemble._replace(activation=Activation("silu")), 0.0
    rows = 24 // count // members  # for each model, on a device with models of its own
    apart = found(ensemble, count, rows, sampling, curiosity)
    assert not divided
    together = found(ensemble, count, rows + 1, sampling, curiosity)
    assert divided
    divided.clear()
    for ours, theirs in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)
np.savez(OUT, np.zeros(1))
"""
"""Rollouts and the gradient of their return, with models too wide for one core: where it has few rows for each, devices
share the models, and find what they do with all models each."""

SLEEP = """
import time

def work(x):
    def slowly(x):
        time.sleep(65)
        return np.asarray(x)

    first = jax.lax.axis_index(devices.AXIS) == 0
    slow = jax.lax.cond(first, lambda x: jax.pure_callback(slowly, x, x), lambda x: x, x)
    return devices.across(slow)

mesh = devices.mesh(2)
x = jnp.arange(2.0)
out = jax.jit(devices.spread(work, mesh, devices.FIRST, P()))(x)
np.savez(OUT, out)
"""


def results(code: str, count: int, out: Path, *more: str) -> list:
    """What `code` saves to OUT in a process with `count` CPU devices."""
    flags = [os.environ.get("XLA_FLAGS", ""), f"--xla_force_host_platform_device_count={count}", *more]
    tests = os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu", "PYTHONPATH": tests}
    program = PREAMBLE + f"assert len(jax.devices()) == {count}\nOUT = {str(out)!r}\n" + code
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    with np.load(out) as file:
        return [file[name] for name in file.files]


@pytest.mark.parametrize(("code", "atol"), [(FIT, 1e-5), (IMPROVE, 1e-4)], ids=["fit", "improve"])
def test_several_devices_find_what_one_finds(code, atol, tmp_path):
    one, several = (results(code, n, tmp_path / f"{n}.npz") for n in (1, 3))
    assert len(one) == len(several)
    for ours, theirs in zip(several, one, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=atol, rtol=1e-4)


def test_each_device_imagines_rollouts_of_its_own(tmp_path):
    results(IMAGINE, 3, tmp_path / "out.npz")


MANY = [
    (3, 2, (16,), "step_rand", "history"),
    (3, 4, (16,), "step_rand", 0.0),  # all three cut in four
    (4, 2, (16,), "eps_rand", 0.0),  # two each
    (3, 2, (16, 16), "step_rand", 0.0),  # one each, and one cut in two
    (3, 4, (16,), "step_rand", "silu"),
]
FEW = [
    (5, 4, (16, 8, 8, 16), "step_rand", 0.1),
    (3, 2, (16,), "step_rand", "noise"),
]


@pytest.mark.parametrize("cases", [FEW, pytest.param(MANY, marks=pytest.mark.slow)], ids=["few", "many"])
def test_cores_with_few_rows_share_wide_models(cases, tmp_path):
    results(f"CASES = {cases}\n{WIDE}", 4, tmp_path / "out.npz")


def test_models_are_shared_where_their_units_can_be_divided():
    cases = {((16, 16), 2): True, ((16, 15), 2): False, ((15, 16), 2): False, ((16,), 4): True, ((), 2): False}
    for (hidden, count), expected in cases.items():
        assert can_share(random_ensemble(members=3, hidden=hidden).networks, count) == expected, (hidden, count)


@pytest.mark.slow
def test_a_device_may_wait_for_another_for_long(tmp_path):
    """By itself XLA aborts the process after a minute."""
    (found,) = results(SLEEP, 2, tmp_path / "out.npz", *machine.PATIENT)
    np.testing.assert_array_equal(found, [1])


@pytest.mark.parametrize(("count", "available", "size"), [(500, 2, 2), (50, 4, 2), (7, 4, 1), (5, 8, 5), (1, 3, 1)])
def test_as_many_devices_as_divide_the_work(count, available, size, monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: [f"device {i}" for i in range(available)])
    monkeypatch.setattr(devices, "Mesh", lambda chosen, axes: (list(chosen), axes))
    chosen, axes = devices.mesh(count)
    assert chosen == [f"device {i}" for i in range(size)]
    assert axes == (devices.AXIS,)
