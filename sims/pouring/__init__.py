"""A world to pour in: 100 spheres of four materials, a source to tip or to shake, a receiver."""

from sims.pouring.actions import ACTIONS, SKILLS, Clamp
from sims.pouring.behaviour import End
from sims.pouring.materials import MATERIALS, Material, mix
from sims.pouring.simulation import SimulationFailed
from sims.pouring.world import PouringWorld

__all__ = ["ACTIONS", "MATERIALS", "SKILLS", "Clamp", "End", "Material", "PouringWorld", "SimulationFailed", "mix"]
