"""Fits the ensemble to all real transitions; members that diverge start anew."""

from __future__ import annotations

import dataclasses
import logging

import jax
import numpy as np

from metrpo.config import Config
from metrpo.console.progress import Progress
from metrpo.errors import DivergedError
from metrpo.model import ensemble as ensembles
from metrpo.model.ensemble import Activation, Carried, Ensemble, Networks
from metrpo.model.fit import FitInfo, fit, refit
from metrpo.seeds import Stage, key_of
from metrpo.types import Array, Transitions
from metrpo.world import dataset as datasets
from metrpo.world.dataset import Dataset
from metrpo.world.task import Task

_log = logging.getLogger("metrpo")
_ROUNDS = 4
"""`fit.max_steps` at most in one iteration, however much it collected."""


def fit_ensemble(
    config: Config, task: Task, networks: Networks, dataset: Dataset, iteration: int, progress: Progress, steps: int = 0
) -> tuple[Ensemble, FitInfo]:
    """The ensemble fitted to the dataset, which has `steps` new real steps; members that diverge are fitted once more,
    from fresh weights.

    Raises `DivergedError` where they diverge again.
    """
    init_key, fit_key = jax.random.split(key_of(config.seed, iteration, Stage.FIT))
    every = config.fit.reinitialise_every
    if every and (iteration - 1) % every == 0:
        networks = fresh_networks(config, task, init_key)
    ensemble = ensemble_of(config, task, networks, dataset.train)
    train = jax.device_put(datasets.with_capacity(dataset.train, config.collect.max_train))
    validation = jax.device_put(datasets.with_capacity(dataset.validation, config.collect.max_validation))

    def tell(passes: int, losses: Array) -> None:
        progress.update(passes, f"validation loss {float(np.mean(losses)):.4g}")

    rounds = rounds_for(config, steps)
    ensemble, info = fit(ensemble, train, validation, config.fit, fit_key, tell, rounds)
    if (survived := info.diverged & ~info.lost).any():
        _log.warning("fit, iteration %d: %s diverged and kept their best weights", iteration, _named(survived))
    if info.lost.any():
        _log.warning("fit, iteration %d: %s diverged; re-initialised and fitted again", iteration, _named(info.lost))
        init_key, fit_key = jax.random.split(key_of(config.seed, iteration, Stage.RESET))
        fresh = fresh_networks(config, task, init_key)
        most = config.fit.max_steps
        longer = dataclasses.replace(config.fit, max_steps=None if most is None else rounds * most)
        ensemble, info = refit(ensemble, info, fresh, train, validation, longer, fit_key)
    if info.lost.any():
        largest = float(np.abs(dataset.train.deltas).max())
        raise DivergedError(
            f"fit, iteration {iteration}: {_named(info.lost)}: expected finite weights and losses, got others, twice; "
            f"start anew with fit.learning_rate below {config.fit.learning_rate}, or look for outliers in the data "
            f"(largest change of a state: {largest:.3g})"
        )
    return ensemble, info


def rounds_for(config: Config, steps: int) -> int:
    """How many times `fit.max_steps` an iteration may take that collected `steps` real steps."""
    return min(max(1, steps // config.collect.steps), _ROUNDS)


def _named(members: np.ndarray) -> str:
    return f"members {', '.join(map(str, np.flatnonzero(members)))}"


def ensemble_of(config: Config, task: Task, networks: Networks, train: Transitions) -> Ensemble:
    """The task's ensemble of `networks`, which see `train` (host arrays) with mean 0 and standard deviation 1."""
    e = config.ensemble
    normaliser = ensembles.normaliser_of(train, e.std_floor, e.delta_std_floor, task.unseen)
    return Ensemble(networks, normaliser, Carried(task.carried), Activation(e.activation))


def fresh_networks(config: Config, task: Task, key: Array) -> Networks:
    """Networks with fresh weights."""
    e = config.ensemble
    sizes = task.state_size, task.action_size, e.hidden, task.predicted
    return ensembles.init(key, e.members, *sizes, e.probabilistic)
