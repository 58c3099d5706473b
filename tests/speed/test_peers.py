"""Peers: an environment that is made once and whole, and workers that answer, fail or die."""

import ast
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from metrpo.errors import MetrpoError
from metrpo.speed import peer_loop, peers

BENCH = Path(peers.__file__).parent

ANSWERS = f"""
import os, sys
sys.path.insert(0, {str(BENCH)!r})
from peer_loop import serve

calls = []

def build():
    print("built", flush=True)  # libraries print: it must not come between the answers
    os.system("echo from a child")
    calls.append("build")
    return lambda: calls.append("once") or float(len(calls))

def fails():
    raise ValueError("no such layer")

def variables():
    assert "PYTHONPATH" not in os.environ
    return lambda: float(os.environ["OMP_NUM_THREADS"])

serve({{"count": build, "fails": fails, "variables": variables}})
"""

DIES = """
import sys
sys.stdin.readline()
print("out of luck", file=sys.stderr)
sys.exit(3)
"""

LINGERS = """
import sys, time
sys.stdin.readline()
print('{"error": "slow"}', flush=True)
time.sleep(60)
"""


@pytest.fixture
def worker(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "environment", lambda: Path(sys.executable))

    def start(script):
        path = tmp_path / "worker.py"
        path.write_text(script)
        monkeypatch.setitem(peers.SCRIPTS, "pytorch", path)
        return peers.PeerWorker("pytorch")

    return start


@pytest.fixture
def commands(tmp_path, monkeypatch):
    """The commands that would set the environment up; `fail` names an argument of the one that fails."""

    class Commands(list):
        fail: str | None = None

    run = Commands()

    def pretend(command, **options):
        run.append(command)
        assert "PYTHONPATH" not in options["env"]
        if "venv" in command:
            python = Path(command[-1]) / "bin" / "python"
            python.parent.mkdir(parents=True)
            python.touch()
        failed = run.fail in command
        return subprocess.CompletedProcess(command, int(failed), "", "No matching distribution" if failed else "")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", "ours")
    monkeypatch.setattr(peers.subprocess, "run", pretend)
    monkeypatch.setattr(sys, "platform", "linux")
    return run


def test_the_work_is_built_once_and_warmed_up_once(worker):
    with worker(ANSWERS) as peer:
        assert peer.measure("count", 2) == [3.0, 4.0]  # after one build and one unmeasured repetition
        assert peer.measure("count", 1) == [5.0]


def test_seconds_are_those_of_one_call(monkeypatch):
    clock, calls = iter([10.0, 16.0]), []
    monkeypatch.setattr(peer_loop, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    assert peer_loop.timed(lambda: calls.append(1), 3) == 2.0
    assert len(calls) == 3


def test_a_worker_may_use_our_cores_but_not_our_packages(worker, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(BENCH))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2, 5}, raising=False)
    with worker(ANSWERS) as peer:
        assert peer.measure("variables", 1) == [3.0]


def test_an_error_names_peer_and_work_and_the_worker_goes_on(worker):
    with worker(ANSWERS) as peer:
        with pytest.raises(MetrpoError, match="pytorch, fails: ValueError: no such layer"):
            peer.measure("fails", 1)
        with pytest.raises(MetrpoError, match="pytorch, nothing: ValueError: expected one of count, fails"):
            peer.measure("nothing", 1)
        assert peer.measure("count", 1) == [3.0]


def test_a_worker_that_dies_is_reported_with_its_last_words(worker):
    with worker(DIES) as peer:
        for _ in range(2):
            with pytest.raises(MetrpoError, match=r"pytorch, trpo: .*exit code 3\): out of luck"):
                peer.measure("trpo", 1)


def test_a_worker_is_killed_at_once_when_its_user_fails(worker):
    def fail(peer):
        with peer:
            peer.measure("trpo", 1)

    start = time.monotonic()
    with pytest.raises(MetrpoError, match="pytorch, trpo: slow"):
        fail(worker(LINGERS))
    assert time.monotonic() - start < 4


