"""Where the spheres are: in the source, flowing, received, spilled."""

from __future__ import annotations

import copy
import enum

import numpy as np

from sims.pouring.geometry import SPHERE_RADIUS, SPHERES
from sims.pouring.simulation import Simulation

RESTING_SPEED = 0.1  # a sphere in the receiver that is slower has been received
HANGING_SPEED = 0.02  # a sphere outside that is slower lies on something and flows no more
HEAP_HEIGHT = 0.25  # spheres resting up to this far above the receiver's rim belong to its heap
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
        spilled: The most spheres that have been on the floor or far away at once.
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
        self._in_source, self._in_receiver = self._locals(simulation)

    def _locals(self, simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) positions in the frames of source and receiver."""
        positions = simulation.positions
        return (
            simulation.source.to_local(positions, simulation.pose),
            simulation.receiver.to_local(positions, simulation.receiver_pose),
        )

    def start_trial(self) -> None:
        """Forget where earlier flows came down."""
        self._landed[:] = False

    @property
    def landings(self) -> np.ndarray:
        """(k, 2) x and y, relative to the receiver, at which the trial's spheres first sank to the rim's height."""
        return self._landings[self._landed]

    def update(self, simulation: Simulation) -> None:
        """Classify the spheres after a control step."""
        source, receiver = simulation.source, simulation.receiver
        before_source, before_receiver = self._in_source, self._in_receiver
        in_source_frame, in_receiver_frame = self._locals(simulation)
        speeds = np.linalg.norm(simulation.velocities, axis=1)
        height = in_receiver_frame[:, 2]

        inside_source = source.contains(in_source_frame)
        above_receiver = receiver.above(in_receiver_frame) & ~inside_source
        top = receiver.rim + SPHERE_RADIUS
        inside_receiver = above_receiver & (height < top)
        heap = above_receiver & (height < receiver.rim + HEAP_HEIGHT) & (speeds < RESTING_SPEED)
        far = (np.abs(simulation.positions[:, :2]) > FAR).any(axis=1)
        on_floor = (~inside_source & ~inside_receiver & (height < 2 * SPHERE_RADIUS)) | far
        came_out = (self.classes == SphereClass.SOURCE) | (self.classes == SphereClass.FLOWING)

        classes = np.full(SPHERES, SphereClass.BOUNCED)
        classes[came_out & ~inside_receiver & (speeds > HANGING_SPEED)] = SphereClass.FLOWING
        classes[on_floor] = SphereClass.SPILLED
        classes[(inside_receiver | heap) & (speeds < RESTING_SPEED)] = SphereClass.RECEIVED
        was_inside = source.contains(before_source)
        classes[inside_source] = SphereClass.SOURCE

        sank = ~self._landed & ~inside_source & (before_receiver[:, 2] > top) & (height <= top)
        self._landings[sank] = in_receiver_frame[sank, :2]
        self._landed |= sank

        through_source = (was_inside != inside_source) & ~source.through_mouth(before_source, in_source_frame)
        low = receiver.rim - SPHERE_RADIUS
        through_receiver = (
            (receiver.above(before_receiver) != receiver.above(in_receiver_frame))
            & (before_receiver[:, 2] < low)
            & (height < low)
        )
        self.leaked.update(np.flatnonzero(through_source | through_receiver | (height < 0.0)).tolist())

        self.classes = classes
        self.in_source = int(inside_source.sum())
        self.in_receiver = int((inside_receiver | heap).sum())
        self.spilled = max(self.spilled, int(on_floor.sum()))
        self.flowing = int((classes == SphereClass.FLOWING).sum())
        self._in_source, self._in_receiver = in_source_frame, in_receiver_frame

    def copy(self) -> Census:
        """Return an independent copy."""
        return copy.deepcopy(self)
