"""Run one episode from the command line, look at it, or write it as pictures and video."""

from __future__ import annotations

import contextlib
import enum
import time
from pathlib import Path
from typing import Annotated

import typer

from sims.pouring.actions import ACTIONS, SKILLS
from sims.pouring.episode import fixed_policy, run_episode
from sims.pouring.geometry import MOUTH_RANGE, RECEIVER_SIZE, SIDE_RANGE
from sims.pouring.materials import MATERIALS
from sims.pouring.rendering import VIDEO_ENDINGS, Camera, Window, film, strip, viewer, write_picture, write_video
from sims.pouring.world import PouringWorld

MaterialName = enum.StrEnum("MaterialName", list(MATERIALS))
Skill = enum.StrEnum("Skill", list(SKILLS))
FRAME_STEPS = 2  # control steps from one frame of a video to the next: 20 frames per unit of simulated time
STILL_STEPS = 20  # the same where only a strip is asked for, since drawing takes longer than simulating


def main(
    material: MaterialName = MaterialName.bnc,
    mouth: Annotated[float, typer.Option(min=MOUTH_RANGE[0], max=MOUTH_RANGE[1])] = 0.23,
    receiver_size: Annotated[
        tuple[float, float, float], typer.Option(min=SIDE_RANGE[0], max=SIDE_RANGE[1], help="Length, width, height.")
    ] = RECEIVER_SIZE,
    skill: Skill = Skill.tip,
    seed: int = 0,
    trials: Annotated[int, typer.Option(min=1, help="Attempts after which to stop.")] = 1,
    pour_x: Annotated[float, typer.Option(help="Shoulder from the receiver's centre.")] = -0.2,
    pour_z: Annotated[float, typer.Option(help="Shoulder above the floor.")] = 0.33,
    pictures: Annotated[Path | None, typer.Option(help="Where to write a strip of stills.")] = None,
    video: Annotated[Path | None, typer.Option(help="Where to write an .mp4 or .gif.")] = None,
    view: Annotated[
        bool, typer.Option(help="Watch it in MuJoCo's viewer until that is closed; needs a screen.")
    ] = False,
) -> None:
    """Pour once or a few times with middling parameters."""
    if video and video.suffix not in VIDEO_ENDINGS:  # said now, not after the episode
        raise typer.BadParameter(f"--video: {str(video)!r} does not end in one of {list(VIDEO_ENDINGS)}")
    world = PouringWorld(str(material), mouth, receiver_size=receiver_size)
    actions = {label: bounds.scale(0.4) for label, bounds in ACTIONS.items()}
    actions |= {"pour_position": (pour_x, pour_z), "shake_stroke": (0.06, -1.57)}
    policy = fixed_policy(actions, str(skill))
    camera = Camera(world)
    with contextlib.ExitStack() as stack:
        frames: list = []
        windows: list[Window] = []

        def begin(world: PouringWorld) -> None:
            nonlocal frames
            if view:
                windows.append(stack.enter_context(viewer(world)))
            if pictures or video:
                frames = stack.enter_context(film(world, camera, FRAME_STEPS if video else STILL_STEPS))

        episode = run_episode(world, policy, seed, trials, begin)
        camera.close()
        if pictures:
            write_picture(pictures, strip(frames))
        if video:
            write_video(video, frames, fps=20)
        for stop in episode.stops:
            typer.echo(f"trial stopped: {stop}")
        typer.echo(f"episode: {episode.end.value if episode.end else 'left after the last trial'}")
        for clamp in episode.clamps:
            typer.echo(f"clamped {clamp.label}: {clamp.asked} to {clamp.used}")
        for name, value in episode.metrics.items():
            typer.echo(f"{name}: {value:g}")
        while any(window.is_running() for window in windows):  # the end is worth a look
            time.sleep(0.1)


if __name__ == "__main__":
    typer.run(main)
