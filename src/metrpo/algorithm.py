"""The loop: model-ensemble trust-region policy optimization (the paper's Algorithm 2).

    repeat:
        collect   real episodes with the policy, add them to the dataset        world/collect.py, world/dataset.py
        fit       every model of the ensemble to the dataset                    model/fit.py
        repeat:
            imagine   rollouts through the ensemble with the policy             model/imagine.py
            improve   the policy on them, by TRPO                               policy/improvers/
            validate  the policy in each model                                  policy/stopping.py
        until the models no longer agree that it improves
    until the budget is spent

`step` is one turn of the outer loop and reads like it; `metrpo.training` repeats it until the budget is spent.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from typing import NamedTuple, Protocol, TypeVar

import jax
import numpy as np

from metrpo import budget, policy_phase, scales
from metrpo.config import Config
from metrpo.console.progress import SILENT, Progress
from metrpo.errors import ConfigError, DivergedError, EpisodeError, MetrpoError, NotFiniteError
from metrpo.finite import naming, require_finite
from metrpo.model import ensemble as ensembles
from metrpo.model.calibration import Calibration, end_calibration
from metrpo.model.diagnostics import Diagnosis, diagnose, unknown
from metrpo.model.ensemble import Ensemble, Networks
from metrpo.model.fit import FitInfo, fit, refit
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.inputs import Inputs, folded, inputs_of, unfolded
from metrpo.policy.value.table import Baseline, init_baseline
from metrpo.policy_phase import Hooks, PhaseInfo, Starts, simulator_of
from metrpo.run.clock import Clock
from metrpo.seeds import Stage, key_of, rng_of
from metrpo.types import Array, Episode
from metrpo.world import batch_episodes, offline_data
from metrpo.world import collect as real
from metrpo.world import dataset as datasets
from metrpo.world.dataset import Dataset
from metrpo.world.origin import relative, shifted
from metrpo.world.size_limits import RECORDED
from metrpo.world.task import Task

_log = logging.getLogger("metrpo")
EVALUATION_STEPS = 200_000
"""Real steps of one evaluation after which no other episode begins: a record must not take longer than learning."""
T = TypeVar("T")
Row = dict[str, float | int]
"""One iteration's metrics, in the order of metrics.csv's columns."""


class State(NamedTuple):
    """Everything that an iteration hands to the next: a pytree whose structure the config fixes."""

    iteration: int
    """Outer iterations finished."""
    real_steps: int
    """Real steps collected so far (evaluation does not count: nothing is learned from it)."""
    policy: Policy
    previous_policy: Policy
    """The policy before the last policy phase that changed it; scales the parameter noise."""
    networks: Networks
    """Of the ensemble; its normaliser derives from the dataset."""
    baseline: Baseline
    dataset: Dataset

    @property
    def origin(self) -> np.ndarray:
        """[S], float64: what the states are counted from that models and policy see (`world.origin`)."""
        return self.dataset.origin


def init(config: Config, task: Task) -> State:
    """The state before the first iteration.

    Raises `ConfigError` for settings that contradict each other, `TaskError` for offline data that do not fit.
    """
    if config.imagine.horizon is not None and config.advantage.discount == 1:
        # Undiscounted, a value that leans on itself grows without bound.
        raise ConfigError("advantage.discount: expected less than 1 with imagine.horizon (0.99, say), got 1.0")
    if not task.playable and (config.validate.rule == "real" or config.imagine.start == "reset"):
        raise ConfigError(
            f"{task.name}: expected an environment for validate.rule real and imagine.start reset, got none"
        )
    policy_key, ensemble_key = jax.random.split(key_of(config.seed, 0, Stage.INIT))
    policy = gaussian.init(
        policy_key, task.state_size, task.action_size, config.policy.hidden, config.policy.initial_std
    )
    return State(
        iteration=0,
        real_steps=0,
        policy=policy,
        previous_policy=policy,
        networks=_fresh_networks(config, task, ensemble_key),
        baseline=init_baseline(config.advantage, task.state_size, key_of(config.seed, 0, Stage.IMPROVE)),
        dataset=_logged(config, task),
    )


class Log(Protocol):
    """Where real episodes go as they end, and where those wait that nobody has learned from yet."""

    def pending(self) -> list[Episode]:
        """The episodes that wait."""

    def append(self, episode: Episode) -> object:
        """Keeps one more."""

    def failures(self) -> Mapping[int, bool]:
        """The episodes of this iteration in which the environment failed, and whether each is left out for good."""

    def note_failures(self, failures: Mapping[int, bool]) -> None:
        """Keeps them."""


class Unkept:
    """A log of nothing but the failures of one iteration."""

    def __init__(self) -> None:
        self._failures: Mapping[int, bool] = {}

    def pending(self) -> list[Episode]:
        """None."""
        return []

    def append(self, episode: Episode) -> None:
        """Forgotten."""

    def failures(self) -> Mapping[int, bool]:
        """The last ones noted."""
        return self._failures

    def note_failures(self, failures: Mapping[int, bool]) -> None:
        """Remembered."""
        self._failures = dict(failures)


def step(
    config: Config, task: Task, state: State, progress: Progress = SILENT, log: Log | None = None
) -> tuple[State, Row]:
    """One outer iteration: collect, fit, improve until the ensemble disagrees; and evaluate, for the record only."""
    clock, log = Clock(), log or Unkept()
    with clock("collect"):
        episodes = collect(config, task, state, progress, log)
    return learn(config, task, state, episodes, progress, clock, left_out(log))


def left_out(log: Log) -> int:
    """Episodes of this iteration that are played no more, for the environment failed in them."""
    return sum(log.failures().values())


def collect(
    config: Config,
    task: Task,
    state: State,
    progress: Progress = SILENT,
    log: Log | None = None,
    at_least: int | None = None,
) -> list[Episode]:
    """The real episodes of the next iteration: those that wait in `log`, and more until they have enough steps.

    Enough are `at_least`, or as many as the config asks for and its budget allows; an episode of more steps than the
    config asks for is cut there, and so is the one that reaches the end of the budget. New ones go to `log` as they
    end; what a run that was stopped has collected is not collected again.

    An episode in which the environment gives NaN or infinity is left out for good: its seed would give the same again.
    So is one that fails otherwise, but in its second try: the first ends the run. Raises `UnplayableError` when too
    many are left out, `EpisodeError` for another failure.
    """
    enough = budget.steps_wanted(config, state.real_steps) if at_least is None else at_least
    at_most = budget.steps_left(config, state.real_steps) if at_least is None else math.inf
    progress.stage("collect", enough)
    log = log or Unkept()
    episodes = log.pending()
    while sum(len(e.rewards) for e in episodes) < enough:
        number = len(episodes) + left_out(log)
        try:
            with naming("collect", state.iteration + 1):
                _play(config, task, state, number, episodes, (enough, at_most), log, progress)
        except EpisodeError as error:
            _note_failure(log, len(episodes) + left_out(log), error)
    return episodes


def _play(
    config: Config,
    task: Task,
    state: State,
    first: int,
    episodes: list[Episode],
    bounds: tuple[int, float],
    log: Log,
    progress: Progress,
) -> None:
    """Adds episodes from number `first` on to `episodes` until their steps are within `bounds`, least and most."""
    enough, at_most = bounds
    inputs = _inputs(config, task, state.dataset)
    mean = partial(
        _perturbed, _host(state.policy), _host(state.previous_policy), config.collect.parameter_noise, inputs=inputs
    )
    explorer = lambda rng: real.explore(_of_real(mean(rng), state.origin), config.collect, rng)  # noqa: E731
    # Each episode has randomness of its own, so that it is the same one after any interruption.
    rngs = (rng_of(config.seed, state.iteration + 1, Stage.COLLECT, number) for number in itertools.count(first))
    steps, longest = sum(len(e.rewards) for e in episodes), config.collect.steps
    with closing(real.play(task, explorer, rngs, longest, progress.played, at_most - steps)) as played:
        while steps < enough:
            episodes.append(next(played))
            log.append(episodes[-1])
            steps += len(episodes[-1].rewards)
            progress.update(steps)


def _note_failure(log: Log, number: int, error: EpisodeError) -> None:
    """Leaves an episode out, or raises its `error`: what was not the seed's fault may go better next time."""
    failures = dict(log.failures())
    hopeless = isinstance(error, NotFiniteError) or number in failures
    failures[number] = hopeless
    log.note_failures(failures)
    if not hopeless:
        raise error
    real.leave_out(sum(failures.values()), error)


