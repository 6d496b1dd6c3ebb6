"""Where the spheres are: in the source, flowing, received, spilled."""

from __future__ import annotations

import copy
import enum

import numpy as np

from sims.pouring.geometry import SPHERE_RADIUS, SPHERES
from sims.pouring.simulation import Simulation

RESTING_SPEED = 0.1  # a sphere in the receiver that is slower has been received
HANGING_SPEED = 0.02  # a sphere outside that is slower lies on something and flows no more
HEAP_HEIGHT = 0.35  # spheres resting up to this far above the receiver's rim belong to its heap
FAR = (3.0, 2.0)  # spheres beyond this x or y have left the scene for good


class SphereClass(enum.IntEnum):
    """What a sphere counts as."""

    SOURCE = 0
    FLOWING = 1
    RECEIVED = 2
    SPILLED = 3
    BOUNCED = 4


class Census:
    """Counts the spheres of a simulation by class, step after step.

    Attributes:
        classes: (n,) SphereClass of each sphere.
        in_source: Number of spheres in the source.
        in_receiver: Number of spheres in the receiver, moving or not, with the heap that rests above its rim.
        spilled: The most spheres that have been on the floor, piled up on it or far away at once.
        flowing: Number of spheres on their way from the source.
        leaked: Indices of spheres that went through a wall or the floor.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.classes = np.full(SPHERES, SphereClass.SOURCE)
        self.in_source = SPHERES
        self.in_receiver = 0
        self.spilled = 0
        self.flowing = 0
        self.leaked: set[int] = set()
        self._landed = np.zeros(SPHERES, dtype=bool)
        self._landings = np.zeros((SPHERES, 2))
        self._look(simulation)

    def start_trial(self) -> None:
        """Forget where earlier flows came down."""
        self._landed[:] = False

    @property
    def landings(self) -> np.ndarray:
        """(k, 2) x and y in the receiver's frame where the trial's spheres first sank to its rim."""
        return self._landings[self._landed]

    def update(self, simulation: Simulation) -> None:
        """Classify the spheres after a control step."""
        before_source, before_receiver = self._from_source, self._from_receiver
        was_in_source, was_above = self._in_source, self._above_receiver
        self._look(simulation)
        outside = ~self._in_source
        above = self._above_receiver & outside
        height = self._from_receiver[:, 2]
        rim = simulation.receiver.rim
        top = rim + SPHERE_RADIUS
        velocities = simulation.velocities
        speeds = np.sqrt(np.einsum("ij,ij->i", velocities, velocities))

        inside_receiver = above & (height < top)
        received = above & (height < rim + HEAP_HEIGHT) & (speeds < RESTING_SPEED)
        # Sticky material piles up beside the receiver: what rests there is spilled, however high it lies.
        piled = (height < rim) & (speeds < RESTING_SPEED)
        spilled = outside & ~above & ((height < 2 * SPHERE_RADIUS) | piled)
        spilled |= (np.abs(simulation.positions[:, :2]) > FAR).any(axis=1)
        came_out = self.classes <= SphereClass.FLOWING
        classes = np.full(SPHERES, SphereClass.BOUNCED)
        classes[came_out & ~inside_receiver & (speeds > HANGING_SPEED)] = SphereClass.FLOWING
        classes[spilled] = SphereClass.SPILLED
        classes[received] = SphereClass.RECEIVED
        classes[self._in_source] = SphereClass.SOURCE

        sank = outside & ~self._landed & (before_receiver[:, 2] > top) & (height <= top)
        self._landings[sank] = self._from_receiver[sank, :2]
        self._landed |= sank
        self._find_leaks(simulation, was_in_source, was_above, before_source, before_receiver)

        self.classes = classes
        self.in_source = int(self._in_source.sum())
        self.in_receiver = int((inside_receiver | received).sum())
        self.spilled = max(self.spilled, int(spilled.sum()))
        self.flowing = int((classes == SphereClass.FLOWING).sum())

    def _look(self, simulation: Simulation) -> None:
        """Find the spheres in the frames of source and receiver."""
        self._from_source = simulation.source.to_local(simulation.positions, simulation.pose)
        self._from_receiver = simulation.receiver.to_local(simulation.positions, simulation.receiver_pose)
        self._in_source = simulation.source.contains(self._from_source)
        self._above_receiver = simulation.receiver.above(self._from_receiver)

    def _find_leaks(
        self,
        simulation: Simulation,
        was_in_source: np.ndarray,
        was_above: np.ndarray,
        before_source: np.ndarray,
        before_receiver: np.ndarray,
    ) -> None:
        """Note the spheres that changed sides other than through the mouth or over the rim."""
        passed = np.flatnonzero(was_in_source != self._in_source)
        if len(passed):
            proper = simulation.source.through_mouth(before_source[passed], self._from_source[passed])
            self.leaked.update(passed[~proper].tolist())
        low = simulation.receiver.rim - SPHERE_RADIUS
        height = self._from_receiver[:, 2]
        walled = (was_above != self._above_receiver) & (before_receiver[:, 2] < low) & (height < low)
        # Contacts are soft: a fast sphere dips its lower half into the floor before it bounces.
        sunk = height < -SPHERE_RADIUS
        self.leaked.update(np.flatnonzero(walled | sunk).tolist())

    def copy(self) -> Census:
        """Return an independent copy."""
        return copy.deepcopy(self)
