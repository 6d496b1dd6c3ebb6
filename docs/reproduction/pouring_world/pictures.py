"""Draw a strip of stills for each material and skill, and one short video.

Run from the repository's root: `PYTHONPATH=. python docs/reproduction/pouring_world/pictures.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sims.pouring import MATERIALS, SKILLS, PouringWorld
from sims.pouring.rendering import Camera, film, strip, write_picture, write_video

FOLDER = Path(__file__).parent
MOUTH = 0.17
SIZE = 260
EVERY = 5  # control steps between two pictures
ACTIONS = {
    "grasp_ratio": 0.3,
    "pour_position": (-0.19, 0.33),
    "tilt_rate": 0.014,
    "search_rate": 0.003,
    "shake_speed": 0.75,
    "shake_stroke": (0.06, -1.5708),
}


def pour(material: str, skill: str) -> list[np.ndarray]:
    """Return the pictures of one attempt, from the pouring position on."""
    world = PouringWorld(material, MOUTH, receiver_x=0.8)
    world.reset(0)
    camera = Camera(world, SIZE, SIZE)
    while world.node != "ready":
        world.execute(world.node, ACTIONS, {"skill": skill})
    with film(world, camera, EVERY) as frames:
        while world.node != "poured":
            world.execute(world.node, ACTIONS, {"skill": skill})
        frames.append(camera.picture())
    camera.close()
    return frames


if __name__ == "__main__":
    for skill in SKILLS:
        films = {material: pour(material, skill) for material in MATERIALS}
        rows = [strip(frames, 6) for frames in films.values()]
        write_picture(FOLDER / f"strips_{skill}.png", np.concatenate(rows))
        if skill == "shake":
            write_video(FOLDER / "shake_vsc.gif", [frame[::2, ::2] for frame in films["vsc"][::2]], fps=8)
