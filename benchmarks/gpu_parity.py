"""Parity of fit, imagination and TRPO between a GPU and the CPU; a part of `benchmarks/gpu_check.py`.

Both get the same seeds and inputs, made by NumPy. The distance of two results is |a - b| / |b|, b being the CPU's.
A tolerance is ten times the distance by which the CPU's own result moves when every input is changed by one rounding
of float32 (2^-23 of itself): a GPU adds the same terms in another order, which is a change of that kind at every
product. It is at least 1e-5 and never above `CEILING`, so that what amplifies rounding cannot hide a fault. Products
in TF32 (10 bits instead of 23) move results about a thousand times as far as float32 does, beyond these tolerances.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from metrpo import get_task, policy_phase
from metrpo.config import FitConfig, TRPOConfig
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Ensemble
from metrpo.model.epochs import validation_loss
from metrpo.model.fit import fit
from metrpo.model.imagine import Simulator, imagine
from metrpo.policy import gaussian
from metrpo.policy.improvers import trpo
from metrpo.policy.improvers.batch import Batch
from metrpo.types import Transitions

FACTOR, LEAST, CEILING = 10.0, 1e-5, 2e-2
ROUNDING = 2.0**-23
Results = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is computed."""

    hidden: tuple[int, ...] = (1024, 1024)
    members: int = 5
    data: int = 5000
    batch: int = 1000
    rollouts: int = 500
    samples: int = 50_000


TINY = Size(hidden=(16,), members=2, data=200, batch=40, rollouts=20, samples=200)


def results(size: Size, nudge: float) -> Results:
    """What fit, imagination and TRPO make of inputs that are changed by at most `nudge` of themselves."""
    rng, signs = np.random.default_rng(0), np.random.default_rng(1)
    task = get_task("HalfCheetah")
    s, a = task.state_size, task.action_size

    def nudged(x: Any) -> Any:
        return jax.tree.map(lambda v: v * (1 + nudge * signs.choice([-1, 1], v.shape)).astype(np.float32), x)

    def draw(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape, dtype=np.float32)

    def layers(sizes: tuple[int, ...], *lead: int, flat: bool = False) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        pairs = pairwise(sizes)
        biases = lambda o: np.zeros((*lead, o) if flat else (*lead, 1, o), np.float32)  # noqa: E731
        return tuple((draw(*lead, i, o) / np.float32(np.sqrt(i)), biases(o)) for i, o in pairs)

    states, actions = draw(size.data, s), draw(size.data, a)
    deltas = 0.05 * np.tanh(states @ draw(s, s) + actions @ draw(a, s))
    train = Transitions(*nudged((states, actions, deltas)), size.data)
    networks = nudged(layers((s + a, *size.hidden, s), size.members))
    policy = gaussian.Policy(nudged(layers((s, 32, 32, a), flat=True)), np.zeros(a, np.float32))
    samples = draw(size.samples, s)
    noise, advantages = draw(size.samples, a), draw(size.samples)
    batch = Batch(
        nudged(samples),
        gaussian.mean(policy, samples) + noise,
        nudged(advantages + noise[:, 0]),
        np.ones(size.samples, np.float32),
    )
    ensemble = Ensemble(networks, ensembles.normaliser_of(train, 0.1, 1e-4))
    found = _fit(size, ensemble, train) | _trpo(policy, batch)
    return found | _imagine(task, ensemble, policy, nudged(0.1 * states[: size.rollouts]))


def _fit(size: Size, ensemble: Ensemble, train: Transitions) -> Results:
    config = FitConfig(batch_size=size.batch, max_passes=5, patience=99)
    data = jax.device_put(train)
    fitted, info = fit(ensemble, data, data, config, jax.random.key(0))
    change = jax.tree.map(lambda new, old: np.asarray(new) - old, fitted.networks, ensemble.networks)
    return {
        "fit: loss before": np.asarray(validation_loss(ensemble, data)),
        "fit: loss after 25 steps": np.asarray(info.validation_loss),
        "fit: change of the weights": np.asarray(ravel_pytree(change)[0]),
    }


