"""A world to pour in: 100 spheres of four materials, a source to tip or to shake, a receiver."""

import os
import sys

# MuJoCo chooses how it draws when it is first imported, and its choice needs a screen.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

from sims.pouring.actions import ACTIONS, SKILLS, Clamp
from sims.pouring.behaviour import End
from sims.pouring.episode import Episode, run_episode, run_episodes
from sims.pouring.materials import MATERIALS, Material, mix
from sims.pouring.setups import SETUPS
from sims.pouring.simulation import SimulationFailed
from sims.pouring.world import PouringWorld

__all__ = [
    "ACTIONS",
    "MATERIALS",
    "SETUPS",
    "SKILLS",
    "Clamp",
    "End",
    "Episode",
    "Material",
    "PouringWorld",
    "SimulationFailed",
    "mix",
    "run_episode",
    "run_episodes",
]
