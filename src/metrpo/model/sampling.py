"""How the next state comes out of the ensemble: one function for each way, in the table `SAMPLINGS`.

Paper, appendix "Ensemble sampling methods".
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, Key

from metrpo.model.ensemble import Predictor, predict, predict_changing, with_carried
from metrpo.types import Array


def model_choice(
    key: Key[Array, ""], count: int, members: int
) -> tuple[Int[Array, "{members} G"], Int[Array, "{count}"]]:
    """A model for each of `count` states, in equal groups: (slots, model of every state).

    Row k of `slots` holds the states of model k, padded with `count` (an index out of range). States are dealt to the
    models from a shuffled deck, so each state's model is uniform and independent from step to step, every rollout has
    the law of independent draws, and K models cost the products of one.
    """
    group = -(-count // members)
    # The deck is shuffled with its blanks, else the last model would be drawn less often than the others.
    deck = jax.random.permutation(key, group * members)
    slots = jnp.where(deck < count, deck, count).reshape(members, group)
    numbers = jnp.arange(members, dtype=jnp.int32)[:, None]
    models = jnp.zeros(count, jnp.int32).at[slots].set(numbers, mode="drop")
    return slots, models


class Keys(NamedTuple):
    """Randomness of one imagined step."""

    step: Key[Array, ""]
    """Another one in every step."""
    episode: Key[Array, ""]
    """The same in all steps of a batch of episodes."""
    noise: Key[Array, ""] | None = None
    """Of what probabilistic members predict, another one in every step; None: their means."""


@runtime_checkable
class Draw(Protocol):
    """The signature of every sampling."""

    def __call__(
        self, ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
    ) -> Float[Array, "N P"]:
        """The next states first, then what else is learned."""


def step_rand(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """One model drawn at random for each state and step (paper, section 5)."""
    return _of_drawn_models(ensemble, states, actions, keys.step, keys.noise)


def eps_rand(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """One model drawn at random for each episode."""
    return _of_drawn_models(ensemble, states, actions, keys.episode, keys.noise)


def _of_drawn_models(
    ensemble: Predictor,
    states: Float[Array, "N S"],
    actions: Float[Array, "N A"],
    choice: Key[Array, ""],
    noise: Key[Array, ""] | None,
) -> Float[Array, "N P"]:
    slots, _ = model_choice(choice, states.shape[0], ensemble.members)
    # The blanks repeat the last state; their predictions are dropped.
    states_of_each, actions_of_each = (jnp.take(x, slots, axis=0, mode="clip") for x in (states, actions))
    grouped = predict(ensemble, states_of_each, actions_of_each, noise)
    return jnp.zeros((states.shape[0], grouped.shape[-1])).at[slots].set(grouped, mode="drop")


def one_model(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """The first model, always."""
    return predict(ensemble.first(), states[None], actions[None], keys.noise)[0]


def model_mean(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """The mean of all models' predictions."""
    return with_carried(ensemble, states, actions, jnp.mean(_of_all_models(ensemble, states, actions), axis=0))


def model_med(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """The median of all models' predictions, dimension by dimension."""
    return with_carried(ensemble, states, actions, jnp.median(_of_all_models(ensemble, states, actions), axis=0))


def model_mean_std(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"], keys: Keys
) -> Float[Array, "N P"]:
    """Drawn from N(mean, std^2) of all models' predictions, dimension by dimension."""
    predictions = _of_all_models(ensemble, states, actions)
    noise = jax.random.normal(keys.step, predictions.shape[1:])
    # Not jnp.std: where all models agree, its gradient is NaN.
    variance = jnp.mean(jnp.square(predictions - jnp.mean(predictions, axis=0)), axis=0)
    std = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    return with_carried(ensemble, states, actions, jnp.mean(predictions, axis=0) + std * noise)


def _of_all_models(
    ensemble: Predictor, states: Float[Array, "N S"], actions: Float[Array, "N A"]
) -> Float[Array, "K N D"]:
    # Without what is carried over: a mean of equal numbers may be another in its last bit.
    return predict_changing(ensemble, *(for_all(ensemble, x) for x in (states, actions)))


def for_all(ensemble: Predictor, x: Float[Array, "N *rest"]) -> Float[Array, "K N *rest"]:
    """The same for every model."""
    return jnp.broadcast_to(x, (ensemble.members, *x.shape))


class Sampling(NamedTuple):
    """A row of the table."""

    draw: Draw
    of_drawn_models: bool = False
    """Whether one model predicts for each state: devices may then share the models (`imagine.CORE_CACHE`)."""


SAMPLINGS: dict[str, Sampling] = {
    "step_rand": Sampling(step_rand, of_drawn_models=True),
    "model_mean_std": Sampling(model_mean_std),
    "model_mean": Sampling(model_mean),
    "model_med": Sampling(model_med),
    "eps_rand": Sampling(eps_rand, of_drawn_models=True),
    "one_model": Sampling(one_model),
}
