"""The command line: wrong input gets one clear message and exit code 2, and leaves every file as it was."""

import dataclasses
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest

import metrpo
from metrpo.commands.command_table import NAMES
from metrpo.commands.default_dir import default_run_dir
from metrpo.commands.main import main
from metrpo.commands.parse import parse
from metrpo.config import Config
from metrpo.console.interrupt import Stopped
from metrpo.launch.run_spec import RunSpec
from metrpo.presets import preset
from metrpo.run import derived_files, installation, machine, video
from metrpo.run.directory import RunDirectory
from metrpo.run.policy_file import load_policy
from metrpo.run.video import VideoError


class Weights(NamedTuple):
    layers: tuple
    log_std: Any


class State(NamedTuple):
    iteration: int
    real_steps: int
    policy: Weights


def a_state(iteration: int) -> State:
    layers = ((np.zeros((10, 2), np.float32), np.full(2, 0.1, np.float32)),)
    return State(iteration, 200 * iteration, Weights(layers, np.zeros(2, np.float32)))


EARNED: dict[int, float] = {}
"""Iteration -> its return, where that is not 1.5."""


def train(config: Config, run_dir: Path, progress: Any, callbacks: Any = ()) -> None:
    """Stands in for training.train: learns nothing, but keeps its promises to the disk."""
    with RunDirectory(run_dir, config) as run:
        state = run.load(a_state(0)) or a_state(0)
        while state.iteration < config.iterations:
            progress.begin(state.iteration + 1, config.iterations)
            state = a_state(state.iteration + 1)
            row = {
                "iteration": state.iteration,
                "real_steps": state.real_steps,
                "return_real": EARNED.get(state.iteration, 1.5),
                "return_real_std": 0.5,
            }
            progress.end(run.save(state, row))


@pytest.fixture(autouse=True)
def _stubs(monkeypatch, tmp_path):
    stub = types.ModuleType("metrpo.training")
    stub.train = train  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "metrpo.training", stub)
    monkeypatch.setattr(derived_files, "draw_curve", lambda rows, path, title, *_: None)
    monkeypatch.setattr("metrpo.evaluation.record", lambda make_env, policy, path, seed: path)
    monkeypatch.chdir(tmp_path)
    handler = signal.getsignal(signal.SIGTERM)
    with mock.patch.dict(os.environ):
        yield
    signal.signal(signal.SIGTERM, handler)


def contents(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file() and p.name != ".lock"}


def run(*arguments: str) -> int:
    return main(arguments)


def test_train_ends_by_naming_its_files(capsys):
    assert run("train", "swimmer", "--iterations", "2") == 0
    out = capsys.readouterr().out
    base = "runs/Swimmer-fast-seed0"
    for text in (
        "return 1.5 ± 0.5 after 400 real steps",
        f"{base}/curve.png",
        f"{base}/policy.npz",
        f"{base}/video.mp4",
    ):
        assert text in out
    assert load_policy(base).info.task == "Swimmer"
    assert "best" not in out, "it is the last one"


def test_train_names_the_best_policy_where_it_is_another(capsys, monkeypatch):
    monkeypatch.setitem(EARNED, 1, 7.25)
    assert run("train", "swimmer", "--iterations", "2", "--run-dir", "a") == 0
    assert "  best     a/best/policy.npz (return 7.2 after 200 real steps)" in capsys.readouterr().out


def test_the_same_command_goes_on_and_a_larger_budget_too(capsys):
    assert run("train", "Swimmer", "--iterations", "2", "--run-dir", "a") == 0
    assert run("train", "Swimmer", "--iterations", "3", "--run-dir", "a") == 0
    assert "iteration 3/3" in capsys.readouterr().out
    assert [row["iteration"] for row in metrpo.read_metrics("a/metrics.csv")] == [1, 2, 3]


