"""Searches over settings: trials as ordinary runs, several at a time, stopped early where their real return is bad."""

from __future__ import annotations

import math
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from metrpo.console.result_lines import duration
from metrpo.console.run_status import is_running
from metrpo.counting import counted
from metrpo.errors import MetrpoError
from metrpo.launch.local import shares_of_cores
from metrpo.launch.processes import Begin, Cores, Orphan, Worker, begin
from metrpo.launch.run_spec import RunSpec
from metrpo.launch.status import Tell, log_of, rows_of, tail
from metrpo.run import machine
from metrpo.run.metrics import Row
from metrpo.tune.results import Tuned, shown, tuned
from metrpo.tune.search import Search, worth
from metrpo.tune.study import ask, opened_study, taken_up

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import TrialState

_POLL = 0.5
"""Seconds between two looks at the runs."""
_HOPELESS = 3
"""Failures without a success in a session, after which no trial is started."""


@dataclass
class _Going:
    """A running trial."""

    trial: Trial
    runs: list[RunSpec]
    workers: dict[RunSpec, Worker]
    cores: list[Cores]
    reported: int
    """Iterations in the study."""
    judged: int
    """Iterations after which it was asked whether the trial is bad: one less, where the process ended in between."""
    pruned: int | None
    """The iteration after which it was pruned."""
    ending: bool = False
    began: float = field(default_factory=time.monotonic)

    def stop(self) -> None:
        """Asks all its runs to end."""
        self.ending = True
        for worker in self.workers.values():
            worker.terminate()


def tune(search: Search, out: Path, jobs: int, tell: Tell, begin: Begin = begin) -> Tuned:
    """Runs trials, `jobs` at a time and each on its own cores, until there are as many as the search asks for.

    Returns all trials under `out`. Started again, it keeps finished trials and resumes the others. Ctrl-C or SIGTERM
    stops the runs too, each with its iteration saved; a second one stops them at once.

    Raises `MetrpoError` when `out` cannot be used (see `opened_study`), or when the first trials all fail.
    """
    with opened_study(search, out) as study:
        _Tuning(search, study, out, jobs, tell, begin).run()
        return tuned(study, search)


