"""A run of three iterations on the probe that costs next to nothing to repeat, for tests that break it off."""

from __future__ import annotations

import contextlib
import sys

import jax
import jaxtyping
import numpy as np
import pytest

import probe
from faults import Disk
from metrpo import algorithm, external
from metrpo.commands.parse import parse
from metrpo.errors import RunDirectoryError
from metrpo.run import derived_files, lock, machine
from metrpo.run.episodes import EpisodeLog
from metrpo.run.files import atomic_write
from metrpo.training import train
from places import SUPPORT

ITERATIONS, EPISODES = 3, 4
SMALL = {
    "collect.steps": EPISODES * probe.HORIZON,
    "collect.max_train": 300,
    "collect.max_validation": 200,
    "ensemble.members": 2,
    "ensemble.hidden": (8,),
    "fit.max_steps": 10,
    "imagine.steps": 200,
    "policy.hidden": (8,),
    "validate.max_updates": 5,
    "validate.starts": 5,
    "evaluation_episodes": 1,
    "deterministic": True,
    "trust_reward": True,
    "iterations": ITERATIONS,
}


def typed(settings=SMALL):
    """The settings as words of a command line."""
    words = []
    for name, value in settings.items():
        values = value if isinstance(value, tuple) else () if value is True else (value,)
        words += [f"--{name.replace('_', '-')}", *map(str, values)]
    return words


def command_line(run_dir, *more):
    """`metrpo train` of the same run."""
    return ["train", "Probe", "--run-dir", str(run_dir), "--no-video", *typed(), *more]


with probe.registered():
    CONFIG = parse(command_line("anywhere")).config


class Counted:
    """Real episodes that are on disk for certain, for `append` has returned."""

    kept = 0


def _content(tree):
    return tuple((np.shape(x), np.asarray(x).tobytes()) for x in jax.tree.leaves(tree))


@contextlib.contextmanager
def cheap():
    """What follows from the very same bytes is computed once; the curve is a text; nobody checks array shapes."""
    learned, begun = {}, {}
    learn, init, append = algorithm.learn, algorithm.init, EpisodeLog.append

    def learn_once(config, task, state, episodes, progress, *rest):
        key = _content((state, episodes))
        if key not in learned:
            learned[key] = learn(config, task, state, episodes, progress, *rest)
        else:
            for stage in ("fit", "improve", "evaluate"):
                progress.stage(stage)
        following, row = learned[key]
        return following, dict(row)

    def init_once(config, task):
        if config.iterations not in begun:
            begun[config.iterations] = init(config, task)
        return begun[config.iterations]

    def counted_append(self, episode, proof=False):
        path = append(self, episode, proof)
        Counted.kept += 1
        return path

    with probe.registered(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(algorithm, "learn", learn_once)
        patch.setattr(algorithm, "init", init_once)
        patch.setattr(EpisodeLog, "append", counted_append)
        patch.setattr(jaxtyping.config, "jaxtyping_disable", True)
        patch.setattr(lock, "source_commit", lambda: "a commit")
        patch.setattr(machine, "prepare", lambda *_, **__: None)
        patch.setattr(
            derived_files, "draw_curve", lambda rows, path, title, *_: atomic_write(path, f"{len(rows)} rows")
        )
        yield


def by_train(run_dir):
    """One command."""
    yield lambda: train(CONFIG, run_dir)


def by_steps(run_dir):
    """The commands for another program, each of which may be given again."""

    def unless(done, command):
        def tolerant():
            try:
                command()
            except RunDirectoryError as error:
                if done not in str(error):
                    raise

        return tolerant

    yield unless("holds a run already", lambda: external.begin(CONFIG, run_dir))
    for _ in range(ITERATIONS):
        yield lambda: external.collect(run_dir)
        yield unless("expected episodes to learn from, got none", lambda: external.improve(run_dir))


def drive(commands, run_dir, deaths, fault="kill"):
    """Gives the commands, each again after each death; the i-th process dies at its operation `deaths[i]`.

    Returns the operations of each process, the last one's last.
    """
    run_dir.parents[1].mkdir(parents=True, exist_ok=True)
    done, Counted.kept = [], 0
    given = iter(commands(run_dir))
    command, deaths = next(given), list(deaths)
    while True:
        disk = Disk(run_dir.parents[1], deaths[0] if deaths else None, fault)
        with disk:
            while command is not None:
                command()
                command = next(given, None)
        done.append(disk.done)
        if not disk.hit:
            return done
        deaths.pop(0)


def result(run_dir):
    """Every file of the run but those with the time in them; what a kill may leave besides does not count.

    That is unfinished files, and episodes that have been learned from, which the next iteration would delete.
    """
    found = {str(p.relative_to(run_dir)): p for p in run_dir.rglob("*") if p.is_file() and ".tmp" not in p.name}
    return {
        name: path.read_bytes()
        for name, path in found.items()
        if name not in {".lock", "run.json"} and not name.startswith(("events/", "episodes/"))
    }


def differing(found, expected):
    """Names of the files that are not the same."""
    return sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))


PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what runs in its background
sys.path.insert(0, sys.argv[1])
import probe
from metrpo.commands import main
with probe.registered():
    sys.exit(main.main(sys.argv[2:]))
"""


def process_line(run_dir, *more):
    """The same as a process of its own."""
    return [sys.executable, "-c", PROGRAM, str(SUPPORT), *command_line(run_dir, *more)]