def learn(
    config: Config,
    task: Task,
    state: State,
    episodes: list[Episode],
    progress: Progress = SILENT,
    clock: Clock | None = None,
    failed: int = 0,
) -> tuple[State, Row]:
    """The rest of an outer iteration: what `episodes`, and all before them, teach; `failed` others were left out.

    What only records (diagnostics, evaluation) cannot fail: it is NaN then, with a warning.

    Raises `DivergedError` where what is learned is not finite and cannot be recovered.
    """
    iteration = state.iteration + 1
    clock = clock or Clock()
    rng = rng_of(config.seed, iteration, Stage.SPLIT)
    dataset = datasets.add(state.dataset, episodes, config.collect, rng, task.learned)
    require_finite("collect", iteration, "leave out the episode that holds it", dataset=dataset)
    if state.iteration == 0:
        scales.warn(config, task, dataset, episodes)
    with clock("fit"):
        progress.stage("fit", None)
        ensemble, fitted = _fit(config, task, state.networks, dataset, iteration, progress)
        require_finite("fit", iteration, "start anew with a lower fit.learning_rate", **ensemble._asdict())
    with clock("improve"):
        progress.stage("improve", config.validate.max_updates)
        if state.iteration == 0 and (inputs := _inputs(config, task, dataset)):
            # A fresh policy's weights are meant for normalised states; by what, only the first data say.
            state = state._replace(policy=folded(state.policy, inputs))
        policy, baseline, improved = _improve(config, task, state._replace(dataset=dataset), ensemble, progress, clock)
        advice = "the run was resumed from, or became, a state that cannot go on: use smaller steps or start anew"
        require_finite("improve", iteration, advice, policy=policy, baseline=baseline)
    following = State(
        iteration=iteration,
        real_steps=state.real_steps + sum(len(e.rewards) for e in episodes),
        policy=policy,
        previous_policy=state.policy if improved.accepted_updates else state.previous_policy,
        networks=ensemble.networks,
        baseline=baseline,
        dataset=dataset,
    )
    with clock("evaluate"):
        diagnosis = _diagnosis(config, task, following, ensemble)
        progress.stage("evaluate", config.evaluation_episodes)
        returns = recorded_returns(config, task, policy, iteration, origin=dataset.origin)
        trust = _end_calibration(task, dataset, ensemble, iteration)
        unfit = partial(scales.count, config, task, dataset, episodes)
    collected = float(np.mean([e.rewards.sum() for e in episodes])) if episodes else math.nan
    row = _row(
        config,
        following,
        returns,
        collected,
        fitted,
        improved,
        policy_phase.imagined_horizon(config, task) < task.horizon or task.horizon > RECORDED,
    )
    row |= {"failed_episodes": failed, "failed_evaluation": failed_evaluation(task, returns)}
    row |= {"unfit_dimensions": recorded("unfit_dimensions", iteration, unfit, math.nan)}
    row |= diagnosis.row() | {f"improved_{k}": float(share) for k, share in enumerate(improved.improved)}
    return following, row | trust | clock.row()