class _Tuning:
    """One session of a search."""

    def __init__(self, search: Search, study: Study, out: Path, jobs: int, tell: Tell, begin: Begin) -> None:
        self._search, self._study, self._out, self._tell, self._begin = search, study, out, tell, begin
        machine.divide_gpu(jobs * len(search.seeds))
        seeds, shares = len(search.seeds), shares_of_cores(jobs * len(search.seeds))
        self._free = [shares[i * seeds : (i + 1) * seeds] for i in range(jobs)]
        self._going: list[_Going] = []
        self._failed, self._hopeful = 0, any(t.state.name == "COMPLETE" for t in study.get_trials(deepcopy=False))

    def run(self) -> None:
        states = [trial.state.name for trial in self._study.get_trials(deepcopy=False)]
        interrupted = [number for number, state in enumerate(states) if state == "RUNNING"]
        finished = len(states) - len(interrupted) - states.count("WAITING")
        trials = counted(self._search.trials, "trial")
        self._tell(f"{finished} of {trials} are finished, {len(interrupted)} interrupted")
        try:
            while True:
                while self._free and (interrupted or self._wants_more()):
                    self._start(interrupted.pop(0) if interrupted else None)
                if not self._going:
                    break
                time.sleep(_POLL)
                for going in list(self._going):
                    self._look_at(going)
        finally:
            self._stop_all()
        if self._is_hopeless():
            raise MetrpoError(
                f"{self._failed} trials have failed and none succeeded; fix the error at the end of their logs, then "
                "give the same command again"
            )

    def _wants_more(self) -> bool:
        started = sum(t.state.name != "WAITING" for t in self._study.get_trials(deepcopy=False))
        return started < self._search.trials and not self._is_hopeless()

    def _is_hopeless(self) -> bool:
        return self._failed >= _HOPELESS and not self._hopeful

    def _start(self, number: int | None) -> None:
        study, search = self._study, self._search
        trial, values = ask(study, search) if number is None else taken_up(study, search, number)
        frozen = study.get_trials(deepcopy=False)[trial.number]
        runs = search.runs(trial.number, values)
        self._tell(f"trial {trial.number}: {shown(values)}" + ("" if number is None else ", resumed"))
        reported = max(frozen.intermediate_values, default=0)
        going = _Going(
            trial=trial,
            runs=runs,
            workers={},
            cores=self._free.pop(0),
            reported=reported,
            judged=max(0, reported - 1),
            pruned=frozen.user_attrs.get("pruned_after"),
        )
        self._going.append(going)
        self._report(going)
        for run, cores in zip(runs, going.cores, strict=True):
            if not search.is_spent(rows_of(run, self._out)) and going.pruned is None:
                going.workers[run] = self._begin(run, self._out, cores)
            elif is_running(self._out / run.name):
                going.workers[run] = Orphan(run, self._out, cores)
        if going.pruned is not None:
            going.stop()

    def _look_at(self, going: _Going) -> None:
        codes = {run: worker.poll() for run, worker in going.workers.items()}  # first: what has ended has written all
        for run, cores in zip(going.runs, going.cores, strict=True):
            if codes.get(run) and is_running(self._out / run.name):
                # It was refused: one that was started just before a kill had not taken its lock when we looked.
                going.workers[run], codes[run] = Orphan(run, self._out, cores), None
                if going.ending:
                    going.workers[run].terminate()
        self._report(going)
        if None not in codes.values():
            self._going.remove(going)
            self._free.append(going.cores)
            self._finish(going)
        elif any(codes.values()) and not going.ending:  # one seed failed, so the trial has failed
            going.stop()

    def _rows(self, going: _Going) -> tuple[list[list[Row]], bool]:
        """The rows of the trial's runs, and whether they are complete."""
        rows = [rows_of(run, self._out) for run in going.runs]
        return rows, all(map(self._search.is_spent, rows))

    def _report(self, going: _Going) -> None:
        """Reports iterations that all seeds have finished to the pruner, and stops the trial if they are bad."""
        if going.pruned is not None:
            return
        rows, whole = self._rows(going)
        measured = min(map(len, rows))
        for iteration in range(going.judged + 1, measured + 1):
            going.judged = iteration
            if iteration > going.reported:
                value = fmean(worth(rows, iteration))
                going.trial.report(value, iteration)
                self._tell(
                    f"trial {going.trial.number}: iteration {iteration}/{self._search.steps}, return {value:.1f}"
                )
            if not (whole and iteration == measured) and going.trial.should_prune():
                going.pruned = iteration
                going.trial.set_user_attr("pruned_after", iteration)  # stays so when this process is killed meanwhile
                going.stop()
                return

    def _finish(self, going: _Going) -> None:
        trial, took = going.trial, duration(time.monotonic() - going.began)
        rows, whole = self._rows(going)
        trial.set_user_attr("real_steps", sum(int(r[-1]["real_steps"] or 0) for r in rows if r))
        returns = worth(rows) if whole else [math.nan]
        value = fmean(returns)
        if math.isfinite(value):
            trial.set_user_attr("returns", returns)
            self._study.tell(trial, value)
            self._hopeful = True
            self._tell(f"trial {trial.number}: return {value:.1f}, in {took}")
        elif going.pruned is not None:
            self._study.tell(trial, state=_state("PRUNED"))
            self._hopeful = True
            self._tell(f"trial {trial.number}: pruned after {counted(going.pruned, 'iteration')}, in {took}")
        else:
            why = f"the return is {value}" if whole else self._why(going)
            trial.set_user_attr("failure", why)
            self._study.tell(trial, state=_state("FAIL"))
            self._failed += 1
            self._tell(f"trial {trial.number}: FAILED after {took}: {why}")

    def _why(self, going: _Going) -> str:
        """The end of the log of the run that failed, not of one that was stopped for that."""
        codes = {run: worker.poll() for run, worker in going.workers.items()}
        short = [run for run in codes if not self._search.is_spent(rows_of(run, self._out))] or list(codes)
        run = next((run for run in short if codes[run] != 128 + signal.SIGTERM), short[0])
        log = log_of(run, self._out)
        lines = tail(log) if log.exists() else []
        return "\n      ".join([f"exit code {codes[run]}; the end of {log}:", *lines])

    def _stop_all(self) -> None:
        """Stops the running trials: each run finishes its iteration. When interrupted, stops them at once."""
        if self._going:
            trials = counted(len(self._going), "trial")
            self._tell(f"stopping {trials} at the end of an iteration; press again to stop at once")
        try:
            self._end_all()
        except BaseException:
            self._end_all()
            raise

    def _end_all(self) -> None:
        for going in self._going:
            going.stop()
        for going in self._going:
            for worker in going.workers.values():
                worker.wait()


def _state(name: str) -> TrialState:
    from optuna.trial import TrialState

    return TrialState[name]