def test_a_video_is_made_again_only_for_another_policy(capsys, monkeypatch):
    made = []
    write = lambda make_env, policy, path, seed: (made.append(1), path.write_text("video"), path)[-1]  # noqa: E731
    monkeypatch.setattr("metrpo.evaluation.record", write)
    for iterations, videos in ((1, 1), (1, 1), (2, 2)):
        assert run("train", "Swimmer", "--iterations", str(iterations), "--run-dir", "a") == 0
        assert len(made) == videos
        assert "a/video.mp4" in capsys.readouterr().out


TEN = ["--ensemble.members", "10"]


@pytest.mark.parametrize("words", [("--real-steps", "0"), ("--real_steps=0",)])
def test_learning_from_a_log_alone_has_a_budget_of_iterations(words):
    options = parse(["train", "Pendulum-v1", "--data", "log.npz", *words, "--iterations", "2"])
    assert (options.real_steps, options.iterations) == (0, 2)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), Stopped(signal.SIGINT)])
def test_a_process_that_was_stopped_ends_without_a_traceback_of_one_more_ctrl_c(error, monkeypatch, capsys):
    def stopped(_):
        raise error

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(sys.modules["metrpo.commands.main"], "parse", stopped)
    try:
        assert main(["doctor"]) == 130
        assert signal.getsignal(signal.SIGINT) is before, "a program that calls it goes on"
        monkeypatch.setattr(sys, "argv", ["metrpo", "doctor"])
        assert main() == 130
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_default_directory_follows_from_the_settings(capsys):
    """The README's own order: the usual run, then one with a setting of its own."""
    usual, ten = "runs/Swimmer-fast-seed0", "runs/Swimmer-fast-seed0-ensemble.members=10"
    for command, where, iterations in (
        (["Swimmer"], usual, 1),
        (["Swimmer", *TEN], ten, 1),
        (["Swimmer", *TEN], ten, 2),
    ):
        assert run("train", *command, "--iterations", str(iterations)) == 0
        assert f"{where}/policy.npz" in capsys.readouterr().out
        assert len(metrpo.read_metrics(f"{where}/metrics.csv")) == iterations
    assert sorted(path.name for path in Path("runs").iterdir()) == [Path(usual).name, Path(ten).name]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ([], "Swimmer-fast-seed0"),
        (["--iterations", "7"], "Swimmer-fast-seed0"),
        (["--system", "k-1", "--seed", "3"], "Swimmer-k-1-fast-seed3"),
        (["--trpo.max-kl", "0.02", "--deterministic"], "Swimmer-fast-seed0-deterministic=True,trpo.max_kl=0.02"),
        (["--ensemble.hidden", "64", "32"], "Swimmer-fast-seed0-ensemble.hidden=64x32"),
        (["--data", "logs/a b.npz"], "Swimmer-fast-seed0-data=logs-a-b.npz"),
        ([*TEN, "--seed", "1", "--fit.max-steps", "9", "--imagine.steps", "8", "--trpo.max-kl", "1"], "4-settings-"),
    ],
)
def test_the_default_directory_is_named_after_what_is_changed(options, name):
    options = parse(["train", "Swimmer", *options])
    config, path = options.config, options.directory
    assert (path.name == f"Swimmer-fast-seed0{name}") or path.name == name or "settings" in name
    if "settings" in name:
        assert re.fullmatch(r"Swimmer-fast-seed1-4-settings-[0-9a-f]{8}", path.name)
        other = dataclasses.replace(config, trpo=dataclasses.replace(config.trpo, max_kl=2.0))
        assert default_run_dir(other) != path == default_run_dir(dataclasses.replace(config, iterations=99))


def test_a_run_that_an_older_version_put_elsewhere_goes_on_there(capsys):
    assert run("train", "Swimmer", *TEN, "--iterations", "1", "--run-dir", "runs/Swimmer-fast-seed0") == 0
    assert run("train", "Swimmer", *TEN, "--iterations", "2") == 0
    assert [path.name for path in Path("runs").iterdir()] == ["Swimmer-fast-seed0"]


