"""The command line: an episode, told in words and drawn."""

import imageio.v3 as imageio
import pytest
import typer
from typer.testing import CliRunner

from sims.pouring import __main__ as command_line


def test_an_episode_is_run_told_and_drawn(tmp_path):
    app = typer.Typer()
    app.command()(command_line.main)
    picture = tmp_path / "strip.png"
    options = ["--material", "wat", "--mouth", "0.25", "--skill", "shake", "--pictures", str(picture)]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 0, result.output
    assert "trial stopped: target" in result.output
    assert "leaked_particles: 0" in result.output
    assert imageio.imread(picture).shape == (480, 6 * 480, 3)


def test_the_receiver_is_as_large_as_asked(monkeypatch):
    sizes = []

    def look(world, policy, seed, trials, begin):
        sizes.append(world.reset(seed)["receiver_size"].tolist())
        raise typer.Exit

    monkeypatch.setattr(command_line, "run_episode", look)
    app = typer.Typer()
    app.command()(command_line.main)
    for options in ([], ["--receiver-size", "0.25", "0.4", "0.16"]):
        assert CliRunner().invoke(app, options).exit_code == 0
    assert sizes == [[0.3, 0.4, 0.2], [0.25, 0.4, 0.16]]


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--material", "oil", "oil"),
        ("--mouth", "0.3", "0.25"),
        ("--receiver-size", "0.3 0.4 0.05", "0.1"),
        ("--video", "pour.avi", ".mp4"),
    ],
)
def test_wrong_values_are_refused_before_anything_runs(option, value, words, monkeypatch):
    monkeypatch.setattr(command_line, "run_episode", None)
    app = typer.Typer()
    app.command()(command_line.main)
    result = CliRunner().invoke(app, [option, *value.split()], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert words in result.output
