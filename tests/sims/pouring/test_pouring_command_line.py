"""The command line: an episode, told in words and drawn."""

import imageio.v3 as imageio
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


def test_a_wrong_material_is_refused():
    app = typer.Typer()
    app.command()(command_line.main)
    assert CliRunner().invoke(app, ["--material", "oil"]).exit_code != 0