def test_settings_start_from_the_preset_of_the_task():
    options = ["--seed", "4", "--preset", "paper", "--ensemble.members", "10", "--trpo.max-kl", "0.02"]
    options += ["--ensemble.hidden", "256", "128", "--collect.steps", "200", "--iterations", "1", "--deterministic"]
    assert run("train", "HALFCHEETAH", *options, "--run-dir", "a") == 0
    expected = preset("HalfCheetah", "paper", seed=4, iterations=1, deterministic=True)
    expected = dataclasses.replace(
        expected,
        ensemble=dataclasses.replace(expected.ensemble, members=10, hidden=(256, 128)),
        trpo=dataclasses.replace(expected.trpo, max_kl=0.02),
        collect=dataclasses.replace(expected.collect, steps=200),
    )
    assert json.loads(Path("a/config.json").read_text()) == json.loads(json.dumps(dataclasses.asdict(expected)))


WRONG = [
    (["train", "Swimer"], "unknown task 'Swimer': did you mean Swimmer"),
    (["train", "mine.py"], "unknown task 'mine.py': which task in that file? mine.py:NAME; known tasks: Swimmer"),
    (["train", "Swimmer", "--ensemble.members", "0"], "ensemble.members: expected at least 1, got 0"),
    (["train", "Swimmer", "--ensemble.members", "many"], "--ensemble.members: expected a whole number, got many"),
    (["train", "Swimmer", "--trpo.maxkl", "3"], "unknown option --trpo.maxkl, did you mean --trpo.max-kl?"),
    (["train", "Swimmer", "--max_kl=3"], "unknown option --max_kl, did you mean --trpo.max-kl?"),
    (["train", "Swimmer", "--no-vido"], "did you mean --no-video?"),
    (["train", "Swimmer", "Ant"], "expected fewer words"),
    (["train", "Swimmer", "--system", "pop"], "validate-real, validate-trpo_mean"),
    (["trian", "Swimmer"], "unknown command 'trian', did you mean train?"),
    (["zzz"], "unknown command 'zzz'; metrpo --help lists them"),
    (["--seed", "3", "train"], "expected a command before --seed"),
    (["sweep", "--jobs", "all"], "--jobs: expected a whole number, got all"),
    (["sweep", "--seed", "0"], "did you mean --seeds?"),
    (["train", "Swimmer", "--ensemble.member", "3"], "--ensemble.member, did you mean --ensemble.members?"),
    (["train", "Swimmer", "--trpo.max-kl", "nan"], "trpo.max_kl: expected a finite number > 0, got nan"),
    (["train", "Swimmer", "--preset", "slow"], "--preset"),
    (["train", "Swimmer", "--config.task", "Ant"], "--config.task"),
    (["train", "Swimmer", "--task", "Ant"], "--task"),
    (
        ["train", "Swimmer", "--iterations", "3", "--real-steps", "100"],
        "expected --iterations or --real-steps, got both",
    ),
    (
        ["tune", "--search", "a=1,2", "--iterations=3", "--real_steps=9"],
        "expected --iterations or --real-steps, got both",
    ),
    (["train"], "metrpo: train needs a task: metrpo train TASK; metrpo tasks lists them"),
    (["init", "--task", "x", "Swimmer"], "metrpo: init takes TASK without --task: metrpo init TASK"),
    (["evaluate", "--dir=a"], "metrpo: evaluate takes DIR without --dir: metrpo evaluate DIR"),
    (["improve", "--json"], "metrpo: improve needs a run directory: metrpo improve DIR"),
    (["reproduce"], "metrpo: reproduce needs a figure: metrpo reproduce FIGURE"),
    (["watch"], "metrpo: watch needs run directories, or folders with runs inside: metrpo watch runs"),
    (["train", "Swimmer", "--policy.no-normalis"], "did you mean --policy.no-normalise?"),
    (["sweep", "--set", "ensemble.membrs=3"], "unknown setting 'ensemble.membrs' (see: metrpo train --help-all)"),
    (["train", "Swimmer", "--trpo.max-kl"], "see metrpo train --help-all"),
    (["train", "Swimmer", "--seed"], "--seed"),
    (["frobnicate"], "frobnicate"),
    (["evaluate", "nowhere"], "nowhere holds no policy"),
    (["render", "nowhere"], "nowhere holds no policy"),
    (["render", "nowhere", "--seed", "-1"], "seed: expected at least 0, got -1"),
    (["evaluate", "nowhere", "--seed", "-1"], "seed: expected at least 0, got -1"),
    (["evaluate"], "metrpo: evaluate needs a run directory: metrpo evaluate DIR"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_wrong_input_is_one_message_and_exit_code_2(capsys, tmp_path, arguments, message):
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert out == ""
    assert err.count("\n") == err.count("metrpo: ") == 1, "said once, and in one line"
    assert not any(tmp_path.iterdir())


def test_an_unwritable_directory_is_one_message(capsys, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert run("train", "Swimmer", "--run-dir", "file/run") == 2
    assert "metrpo: cannot use file/run as a run directory: Not a directory" in capsys.readouterr().err
    assert contents(tmp_path) == {"file": b"mine"}


@pytest.mark.parametrize(
    ("damage", "arguments", "message"),
    [
        (lambda p: None, ["--trpo.max-kl", "0.02"], "trpo.max_kl  directory has 0.01, asked for 0.02"),
        (lambda p: None, ["--preset", "paper"], "asked for paper"),
        (
            lambda p: (p / "run.json").write_text('{"format": 9, "metrpo": "7.0"}'),
            [],
            "has format 9 (written by metrpo 7.0)",
        ),
        (
            lambda p: [os.truncate(c, 99) for c in (p / "checkpoints").iterdir()],
            [],
            "is damaged (truncated or edited)",
        ),
        (lambda p: (p / "config.json").write_text("?"), [], "config.json is damaged"),
    ],
)
def test_a_directory_that_does_not_fit_is_left_as_it_was(capsys, tmp_path, damage, arguments, message):
    assert run("train", "Swimmer", "--iterations", "2", "--run-dir", "a") == 0
    damage(tmp_path / "a")
    before = contents(tmp_path)
    capsys.readouterr()
    assert run("train", "Swimmer", "--iterations", "3", "--run-dir", "a", *arguments) == 2
    out, err = capsys.readouterr()
    assert (message in err, out) == (True, "")
    assert err.count("metrpo: ") == 1
    assert contents(tmp_path) == before


def test_evaluate_prints_the_returns(capsys):
    run("train", "Swimmer", "--iterations", "1", "--run-dir", "a")
    capsys.readouterr()
    assert run("evaluate", "a", "--episodes", "3", "--seed", "5", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result["returns"]) == result["episodes"] == 3
    assert result["mean"] == pytest.approx(np.mean(result["returns"]))
    assert (result["min"], result["max"]) == (min(result["returns"]), max(result["returns"]))
    assert metrpo.evaluate("a", episodes=3, seed=5).summary() == result
    assert run("evaluate", "a", "--episodes", "3", "--seed", "5") == 0
    assert f"return {result['mean']:.2f} ± {result['std']:.2f}" in capsys.readouterr().out
    assert run("evaluate", "a", "--episodes", "0") == 2
    assert "episodes: expected at least 1, got 0" in capsys.readouterr().err


def test_evaluating_a_function_needs_a_task():
    with pytest.raises(metrpo.ConfigError, match="expected a task"):
        metrpo.evaluate(lambda state: np.zeros(2))
    assert metrpo.evaluate(lambda state: np.zeros(2), "swimmer", episodes=1).task == "Swimmer"


@pytest.mark.parametrize("command", ["evaluate", "render", "export", "improve", "train"])
def test_a_file_in_place_of_a_run_directory_is_called_one(capsys, tmp_path, command):
    (tmp_path / "mine.py").write_text("")
    before = contents(tmp_path)
    assert run(*(["train", "Swimmer", "--run-dir"] if command == "train" else [command]), "mine.py") == 2
    said = capsys.readouterr().err
    assert said.startswith("metrpo: mine.py")
    assert "expected a run directory" in said or "--run-dir expects a directory" in said
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("command", "file"),
    [("render", "video.mp4"), ("export", "policy.py"), ("report", "page.html"), ("plot", "curves.svg")],
)
def test_every_file_that_is_asked_for_may_lie_in_a_new_folder(capsys, monkeypatch, command, file):
    assert run("train", "Swimmer", "--iterations", "1", "--run-dir", "a", "--no-video") == 0
    frames = ([np.zeros((16, 16, 3), np.uint8)] * 2, 20)
    monkeypatch.setattr("metrpo.evaluation.record", video.record)
    monkeypatch.setattr(video, "_episode", lambda *_: frames)
    assert run(command, "a", "--out", f"new/folder/{file}") == 0
    assert Path("new/folder", file).exists()
    assert run(command, "--help") == 0
    assert "missing folders are created" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_render_names_its_file(capsys):
    run("train", "Swimmer", "--iterations", "1", "--run-dir", "a")
    capsys.readouterr()
    assert run("render", "a", "--out", "swim.gif") == 0
    assert capsys.readouterr().out == "swim.gif\n"


def test_no_video_costs_the_video_only(capsys, monkeypatch):
    def broken(*_: Any) -> Path:
        raise VideoError("no video encoder: install it")

    monkeypatch.setattr("metrpo.evaluation.record", broken)
    assert run("train", "Swimmer", "--iterations", "1", "--run-dir", "a") == 0
    assert "video    none: no video encoder: install it; --no-video makes none" in capsys.readouterr().out
    assert run("render", "a") == 2
    assert capsys.readouterr().err == "metrpo: no video encoder: install it\n"


def test_tasks_lists_them(capsys):
    assert run("tasks", "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in rows} == set(metrpo.tasks())
    assert run("tasks") == 0
    assert all(name in capsys.readouterr().out for name in ["HalfCheetah"])


def test_doctor_finds_what_is_here_and_what_is_missing(capsys, monkeypatch):
    monkeypatch.setattr(installation.video, "gl_backend", lambda: None)
    assert run("doctor", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["versions"]["jax"]
    assert found["devices"]
    assert "no OpenGL" in found["hints"][0]
    monkeypatch.setitem(sys.modules, "optax", None)
    assert run("doctor") == 1
    out = capsys.readouterr().out
    assert "problem: optax does not import" in out
    assert "training cannot work here" in out


@pytest.mark.parametrize("command", ["", *NAMES])
def test_every_help_has_examples(capsys, command):
    assert run(*command.split(), "--help") == 0
    out = capsys.readouterr().out
    assert f"metrpo {command or 'train Swimmer'}" in out.replace("usage: metrpo", "")
    examples = [line for line in out.splitlines() if line.startswith("    metrpo ")]
    assert all(len(line) <= 80 for line in examples), "to be copied, an example must not be wrapped"
    assert len(examples) >= bool(command)


def test_the_list_of_commands_fits_a_screen_and_names_all(capsys):
    assert run("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    rows = [line for line in lines[1:] if line[13:14] == " " and line[14:15].isalpha()]
    assert sorted(line[14:].split()[0] for line in rows) == sorted(NAMES)


def options_in(text):
    return re.findall(r"^\W{1,4}(--\w[\w.-]+)", text, re.MULTILINE)


@pytest.mark.parametrize("command", ["train", "init"])
def test_help_shows_what_people_use_and_help_all_the_rest(capsys, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "80")
    assert run(command, "Swimmer", "--help") == 0
    few = options_in(text := capsys.readouterr().out)
    assert 9 <= len(few) <= 14
    assert {"--seed", "--iterations", "--real-steps", "--preset", "--system", "--run-dir", "--device"} <= set(few)
    assert f"metrpo {command} --help-all" in text
    assert run(command, "Swimmer", "--help-all") == 0
    assert len(options_in(capsys.readouterr().out)) > 50
    assert run("evaluate", "--help-all") == 0, "the same as --help"
    assert "--episodes" in capsys.readouterr().out


def test_switches_and_methods_read_the_right_way(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for command, option, meaning in (
        ("train", "--no-video", "Do not record"),
        ("reproduce", "--no-run", "Run nothing"),
        ("bench", "--no-iterations", "Skip whole iterations"),
    ):
        assert run(command, "--help") == 0
        text = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert f"{option} {meaning}" in text
        assert not re.search(r"\(default: (None|True|False)\)", text)
    assert run("train", "--help-all") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "ppo and ddpg are Stable-Baselines3's" in text, "the system"
    assert "This ppo learns in the ensemble" in text, "the improver"


def test_help_fills_its_lines(capsys, monkeypatch):
    """Where the source breaks a line says nothing to a reader."""
    monkeypatch.setenv("COLUMNS", "100")
    assert run("train", "--help-all") == 0
    texts = (line.replace("│", " ").rstrip() for line in capsys.readouterr().out.splitlines())
    lines = [line for line in texts if line.startswith(" " * 8)]
    assert len(lines) > 150
    broken = [
        (line, following)
        for line, following in itertools.pairwise(lines)
        if line[-1:].isalpha() and following.strip()[:1].islower() and len(f"{line} {following.split()[0]}") < 97
    ]
    assert not broken


@pytest.mark.parametrize("preset_", ["fast", "paper"])
def test_a_switch_has_both_forms_whatever_the_preset(capsys, preset_):
    assert run("train", "Swimmer", "--preset", preset_, "--help-all") == 0
    assert "--policy.normalise, --policy.no-normalise" in capsys.readouterr().out
    for value, option in ((True, "--policy.normalise"), (False, "--policy.no-normalise")):
        assert parse(["train", "Swimmer", "--preset", preset_, option]).policy.normalise is value


def test_the_command_of_a_run_sets_what_is_on_or_off():
    """Sweeps and searches give it to `metrpo train`."""
    for value, preset_ in ((True, "paper"), (False, "fast")):
        changed = RunSpec("Swimmer", "me-trpo", 0, (("policy.normalise", value), ("deterministic", True)), preset_, "")
        config = parse(["train", *changed.arguments]).config
        assert config == changed.config


@pytest.mark.parametrize("command", NAMES)
def test_help_has_no_empty_default_and_no_words_of_the_parser(capsys, command):
    assert run(command, "--help-all") == 0
    text = capsys.readouterr().out
    assert not re.search(r"\(default: ?\)|mutually exclusive|can be overridden", text)
    if command in ("report", "plot", "watch"):
        assert "folders with runs inside. (required)" in " ".join(text.replace("│", " ").split())


def test_help_shows_the_defaults_of_task_and_preset(capsys):
    assert run("train", "Humanoid", "--preset", "paper", "--help-all") == 0
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "(default: 100 50 25)" in out
    assert run("train", "Swimmer", "--help-all") == 0
    assert "(default: 32 32)" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_every_public_name_is_there():
    stub = sys.modules["metrpo.training"]
    for name in ("State", "init", "step"):
        setattr(stub, name, None)
    assert [name for name in metrpo.__all__ if not hasattr(metrpo, name)] == []
    assert dir(metrpo) == sorted(metrpo.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = metrpo.nothing


def test_version_and_no_arguments(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("metrpo ")
    with mock.patch.object(sys, "argv", ["metrpo"]):
        assert main() == 0
    assert "usage: metrpo" in capsys.readouterr().out


def test_help_comes_without_jax_and_mujoco():
    code = "import sys; from metrpo.commands.main import main; main(['--help']); main(['evaluate', '--help']); "
    code += "print([m for m in ('jax', 'mujoco', 'gymnasium', 'numpy') if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "[]"


def test_the_environment_is_ready_before_jax(monkeypatch, tmp_path):
    for name in ("JAX_PLATFORMS", "XLA_FLAGS", "NPROC", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(machine, "may_have_gpu", lambda: False)
    machine.set_variables(None, deterministic=False)
    assert os.environ["JAX_PLATFORMS"] == "cpu"
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "metrpo" / "jax")
    cores = len(os.sched_getaffinity(0))
    patient = " ".join(machine.PATIENT)
    assert os.environ["XLA_FLAGS"] == f"--xla_force_host_platform_device_count={min(cores, 8)} {patient}"
    machine.set_variables(None, deterministic=False)
    assert [os.environ["XLA_FLAGS"].count(f) for f in ("device_count", "terminate_timeout")] == [1, 1]
    monkeypatch.setenv("XLA_FLAGS", "--xla_mine=1")
    monkeypatch.setenv("JAX_PLATFORMS", "tpu")
    machine.set_variables(None, deterministic=True)
    flags = "--xla_mine=1 --xla_force_host_platform_device_count=1 --xla_cpu_multi_thread_eigen=false"
    flags += f" {patient}"
    assert os.environ["XLA_FLAGS"] == flags
    assert (os.environ["JAX_PLATFORMS"], os.environ["NPROC"]) == ("tpu", "1")
    machine.set_variables("cpu", deterministic=False)
    assert os.environ["JAX_PLATFORMS"] == "cpu"


def test_a_gpu_multiplies_in_float32_unless_told_otherwise(monkeypatch, tmp_path):
    for name in ("JAX_PLATFORMS", "XLA_FLAGS", "NPROC", "JAX_COMPILATION_CACHE_DIR", "JAX_DEFAULT_MATMUL_PRECISION"):
        monkeypatch.setenv(name, "")  # put back at the end
        monkeypatch.delenv(name)
    monkeypatch.setattr(machine, "_require_device", lambda device: None)
    machine.prepare("cpu", deterministic=False)
    assert "JAX_DEFAULT_MATMUL_PRECISION" not in os.environ
    machine.prepare("gpu", deterministic=False)
    assert os.environ["JAX_DEFAULT_MATMUL_PRECISION"] == "highest"
    monkeypatch.setenv("JAX_DEFAULT_MATMUL_PRECISION", "tensorfloat32")
    machine.prepare("gpu", deterministic=False)
    assert os.environ["JAX_DEFAULT_MATMUL_PRECISION"] == "tensorfloat32"


@pytest.mark.parametrize("cuda", [12, 13])
def test_either_cuda_plugin_is_a_gpu_that_jax_may_use(monkeypatch, cuda):
    monkeypatch.setattr(machine, "has_nvidia", lambda: True)
    monkeypatch.setattr(machine, "find_spec", lambda name: name == f"jax_cuda{cuda}_plugin" or None)
    assert machine.may_have_gpu()
    monkeypatch.setattr(machine, "has_nvidia", lambda: False)
    assert not machine.may_have_gpu() or os.path.exists("/dev/kfd") or sys.platform != "linux"


def test_deterministic_leaves_xla_one_thread():
    code = (
        "import os; from metrpo.run.machine import prepare; prepare('cpu', True); "
        "import jax.numpy as jnp; jnp.ones(3).sum(); "
        "print(sum('XLA' in open(f'/proc/self/task/{t}/comm').read() for t in os.listdir('/proc/self/task')))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (ran.stdout, ran.stderr) == ("1\n", "")


NO_GPU = pytest.mark.skipif(machine.has_nvidia() or Path("/dev/kfd").exists(), reason="there may be a GPU")


def program(*arguments: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """The command as a process of its own, with these environment variables (None: unset)."""
    merged = {name: value for name, value in (os.environ | environment).items() if value is not None}
    command = [sys.executable, "-m", "metrpo", *arguments]
    return subprocess.run(command, env=merged, capture_output=True, text=True, encoding="utf-8", errors="replace")


@NO_GPU
@pytest.mark.parametrize(("platforms", "devices"), [(None, 1), ("cpu", 2)])
def test_a_gpu_that_is_not_there_is_one_message(platforms, devices):
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {"JAX_PLATFORMS": platforms, "XLA_FLAGS": flags}
    ran = program("train", "Swimmer", "--device", "gpu", "--run-dir", "a", **environment)
    assert ran.returncode == 2
    assert "metrpo: device: expected a GPU, JAX finds only the CPU; install JAX for it (pip install " in ran.stderr
    assert "(pip install 'jax[cuda13]', or 'jax[cuda12]'" in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert not Path("a").exists()


@NO_GPU
@pytest.mark.parametrize("platforms", ["cuda", "nonsense"])
def test_a_platform_that_jax_cannot_use_is_one_message(platforms):
    ran = program("train", "Swimmer", "--run-dir", "a", JAX_PLATFORMS=platforms)
    assert ran.returncode == 2
    assert f"metrpo: JAX_PLATFORMS={platforms}: JAX cannot use it (" in ran.stderr
    assert ran.stderr.count("\n") == 1


def test_doctor_names_a_platform_that_jax_cannot_use(capsys, monkeypatch):
    def unusable() -> list[str]:
        raise metrpo.MetrpoError("JAX_PLATFORMS=tpu: JAX cannot use it (none)")

    monkeypatch.setattr(installation, "device_names", unusable)
    monkeypatch.setenv("JAX_PLATFORMS", "tpu")
    assert run("doctor") == 1
    assert "problem: JAX_PLATFORMS=tpu: JAX cannot use it (none): unset JAX_PLATFORMS" in capsys.readouterr().out


def test_the_cpu_that_is_asked_for_wins_over_the_users_variable():
    code = "from metrpo.run import machine; machine.prepare('cpu', True); print(machine.device_names())"
    ran = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"JAX_PLATFORMS": "cuda"}, capture_output=True, text=True
    )
    assert ran.stdout == "['cpu: cpu']\n", ran.stderr


def test_any_cuda_plugin_is_a_gpu_that_may_be_there(monkeypatch):
    monkeypatch.setattr(machine, "has_nvidia", lambda: True)
    monkeypatch.setattr(machine, "find_spec", lambda name: name if name == "jax_cuda13_plugin" else None)
    assert machine.may_have_gpu()


STOPPED = """
import signal, sys, time, types
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what runs in its background
stub = types.ModuleType("metrpo.training")
def train(config, run_dir, progress, callbacks):
    progress.begin(1, 2)
    print("training", flush=True)
    time.sleep(60)
stub.train = train
sys.modules["metrpo.training"] = stub
from metrpo.commands.main import main
sys.exit(main(["train", "Swimmer", "--run-dir", "a"]))
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_says_how_to_go_on(number, code):
    command = [sys.executable, "-c", STOPPED]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "training\n"
        process.send_signal(number)
        _, err = process.communicate(timeout=30)
    assert process.returncode == code
    kept = "a keeps every finished iteration and real episode. The same command resumes."
    assert err == f"metrpo: stopped; {kept}\n\n  metrpo train Swimmer --run-dir a\n\n"


def test_a_damaged_best_policy_is_named_at_the_end(capsys, caplog, monkeypatch):
    monkeypatch.setitem(EARNED, 1, 7.25)
    assert run("train", "swimmer", "--iterations", "2", "--run-dir", "a") == 0
    Path("a/best/policy.npz").write_bytes(b"torn")
    assert run("train", "swimmer", "--iterations", "2", "--run-dir", "a") == 0
    assert "a/best/policy.npz is damaged" in caplog.text + capsys.readouterr().err