def recorded(what: str, iteration: int, record: Callable[[], T], failed: T) -> T:
    """What `record()` gives; where it fails, `failed` and a warning that says why: no record may cost what is learned.

    Not so when the run is to stop (`console.interrupt.Stopped`).
    """
    try:
        return record()
    except Exception as error:
        why = str(error) if isinstance(error, MetrpoError) else f"{type(error).__name__}: {error}"
        _log.warning("iteration %d has no %s (%s); what it has learned is kept", iteration, what, why)
        return failed


def recorded_returns(
    config: Config,
    task: Task,
    policy: Policy,
    iteration: int,
    stage: Stage = Stage.EVALUATE,
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """As `evaluate`; one NaN where that fails."""

    def returns() -> np.ndarray:
        with naming("evaluate" if stage is Stage.EVALUATE else "validate", iteration):
            return evaluate(config, task, policy, iteration, stage, origin)

    return recorded("return_real", iteration, returns, np.array([math.nan]))


def failed_evaluation(task: Task, returns: np.ndarray) -> int:
    """1 where there is no real return though the task has an environment, else 0."""
    return int(task.playable and not np.isfinite(returns).all())


def _diagnosis(config: Config, task: Task, state: State, ensemble: Ensemble) -> Diagnosis:
    dataset, horizon = state.dataset, policy_phase.imagined_horizon(config, task)
    key = key_of(config.seed, state.iteration, Stage.DIAGNOSE)
    record = partial(diagnose, ensemble, state.policy, dataset.validation, dataset.train, horizon, key)
    return recorded("diagnostics", state.iteration, record, unknown(task.state_size, horizon))


def _end_calibration(task: Task, dataset: Dataset, ensemble: Ensemble, iteration: int) -> Row:
    if "end" not in task.learned:
        return {}
    nothing = Calibration(*[math.nan] * len(Calibration._fields))
    trust = recorded("calibration", iteration, partial(end_calibration, ensemble, dataset.validation), nothing)
    return {f"end_{name}": value for name, value in trust._asdict().items()}


def _fit(
    config: Config, task: Task, networks: Networks, dataset: Dataset, iteration: int, progress: Progress
) -> tuple[Ensemble, FitInfo]:
    init_key, fit_key = jax.random.split(key_of(config.seed, iteration, Stage.FIT))
    every = config.fit.reinitialise_every
    if every and (iteration - 1) % every == 0:
        networks = _fresh_networks(config, task, init_key)
    e = config.ensemble
    normaliser = ensembles.normaliser_of(dataset.train, e.std_floor, e.delta_std_floor, task.unseen)
    train = jax.device_put(datasets.with_capacity(dataset.train, config.collect.max_train))
    validation = jax.device_put(datasets.with_capacity(dataset.validation, config.collect.max_validation))

    def tell(passes: int, losses: Array) -> None:
        progress.update(passes, f"validation loss {float(np.mean(losses)):.4g}")

    ensemble, info = fit(networks, normaliser, train, validation, config.fit, fit_key, tell)
    if (survived := info.diverged & ~info.lost).any():
        _log.warning("fit, iteration %d: %s diverged, and keep their best weights", iteration, _named(survived))
    if info.lost.any():
        _log.warning("fit, iteration %d: %s diverged: re-initialised and fitted again", iteration, _named(info.lost))
        init_key, fit_key = jax.random.split(key_of(config.seed, iteration, Stage.RESET))
        fresh = _fresh_networks(config, task, init_key)
        ensemble, info = refit(ensemble, info, fresh, train, validation, config.fit, fit_key)
    if info.lost.any():
        largest = float(np.abs(dataset.train.deltas).max())
        raise DivergedError(
            f"fit, iteration {iteration}: {_named(info.lost)}: expected finite weights and losses, got others, twice; "
            f"start anew with a lower fit.learning_rate than {config.fit.learning_rate}, or look for outliers in the "
            f"data (its largest change of a state is {largest:.3g})"
        )
    return ensemble, info


def _named(members: np.ndarray) -> str:
    return f"members {', '.join(map(str, np.flatnonzero(members)))}"


def _improve(
    config: Config, task: Task, state: State, ensemble: Ensemble, progress: Progress, clock: Clock
) -> tuple[Policy, Baseline, PhaseInfo]:
    iteration, dataset = state.iteration + 1, state.dataset
    rng, starts = rng_of(config.seed, iteration, Stage.IMPROVE), dataset.starts
    simulator = simulator_of(config, shifted(task, dataset.origin), ensemble, _inputs(config, task, dataset))
    if config.imagine.start == "anywhere":
        starts = dataset.train.states
    if config.imagine.start == "reset":
        with naming("improve", iteration):
            rollouts = policy_phase.rollouts_for(config.imagine.steps, simulator.horizon)
            starts = real.reset_states(task, max(config.validate.starts, rollouts), rng)
        starts = relative(starts, dataset.origin).astype(np.float32)

    def oracle(policy: Policy) -> float:
        # A policy in which the environment fails is no improvement, and the next iteration has other starts. They are
        # others than the record's, which would else be a selected maximum.
        return float(np.mean(recorded_returns(config, task, policy, iteration, Stage.ORACLE, dataset.origin)))

    def tell(updates: int, accepted: int, value: float) -> None:
        progress.update(updates, f"accepted {accepted}, imagined return {value:.2f}")

    return policy_phase.improve(
        config,
        simulator,
        _with_std(config, state),
        state.baseline,
        Starts(starts, rng),
        key_of(config.seed, iteration, Stage.IMPROVE),
        Hooks(clock, tell, oracle),
    )


def _inputs(config: Config, task: Task, dataset: Dataset) -> Inputs | None:
    """What the policy sees of a state; None: all of it, as it is."""
    seen = config.policy.normalise and dataset.train.size > 0
    return inputs_of(dataset.train.states, task.unseen) if seen else None


def _with_std(config: Config, state: State) -> Policy:
    """The policy with the standard deviation that a phase starts from."""
    if config.policy.min_std and state.iteration > 0:
        least = np.float32(math.log(config.policy.min_std))
        return state.policy._replace(log_std=np.maximum(np.asarray(state.policy.log_std), least))
    return gaussian.reset_std(state.policy, config.policy.initial_std)


def _logged(config: Config, task: Task) -> Dataset:
    """The dataset before the first iteration: what was logged elsewhere, or nothing."""
    nothing = datasets.empty(task.state_size, task.action_size, len(task.learned))
    if config.data is None:
        if config.real_steps == 0:
            raise ConfigError("real_steps: expected at least 1 without logged transitions to learn from (data), got 0")
        return nothing
    rng = rng_of(config.seed, 0, Stage.SPLIT)
    return datasets.add(nothing, offline_data.load(config.data, task), config.collect, rng, task.learned)


def evaluate(
    config: Config,
    task: Task,
    policy: Policy,
    iteration: int,
    stage: Stage = Stage.EVALUATE,
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """Real returns [config.evaluation_episodes] of the deterministic policy: a record, never used to learn.

    The policy sees states less `origin` [S].

    Fewer where they have `EVALUATION_STEPS` together; each is cut after `RECORDED` steps. One NaN for a task that only
    another program can play.
    """
    if not task.playable:
        return np.array([math.nan])
    seed = int(rng_of(config.seed, iteration, stage).integers(2**31))
    act: real.Act = partial(gaussian.mean, _host(policy))
    act = act if origin is None else _of_real(act, origin)
    return batch_episodes.evaluate(task, act, config.evaluation_episodes, seed, EVALUATION_STEPS, RECORDED)


def _of_real(act: real.Act, origin: np.ndarray) -> real.Act:
    """`act`, which takes states counted from `origin`, for states as the environment gives them."""
    return lambda state: act(relative(state, origin))


def _perturbed(
    policy: Policy, previous: Policy, scale: float, rng: np.random.Generator, inputs: Inputs | None = None
) -> real.Act:
    """The mean action of the policy with its parameters perturbed (paper, appendix A.1.1).

    Those that act on normalised states: an offset of the states would blow up the noise of raw ones.
    """
    if inputs is not None:
        policy, previous = unfolded(policy, inputs), unfolded(previous, inputs)

    def noisy(now: np.ndarray, before: np.ndarray) -> np.ndarray:
        return now + scale * np.abs(now - before) * rng.standard_normal(now.shape)

    perturbed = policy._replace(layers=jax.tree.map(noisy, policy.layers, previous.layers))
    return partial(gaussian.mean, perturbed if inputs is None else folded(perturbed, inputs))


def _row(
    config: Config,
    state: State,
    returns: np.ndarray,
    collected: float,
    fitted: FitInfo,
    improved: PhaseInfo,
    cut: bool,
) -> Row:
    imagined = float(np.mean(improved.values))
    losses = np.asarray(fitted.validation_loss)
    return {
        "iteration": state.iteration,
        "real_steps": state.real_steps,
        "return_real": float(np.mean(returns)),
        "return_real_std": float(np.std(returns)),
        "return_collected": collected,
        "return_imagined": imagined,
        # What episodes of different lengths earn cannot be compared.
        "gap": math.nan if cut else imagined - float(np.mean(returns)),
        **{f"validation_loss_{k}": float(loss) for k, loss in enumerate(losses)},
        "train_loss": float(np.mean(fitted.train_loss)),
        "fit_passes": fitted.passes,
        "members_reset": fitted.resets,
        "updates": improved.updates,
        "accepted_updates": improved.accepted_updates,
        "rejected_steps": improved.rejected_steps,
        "validations": improved.validations,
        "fraction_improved": float(np.mean(improved.improved)),
        "kl": improved.kl,
        "mean_std": float(np.mean(np.exp(np.asarray(state.policy.log_std)))),
        "diverged": improved.diverged,
    }


def _fresh_networks(config: Config, task: Task, key: Array) -> Networks:
    e = config.ensemble
    return ensembles.init(key, e.members, task.state_size, task.action_size, e.hidden, len(task.learned))


def _host(policy: Policy) -> Policy:
    return jax.tree.map(np.asarray, policy)
