"""How far the models can be trusted: their errors over several steps, and where imagination leaves the data.

A record only, nothing is learned from it: one row of numbers after every policy phase, for the report and for a person
who asks why a run does not learn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from metrpo.model.ensemble import Ensemble, predict
from metrpo.model.imagine import EXPLODED, disagreement
from metrpo.model.sampling import Keys, step_rand
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.types import Array, Transitions

HORIZONS = (1, 5, 10, 25)
"""Steps after which predictions are compared with what happened; an imagined episode's end comes as the last."""
_STARTS = 100
_LONGEST = 200
"""Imagined and predicted steps at most, for tasks of a thousand: an error long before that is error enough."""


class Diagnosis(NamedTuple):
    """What the models are worth on real episodes that they were not trained on, and in imagination."""

    errors: dict[int, Float[np.ndarray, "O"]]
    """After k steps, of each number observed: root mean square error of the open-loop prediction over that of
    predicting no change, each member by itself; 1 is no better than that, NaN where no held-out episode is so long."""
    disagreement_real: float
    """Mean spread of the members' predictions on held-out transitions (`imagine.disagreement`)."""
    disagreement_imagined: float
    """The same along imagined episodes of the policy: far above the real one, it has gone where the models guess."""
    outside: float
    """Share of these imagined observations that leave the range of the training data in any dimension."""
    saturated: float
    """Share of the policy's mean actions there that lie beyond [-1, 1], to which they are clipped."""

    def row(self) -> dict[str, float]:
        """As columns: `error_K` (median over the dimensions), `error_K_D` for each dimension, and the rest.

        The last K, an imagined episode's end, is called T, whatever its number, so that tasks share their columns.
        """
        names = {k: "T" if k == max(self.errors) else str(k) for k in self.errors}
        overall = {f"error_{names[k]}": _median(e) for k, e in self.errors.items()}
        each = {f"error_{names[k]}_{d}": float(x) for k, e in self.errors.items() for d, x in enumerate(e)}
        rest = {name: float(getattr(self, name)) for name in self._fields[1:]}
        return overall | rest | each


def unknown(observation_size: int, horizon: int) -> Diagnosis:
    """A diagnosis that could not be made, of NaN; its columns are those of one that was."""
    errors = {k: np.full(observation_size, np.nan) for k in _steps(horizon)}
    return Diagnosis(errors, **dict.fromkeys(Diagnosis._fields[1:], math.nan))


def _steps(horizon: int) -> list[int]:
    length = min(horizon, _LONGEST)
    return [k for k in HORIZONS if k < length] + [length]


def diagnose(
    ensemble: Ensemble, policy: Policy, held_out: Transitions, train: Transitions, horizon: int, key: Key[Array, ""]
) -> Diagnosis:
    """A diagnosis of the fitted `ensemble` and the accepted `policy`.

    `held_out` and `train` are host arrays, whole episodes one after the other; imagined episodes of `horizon` steps
    (at most 200) start in held-out states.
    """
    length = min(horizon, _LONGEST)
    size = train.states.shape[1] - len(ensemble.carried.indices)
    rows, steps = _starts(held_out, size, length)
    actions = np.asarray(held_out.actions)[np.minimum(rows[:, None] + np.arange(length), len(held_out.actions) - 1)]
    starts = np.asarray(held_out.states)[rows]
    # From the host: where arrays lie is no reason to compile anew.
    on_host = jax.device_get((ensemble, policy))
    predicted, spread, imagined, guessed, beyond = jax.device_get(_rollouts(*on_host, starts, actions, key))
    after = _observed(held_out, size)[1]
    errors = {}
    for k in _steps(horizon):
        there = steps >= k
        ends = after[np.minimum(rows + k - 1, len(after) - 1)][there]
        errors[k] = _relative(predicted[k - 1][:, there, :size], starts[there, :size], ends)
    seen, imagined = train.states[:, :size], imagined[..., :size]
    outside = ~np.all((imagined >= seen.min(0)) & (imagined <= seen.max(0)), axis=-1)  # also where it is no number
    return Diagnosis(errors, float(spread.mean()), float(guessed.mean()), float(outside.mean()), float(beyond.mean()))


