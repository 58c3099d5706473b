"""Rollouts through the ensemble: the simulator in which the policy learns (paper, section 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Key

from metrpo.devices import across, is_spread, share_of, sharers
from metrpo.limits import NONE, Limits
from metrpo.model.bounds import Bounds, bounded
from metrpo.model.ensemble import Ensemble, Predictor, predict, predict_delta
from metrpo.model.model_parallel import can_share, shared
from metrpo.model.sampling import SAMPLINGS, Keys, for_all
from metrpo.policy.inputs import Inputs
from metrpo.types import Array, Number, SampleActions, Trajectories

RewardFn = Callable[
    [Float[Array, "*batch S"], Float[Array, "*batch A"], Float[Array, "*batch S"]], Float[Array, "*batch"]
]
TerminationFn = Callable[[Float[Array, "*batch S"]], Bool[Array, "*batch"]] | Literal["learned"]

EXPLODED = 1e6
"""A rollout with a state beyond this, or a reward beyond its square, has diverged, as has one that meets NaN."""

CORE_CACHE, FEW_ROWS = 2**21, 100
"""Where a layer has as many bytes of weights as the first, and a core fewer rows for each model than the second, one
core alone reads more than it computes: the cores of a CPU then share the models instead of the rollouts
(docs/performance.md, "Models shared by the cores")."""


_Going = tuple[Float[Array, "N S"], Float[Array, "N"], Bool[Array, "N"], Bool[Array, "N"], Float[Array, "N A"] | None]
"""Of imagined episodes: states, 1 where they go on, which have diverged, for which the models are trusted, and the last
actions, where they matter."""
_Valued = tuple[Float[Array, "K N S"], Float[Array, "K N"], Float[Array, "K N"], Float[Array, "K N A"] | None]
"""Of episodes in each model: states, 1 where they go on, the return so far, and the last actions, where they matter."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Simulator:
    """The learned environment in which a policy acts: the models, and how they are used.

    A pytree; its static fields decide compiled code.
    """

    ensemble: Ensemble
    reward: RewardFn | None = field(metadata={"static": True})
    """None: learned."""
    terminated: TerminationFn | None = field(metadata={"static": True})
    horizon: int = field(metadata={"static": True})
    """Steps of an episode."""
    sampling: str = field(default="step_rand", metadata={"static": True})
    disagreement: float = field(default=0.0, metadata={"static": True})
    """Rewards hold this times the models' disagreement."""
    cut: bool = field(default=False, metadata={"static": True})
    """Whether its episodes end before the task's do, and are valued there."""
    inputs: Inputs | None = None
    """How the policy sees the states; None: as they are."""
    limits: Limits = field(default=NONE, metadata={"static": True})
    """What its actions are held to."""
    bounds: Bounds | None = None
    """What predictions are brought within; None: anything goes."""
    trusted: Float[Array, ""] | None = None
    """Episodes stand still from the first step on in which the models disagree by more than this; None: never."""

    def nothing_before(self, *rows: int) -> Array | None:
        """The actions before the first step, [*rows, A]; None where they do not matter."""
        size = self.ensemble.normaliser.action_mean.shape[-1]
        return None if self.limits.max_change is None else jnp.zeros((*rows, size))


class ImagineInfo(NamedTuple):
    """What a batch of imagined rollouts looked like."""

    mean_return: Float[Array, ""]
    """Undiscounted, over the rollouts that did not diverge."""
    diverged: Float[Array, ""]
    """Share of the rollouts that exploded or met NaN; they are masked out whole."""
    steps: Float[Array, ""]
    """Steps that count."""


def outcome(
    reward: RewardFn | None,
    terminated: TerminationFn | None,
    states: Float[Array, "*batch S"],
    actions: Float[Array, "*batch A"],
    predicted: Float[Array, "*batch D"],
) -> tuple[Float[Array, "*batch S"], Float[Array, "*batch"], Bool[Array, "*batch"] | None]:
    """Next states, rewards and ends (None: never) out of predictions.

    A reward of None is the learned one; a learned end is predicted as its probability, and comes at one half.
    """
    size = states.shape[-1]
    following = predicted[..., :size]
    rewards = predicted[..., size] if reward is None else reward(states, actions, following)
    if terminated == "learned":
        return following, rewards, predicted[..., -1] > 0.5
    return following, rewards, None if terminated is None else terminated(following)