def test_a_python_that_does_not_start_is_reported(worker, monkeypatch, tmp_path):
    peer = worker(ANSWERS)
    monkeypatch.setattr(peers, "environment", lambda: tmp_path / "bin" / "python")
    with pytest.raises(MetrpoError, match="pytorch: cannot start"):
        peer.__enter__()


def test_unknown_peers_are_refused():
    with pytest.raises(MetrpoError, match="expected one of mbrl-lib, sb3-contrib, pytorch, got tensorflow"):
        peers.PeerWorker("tensorflow")


def test_the_environment_is_made_once(commands, tmp_path):
    assert not peers.is_installed()
    python = peers.environment()
    assert python.is_relative_to(tmp_path / "metrpo")
    assert commands[0][1:3] == ["-m", "venv"]
    assert [r for r in (*peers.REQUIREMENTS, *peers.ALONE) if not any(r in c for c in commands)] == []
    assert all(c[0] == str(python) for c in commands[1:])
    made = len(commands)
    assert peers.is_installed()
    assert peers.environment() == python
    assert len(commands) == made


def test_an_interrupted_environment_is_made_again_from_scratch(commands):
    python = peers.environment()
    made = len(commands)
    (python.parent.parent / "complete").unlink()
    (python.parent / "leftover").touch()
    assert not peers.is_installed()
    peers.environment()
    assert len(commands) == 2 * made
    assert not (python.parent / "leftover").exists()


def test_an_environment_without_its_python_is_made_again(commands):
    python = peers.environment()
    python.unlink()
    peers.environment()
    assert python.exists()


def test_other_requirements_are_another_environment(commands, monkeypatch):
    before = peers.environment()
    monkeypatch.setattr(peers, "REQUIREMENTS", ("torch==99",))
    assert peers.environment() != before


@pytest.mark.parametrize(
    ("fail", "text"),
    [
        ("venv", "cannot make a virtual environment .exit code 1.; install Python's venv module"),
        (peers.REQUIREMENTS[0], "cannot install torch==.*look at the network"),
        ("--no-deps", "cannot install mbrl==.*look at the network"),
        ("-c", "cannot import the peers"),
    ],
)
def test_a_failed_step_says_what_to_do_and_leaves_no_stamp(commands, fail, text):
    commands.fail = fail
    with pytest.raises(MetrpoError, match=rf"{text}.*\nNo matching distribution"):
        peers.environment()
    assert not peers.is_installed()
    commands.fail = None
    peers.environment()
    assert peers.is_installed()


def test_a_cache_that_cannot_be_written_is_reported(commands, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(MetrpoError, match="set XDG_CACHE_HOME to a directory that can be written"):
        peers.environment()


@pytest.mark.parametrize("peer", peers.PEERS)
def test_the_scripts_offer_the_work_that_we_name(peer):
    tree = ast.parse(peers.SCRIPTS[peer].read_text())
    (table,) = [n.value for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "WORK"]
    names = [ast.literal_eval(key) for key in table.keys]
    assert names == list(peers.WORK[peer])
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("script", sorted(BENCH.glob("peer_*.py")), ids=lambda path: path.name)
def test_the_scripts_run_where_metrpo_is_not_installed(script):
    tree = ast.parse(script.read_text())
    modules = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    modules += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    assert not [name for name in modules if name.split(".")[0] == "metrpo"]


def test_requests_and_answers_are_one_line_of_json(tmp_path):
    script = tmp_path / "worker.py"
    script.write_text(ANSWERS)
    requests = "".join(json.dumps({"work": name, "repeat": 1}) + "\n" for name in ("count", "fails"))
    done = subprocess.run([sys.executable, str(script)], input=requests, capture_output=True, text=True, check=True)
    assert [json.loads(line) for line in done.stdout.splitlines()] == [
        {"seconds": [3.0]},
        {"error": "ValueError: no such layer"},
    ]
    assert done.stderr == "built\nfrom a child\n"