def _observed(t: Transitions, size: int) -> tuple[Float[np.ndarray, "n {size}"], Float[np.ndarray, "n {size}"]]:
    """The observations, of so many numbers, before and after each transition."""
    now = np.asarray(t.states)[:, :size]
    return now, now + np.asarray(t.deltas)[:, :size]


def _starts(t: Transitions, size: int, length: int) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Rows to start from, and how many steps of the same episode follow each; observations are of `size` numbers."""
    states, after = _observed(t, size)
    scale = np.abs(states).max(0) + 1e-6
    goes_on = np.all(np.abs(after[:-1] - states[1:]) <= 1e-5 * scale, axis=1)
    firsts = np.concatenate([[0], np.flatnonzero(~goes_on) + 1])
    lengths = np.diff([*firsts, len(states)])
    follow = np.concatenate([np.arange(n, 0, -1) for n in lengths])
    # Half of them where an episode begins, for whole episodes; half evenly over all.
    chosen = np.concatenate([np.resize(firsts[::-1], _STARTS // 2), _evenly(len(states), _STARTS - _STARTS // 2)])
    return chosen, np.minimum(follow[chosen], length)


def _evenly(count: int, number: int) -> Int[np.ndarray, "number"]:
    return np.linspace(0, count - 1, number).astype(int)


def _relative(
    predicted: Float[np.ndarray, "K n S"], starts: Float[np.ndarray, "n S"], ends: Float[np.ndarray, "n S"]
) -> Float[np.ndarray, "S"]:
    """Root mean square error, over that of predicting no change."""
    if not len(ends):
        return np.full(starts.shape[1], np.nan)
    clipped = np.clip(np.nan_to_num(predicted.astype(np.float64), nan=EXPLODED), -EXPLODED, EXPLODED)
    error = np.sqrt(np.mean((clipped - ends) ** 2, axis=(0, 1)))
    still = np.sqrt(np.mean((starts.astype(np.float64) - ends) ** 2, axis=0))
    return np.where(still > 0, error / np.where(still > 0, still, 1.0), np.nan)


def _median(values: Sequence[float] | Float[np.ndarray, "S"]) -> float:
    finite = np.asarray(values)[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


@jax.jit
def _rollouts(
    ensemble: Ensemble,
    policy: Policy,
    starts: Float[Array, "N S"],
    actions: Float[Array, "N L A"],
    key: Key[Array, ""],
) -> tuple[
    Float[Array, "L K N S"], Float[Array, "N"], Float[Array, "L N S"], Float[Array, "L N"], Bool[Array, "L N A"]
]:
    """Every member's open-loop predictions, the spread on the starts; and of the policy's imagined episodes the states,
    the members' spread along them and which mean actions saturate."""
    size = starts.shape[-1]
    members = ensemble.members

    def open_loop(
        states: Float[Array, "K N S"], action: Float[Array, "N A"]
    ) -> tuple[Float[Array, "K N S"], Float[Array, "K N S"]]:
        following = predict(ensemble, states, jnp.broadcast_to(action, (members, *action.shape)))[..., :size]
        return following, following

    def imagined(
        states: Float[Array, "N S"], key: Key[Array, ""]
    ) -> tuple[Float[Array, "N S"], tuple[Float[Array, "N S"], Float[Array, "N"], Bool[Array, "N A"]]]:
        drawn = gaussian.mean(policy, states)
        mean = jnp.clip(drawn, -1.0, 1.0)
        spread = disagreement(ensemble, states, mean)
        following = step_rand(ensemble, states, mean, Keys(key, key))[..., :size]
        return jnp.clip(following, -EXPLODED, EXPLODED), (following, spread, jnp.abs(drawn) > 1)

    length = actions.shape[1]
    copies = jnp.broadcast_to(starts, (members, *starts.shape))
    _, predicted = jax.lax.scan(open_loop, copies, jnp.swapaxes(jnp.asarray(actions), 0, 1))
    _, (dreamt, spread, beyond) = jax.lax.scan(imagined, jnp.asarray(starts), jax.random.split(key, length))
    return predicted, disagreement(ensemble, jnp.asarray(starts), jnp.asarray(actions)[:, 0]), dreamt, spread, beyond