def _imagine(task: Any, ensemble: Ensemble, policy: gaussian.Policy, starts: np.ndarray) -> Results:
    simulator = Simulator(ensemble, task.reward, task.terminated, task.horizon)

    def rollouts(simulator: Simulator, policy: gaussian.Policy, starts: np.ndarray, key: Any) -> Any:
        return imagine(simulator, partial(gaussian.sample, policy), starts, key)

    trajectories, _ = jax.jit(rollouts)(simulator, policy, starts, jax.random.key(1))
    values = policy_phase.values_of(simulator, policy, starts)
    states = np.asarray(trajectories.states)
    # Changes of state, for the states themselves would hide small ones.
    moved = states - starts
    return {f"imagine: states after {t} steps": moved[t] for t in (1, 10, 99)} | {
        "imagine: returns": np.asarray(trajectories.rewards).sum(0),
        "validate: returns in each model": values,
    }


def _trpo(policy: gaussian.Policy, batch: Batch) -> Results:
    new, info = jax.jit(partial(trpo.improve, config=TRPOConfig()))(policy, batch)
    step = jax.tree.map(lambda after, before: np.asarray(after) - before, new, policy)
    return {
        "trpo: step": np.asarray(ravel_pytree(step)[0]),
        "trpo: KL": np.asarray(info.kl),
        "trpo: improvement": np.asarray(info.improvement),
        # Not compared: how much of the equations is left unsolved. It must be as small as on the CPU.
        "cg residual": np.asarray(info.cg_residual),
    }


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """|a - b| / |b|; infinite where a holds what is not finite."""
    if not np.isfinite(a).all():
        return float("inf")
    return float(np.linalg.norm(np.float64(a) - b) / max(np.linalg.norm(np.float64(b)), 1e-30))


def table(found: Results, plain: Results, moved: Results) -> dict[str, dict[str, Any]]:
    """For every result: its distance from the CPU's (`plain`), the tolerance (from `moved`), and whether it holds."""
    rows: dict[str, dict[str, Any]] = {}
    for name in plain:
        if name == "cg residual":
            continue
        tolerance = min(max(FACTOR * distance(moved[name], plain[name]), LEAST), CEILING)
        apart = distance(found[name], plain[name])
        rows[name] = {"distance": apart, "tolerance": tolerance, "holds": apart <= tolerance}
    return rows


def reference(size: Size, out: Path) -> None:
    """Writes the CPU's results, as they are and with nudged inputs. For a process whose only device is one CPU."""
    kinds = {"plain": results(size, 0.0), "moved": results(size, ROUNDING)}
    np.savez(out, **{f"{kind}/{name}": x for kind, values in kinds.items() for name, x in values.items()})


def start_reference(script: Path, out: Path, tiny: bool) -> subprocess.Popen[bytes]:
    """Starts `reference` in a process of its own, for which the CPU is JAX's only device."""
    command = [sys.executable, str(script), "--part", "reference", "--out", str(out), *(["--tiny"] if tiny else [])]
    return subprocess.Popen(command)


def parity(size: Size, waiting: subprocess.Popen[bytes], out: Path, save: Callable[[dict[str, Any]], None]) -> None:
    """Compares this process's device with the CPU: in the precision that metrpo sets, and in TF32 to see it differ."""
    record: dict[str, Any] = {"tolerance": (__doc__ or "").split("\n\n", 1)[1].strip()}
    computed = {}
    for name, precision in (("as metrpo sets it", None), ("tensorfloat32", "tensorfloat32")):
        with jax.default_matmul_precision(precision) if precision else nullcontext():
            computed[name] = results(size, 0.0)
        print(f"parity: computed, precision {name}", flush=True)
    if waiting.wait() != 0:
        raise RuntimeError("the CPU's results were not computed")
    with np.load(out) as stored:
        plain, moved = (
            {key.split("/", 1)[1]: stored[key] for key in stored.files if key.startswith(kind)}
            for kind in ("plain", "moved")
        )
    for name, values in computed.items():
        record[name] = table(values, plain, moved)
        record[name]["cg residual"] = {"here": float(values["cg residual"]), "cpu": float(plain["cg residual"])}
    record["all hold"] = all(row.get("holds", True) for row in record["as metrpo sets it"].values())
    save(record)
    for name in computed:
        for what, row in record[name].items():
            print(f"parity, {name}: {what}: {row}", flush=True)
