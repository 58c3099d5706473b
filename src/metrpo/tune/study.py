"""A search's trials on disk: Optuna's study in DIR/study.jsonl, a line of JSON for everything that happens to a trial.

Only the process that holds DIR/.lock writes it. Killed at any moment, the next one cuts off a half-written last line
and goes on: what Optuna draws for a trial follows from the search's seed, the trial's number and the trials before it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from metrpo.errors import MetrpoError, RunDirectoryError
from metrpo.run.files import make_directory
from metrpo.run.lock import hold
from metrpo.safe_load import json_of, opened
from metrpo.tune.search import Search

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.pruners import BasePruner

FILE = "study.jsonl"
_NAME, _SPEC = "metrpo", "search"
_RANDOM = 6
"""Number of random trials, the preset's own included, before the sampler learns from them."""
_UNPRUNED = 4
"""Number of complete trials before others are compared with them."""
_FACTOR = 3
"""Successive halving lets the best third go on."""


def require_optuna() -> None:
    """Raises `MetrpoError` where Optuna is not installed; silences its own messages."""
    try:
        import optuna
    except ImportError as error:
        raise MetrpoError("metrpo tune needs Optuna, which is not installed: pip install 'metrpo[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)


class _Held:
    """The journal's lock while DIR/.lock is held for all of the session: nothing to do, nothing left after a kill."""

    def acquire(self) -> bool:
        return True

    def release(self) -> None:
        pass


@contextmanager
def opened_study(search: Search, out: Path) -> Iterator[Study]:
    """The study of `search` in `out`, new or resumed; locked by this process in the `with` block.

    Raises `RunDirectoryError` when `out` cannot be written, is in use, is damaged or holds another search, and
    `MetrpoError` where Optuna is missing.
    """
    require_optuna()
    try:
        make_directory(out)
    except OSError as error:
        raise RunDirectoryError(f"cannot write {out}: {error.strerror or error}; choose another --out") from error
    with hold(out):
        _repair(out / FILE)
        study = _load(out / FILE, search)
        _require_same(study.user_attrs.get(_SPEC), search, out)
        if not study.get_trials(deepcopy=False) and search.usual is not None:
            _enqueue(study, search, search.usual)  # the one to compare all others with
        yield study


def ask(study: Study, search: Search) -> tuple[Trial, dict[str, Any]]:
    """A new trial, and its settings."""
    import optuna

    trials = study.get_trials()
    if not any(trial.state.name == "WAITING" for trial in trials):
        # All settings are drawn before the first is written, and then written in one line.
        drawn = optuna.create_study(direction="maximize", sampler=_sampler(search, len(trials)))
        drawn.add_trials(trials)
        _enqueue(study, search, _values(drawn.ask(), search))
    trial = study.ask()
    return trial, _values(trial, search)


def taken_up(study: Study, search: Search, number: int) -> tuple[Trial, dict[str, Any]]:
    """A trial that was under way when the last process ended, and its settings."""
    from optuna import Trial

    storage = study._storage
    key = storage.get_study_id_from_name(_NAME)
    trial = Trial(study, storage.get_trial_id_from_study_id_trial_number(key, number))
    return trial, _values(trial, search)


def _enqueue(study: Study, search: Search, values: Mapping[str, Any]) -> None:
    study.enqueue_trial({name: search.space[name].label(value) for name, value in values.items()})


def _values(trial: Trial, search: Search) -> dict[str, Any]:
    return {name: span.ask(trial, name) for name, span in search.space.items()}


def _sampler(search: Search, number: int) -> Any:
    """Begun anew for each trial: one sampler for all would repeat its first draws whenever the search is resumed."""
    from optuna.samplers import TPESampler

    seed = int(np.random.SeedSequence([search.sampler_seed, number]).generate_state(1)[0])
    return TPESampler(seed=seed, n_startup_trials=_RANDOM)


def _pruner(search: Search) -> BasePruner:
    from optuna.pruners import MedianPruner, NopPruner, SuccessiveHalvingPruner

    first = max(1, -(-search.steps // 3))
    """The first third of a run says little: the models have seen little data."""
    if search.pruner == "median":
        return MedianPruner(n_startup_trials=_UNPRUNED, n_warmup_steps=first)
    return SuccessiveHalvingPruner(first, _FACTOR) if search.pruner == "halving" else NopPruner()


def _load(path: Path, search: Search) -> Study:
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    try:
        storage = JournalStorage(JournalFileBackend(str(path), lock_obj=cast(Any, _Held())))
        if _NAME not in optuna.get_all_study_names(storage):
            optuna.create_study(storage=storage, study_name=_NAME, direction="maximize")
        study = optuna.load_study(storage=storage, study_name=_NAME, pruner=_pruner(search))
        if not study.user_attrs and not study.trials:
            study.set_user_attr(_SPEC, search.record())
        return study
    except OSError as error:
        raise RunDirectoryError(f"cannot write {path}: {error.strerror or error}; choose another --out") from error
    except Exception as error:  # it is replayed, and may hold anything
        raise RunDirectoryError(
            f"{path} is damaged ({type(error).__name__}: {error}); put it back, or choose another --out"
        ) from error


def _repair(path: Path) -> None:
    """Cuts off a last line that a kill has left unfinished; Optuna would append the next one to it.

    Raises `RunDirectoryError` when any other line is no JSON object.
    """
    if not path.exists():
        return
    with opened(path, RunDirectoryError) as file:
        content = file.read()
    whole = content.rfind(b"\n") + 1
    for number, line in enumerate(content[:whole].splitlines(), 1):
        damaged = f"{path} is damaged in line {number}; put it back, or choose another --out"
        if not isinstance(json_of(line, damaged, RunDirectoryError), dict):
            raise RunDirectoryError(damaged)
    if whole < len(content):
        os.truncate(path, whole)


def _require_same(stored: Any, search: Search, out: Path) -> None:
    ours: Mapping[str, Any] = json.loads(json.dumps(search.record()))
    if not isinstance(stored, dict):
        raise RunDirectoryError(f"{out / FILE} is no search of metrpo; choose another --out")
    other = [f"{name} {stored.get(name)} (now {value})" for name, value in ours.items() if stored.get(name) != value]
    if other:
        raise RunDirectoryError(
            f"{out} holds another search: {'; '.join(other)}. Give the same search (only trials and jobs may change), "
            "or choose another --out"
        )