def disagreement(ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"]) -> Float[Array, "N"]:
    """How far the models' predictions spread: their standard deviation, in units of each dimension's std in the data,
    mean over the dimensions (the paper's section "Discussion": a reason to explore)."""
    deltas = predict_delta(ensemble, *(for_all(ensemble, x) for x in (states, actions)))
    deltas = deltas / ensemble.normaliser.delta_std
    return jnp.mean(jnp.std(deltas, axis=0), axis=-1)


def imagine(
    simulator: Simulator, act: SampleActions, starts: Float[Array, "N S"], key: Key[Array, ""]
) -> tuple[Trajectories, ImagineInfo]:
    """Imagined episodes from `starts`, in which `act` sees the states as they are.

    Actions are held to the limits, [-1, 1] or less, for dynamics and reward, and recorded as drawn. Where devices share
    the batch (`devices.spread`), the trajectories are this device's, and the info is about all. A CPU's devices share
    the models too, where these are too wide for a core.
    """
    rows, horizon, bonus = starts.shape[0], simulator.horizon, simulator.disagreement
    sampling = SAMPLINGS[simulator.sampling]
    models: Predictor = simulator.ensemble
    if is_spread() and sampling.of_drawn_models and _shares_models(simulator.ensemble, rows):
        models = shared(simulator.ensemble)
    key = share_of(key)
    episode_key = jax.random.fold_in(key, horizon)

    def step(carry: _Going, key: Key[Array, ""]) -> tuple[_Going, Trajectories]:
        states, alive, diverged, trusted, before = carry
        action_key, model_key, noise_key = jax.random.split(key, 3)
        acted = act(states, action_key)
        actions, noted = acted if isinstance(acted, tuple) else (acted, None)
        clipped = simulator.limits.within(actions, before)
        predicted = sampling.draw(models, states, clipped, Keys(model_key, episode_key, noise_key))
        if simulator.bounds is not None:
            predicted = bounded(simulator.bounds, states, predicted)
        following, rewards, ended = outcome(simulator.reward, simulator.terminated, states, clipped, predicted)
        if bonus:
            rewards = rewards + bonus * disagreement(models, states, clipped)
        if simulator.trusted is not None:
            apart = disagreement(models, *jax.lax.stop_gradient((states, clipped)))
            trusted = trusted & (apart <= simulator.trusted)
        bad = ~_sound(following, rewards) & trusted
        recorded = Trajectories(states, actions, jnp.where(bad, 0.0, rewards), alive, noted=noted)
        if simulator.trusted is not None:
            recorded = recorded._replace(trusted=jnp.float32(trusted))
        diverged = diverged | (bad & (alive > 0))
        if ended is not None:
            alive = alive * (1.0 - ended * trusted)
        # A diverged rollout stands still, so that it stays finite; it is masked below.
        following = jnp.where((bad | ~trusted)[:, None], states, following)
        return (following, alive, diverged, trusted, None if before is None else clipped), recorded

    carry = (starts, jnp.ones(rows), jnp.zeros(rows, bool), jnp.ones(rows, bool), simulator.nothing_before(rows))
    (last, alive, diverged, _, _), trajectories = jax.lax.scan(step, carry, jax.random.split(key, horizon))
    mask = trajectories.mask * (1.0 - diverged)
    counts = mask if trajectories.trusted is None else mask * trajectories.trusted
    total, lost, rollouts, steps = across(
        (jnp.sum(trajectories.rewards * counts), jnp.sum(diverged), jnp.float32(rows), jnp.sum(counts))
    )
    info = ImagineInfo(total / jnp.maximum(rollouts - lost, 1), lost / rollouts, steps)
    return trajectories._replace(mask=mask, last=last, going_on=alive * (1.0 - diverged)), info


def _shares_models(ensemble: Ensemble, rows: int) -> bool:
    """Whether cores of a CPU with `rows` rollouts each do better to share the models (`CORE_CACHE`)."""
    if jax.default_backend() != "cpu":
        return False
    largest = max(weights[0].nbytes for weights, _ in ensemble.networks)
    few = rows < FEW_ROWS * ensemble.members
    return largest >= CORE_CACHE and few and can_share(ensemble.networks, sharers())


def _sound(states: Float[Array, "*batch S"], rewards: Float[Array, "*batch"]) -> Bool[Array, "*batch"]:
    """False for NaN. A batch's squared returns stay within float32 under these bounds."""
    return jnp.all(jnp.abs(states) < EXPLODED, axis=-1) & (jnp.abs(rewards) < EXPLODED**2)


def returns_per_model(
    simulator: Simulator,
    act: Callable[[Float[Array, "K N S"]], Float[Array, "K N A"]],
    starts: Float[Array, "N S"],
    discount: Number = 1.0,
    after: Callable[[Float[Array, "K N S"]], Float[Array, "K N"]] | None = None,
    key: Key[Array, ""] | None = None,
) -> Float[Array, "K"]:
    """Mean return of the deterministic policy `act` from `starts`, in each model alone.

    What follows the last step is worth `after` of its state; without `after`, nothing. Probabilistic members predict
    with noise where there is a `key`.

    NaN for a model in which any rollout diverged: such a model cannot vouch for the policy.
    """
    ensemble, horizon, bonus = simulator.ensemble, simulator.horizon, simulator.disagreement

    def step(carry: _Valued, at: tuple[Float[Array, ""], Key[Array, ""] | None]) -> tuple[_Valued, None]:
        (states, alive, total, before), (weight, noise_key) = carry, at
        actions = simulator.limits.within(act(states), before)
        predicted = predict(ensemble, states, actions, noise_key)
        if simulator.bounds is not None:
            predicted = bounded(simulator.bounds, states, predicted)
        following, rewards, ended = outcome(simulator.reward, simulator.terminated, states, actions, predicted)
        if bonus:
            flat = (x.reshape(-1, x.shape[-1]) for x in (states, actions))
            rewards = rewards + bonus * disagreement(ensemble, *flat).reshape(rewards.shape)
        sound = _sound(following, rewards)
        # A product with `alive` would let what follows the end through: 0 * inf is NaN.
        total = total + jnp.where(alive > 0, jnp.where(sound, weight * rewards, jnp.nan), 0.0)
        if ended is not None:
            alive = alive * (1.0 - ended)
        return (following, alive, total, None if before is None else actions), None

    states = for_all(ensemble, starts)
    zeros = jnp.zeros(states.shape[:2])
    weights = jnp.float32(discount) ** jnp.arange(horizon)
    carry = (states, zeros + 1.0, zeros, simulator.nothing_before(*zeros.shape))
    keys = None if key is None else jax.random.split(share_of(key), horizon)
    (states, alive, total, _), _ = jax.lax.scan(step, carry, (weights, keys))
    if after is not None:
        total = total + jnp.where(alive > 0, discount**horizon * after(states), 0.0)
    return jnp.mean(total, axis=1)
