"""The command `make pour`: what it refuses, and how it goes on after a stop. That it pours is tested elsewhere."""

import importlib.util
import json
import shlex
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import symgraph as sg

ROOT = Path(__file__).parents[1]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Call the command as in a terminal, and be stopped, as by Ctrl-C, where learning begins."""
    spec = importlib.util.spec_from_file_location("pour", ROOT / "docs/examples/pour.py")
    pour = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pour)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAKELEVEL", raising=False)
    monkeypatch.setattr(sys, "argv", ["pour.py"])
    app = typer.Typer()
    app.command()(pour.main)

    def stop(world, name, options, folder):
        run.options = options
        raise KeyboardInterrupt

    monkeypatch.setattr(pour, "loop_in", stop)

    def run(*words):
        return CliRunner().invoke(app, [str(word) for word in words])

    return run


def test_options_are_kept_and_need_not_be_repeated(run, tmp_path):
    options = {"condition": "setup2", "episodes": 7, "seed": 3, "material": "vsc", "mouth": 0.2, "target": 0.25}
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    stopped = run(*words, "--output", "a run")
    assert stopped.exit_code == 130
    command = f"{shlex.join([sys.executable, 'pour.py'])} --resume --output 'a run' goes on with it"
    assert stopped.output.count(command) == 2  # at the beginning and at the end
    assert "Stopped after episode 0" in stopped.output
    assert json.loads((tmp_path / "a run/options.json").read_text()) == options
    run("--resume", "--output", "a run")
    assert run.options == options
    assert run(*words, "--resume", "--output", "a run").exit_code == 130  # the same once more is no contradiction
    run("--resume", "--output", "a run", "--episodes", 9)
    run("--resume", "--output", "a run")
    assert run.options == options | {"episodes": 9}


def test_command_of_those_who_came_by_make(run, monkeypatch):
    monkeypatch.setenv("MAKELEVEL", "1")
    assert 'make pour ARGS="--resume --output output/pour" goes on with it' in run().output


def test_run_that_is_there_is_named_and_left_alone(run, tmp_path):
    run("--seed", 1)
    again = run("--seed", 2)
    assert "output/pour is taken (0 of 80 episodes)" in again.output
    assert "All is kept in output/pour-2;" in again.output
    assert json.loads((tmp_path / "output/pour/options.json").read_text())["seed"] == 1
    for number in range(80):
        with sg.learned.EpisodeStore(tmp_path / "output/pour/episodes.sqlite") as store:
            store.begin(number, "general", 0, {})
            store.end(number, "done", total=0.0)
    later = run("--seed", 2)
    assert "output/pour is taken (80 of 80 episodes)" in later.output
    assert "output/pour-2 is taken (0 of 80 episodes)" in later.output
    assert "All is kept in output/pour-3;" in later.output


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--mouth", 0.5], ["--mouth", "0.25"]),
        (["--target", 0.6], ["--target", "0.54"]),
        (["--condition", "varied", "--material", "vsc"], ["--material vsc", "--condition varied"]),
        (["--output", "file"], ["--output file", "File exists"]),
        (["--resume", "--output", "nothing"], ["--resume: there is no run in nothing", "--output"]),
        (["--resume", "--output", "kept", "--seed", 6], ["--seed 6", "has 5", "leave --seed or --resume out"]),
        (["--resume", "--output", "kept", "--mouth", 0.2], ["--mouth 0.2", "has none"]),
        (["--resume", "--output", "kept", "--episodes", 9], ["--episodes 9", "has 10"]),
    ],
)
def test_refusal_names_option_and_value(run, tmp_path, words, told):
    (tmp_path / "file").touch()
    run("--output", "kept", "--seed", 5, "--episodes", 10)
    refused = run(*words)
    assert refused.exit_code == 2
    for part in told:
        assert part in refused.output
    assert "Traceback" not in refused.output
    assert len(refused.output.splitlines()) <= 6


@pytest.mark.parametrize("text", ["", '{"seed": 1', "[1]"])
def test_options_that_are_damaged(run, tmp_path, text):
    run("--output", "kept")
    (tmp_path / "kept/options.json").write_text(text)
    for words in (["--resume"], []):
        refused = run(*words, "--output", "kept")
        assert refused.exit_code == 2
        assert "kept/options.json holds no options of a run; give another --output, or take it away" in refused.output
