"""Sizes and places: the spheres, the source container with its lip, the receiver.

Lengths are in the simulator's unit (a sphere is 0.05 wide); gravity is 1. The x axis points from the source
to the receiver, z upwards. The source moves and tilts in the x-z plane; its *shoulder*, the upper edge that
faces the receiver, is the point that commands and observations speak of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SPHERES = 100
SPHERE_RADIUS = 0.025
GRAVITY = 1.0

SOURCE_WIDTH = 0.3  # outer width in x and y
SOURCE_HEIGHT = 0.5  # without the lip
WALL = 0.005  # nominal; the walls that spheres meet grow outwards from their inner face
INNER = SOURCE_WIDTH / 2 - WALL  # half the inner width
SOURCE_WALL = 0.05  # outward growth of the source's walls, more than a sphere moves in one step
LIP_WALL = 0.03
START = (SOURCE_WIDTH / 2, 0.0, SOURCE_HEIGHT)  # shoulder of the source standing upright at x = 0
MOUTH_RANGE = (0.11, 0.25)
GRIP_RANGE = (0.05, 0.45)  # height of the middle of the gripper on the source for grasp ratios 0 and 1

RECEIVER_SIZE = (0.3, 0.4, 0.2)  # outer length (x), width (y), height
SIDE_RANGE = (0.1, 1.0)  # of each side of the receiver
RECEIVER_WALL = 0.02

CLEARANCE = 0.03  # between the source's walls and the receiver's
# Height above the floor, inside the receiver, below which the source would press on poured spheres. It does not go
# with the rim: 55 spheres lie in two layers, 0.1 high, in any receiver of 0.22 to 0.38 by 0.4. The bounds of the
# actions keep the source above 0.137 there, at the bottom of a long stroke from the lowest pouring position.
HEAP = 0.12


@dataclass(frozen=True)
class Source:
    """The source container: a box with a lip of four plates that lean inwards by 45 degrees.

    Args:
        mouth: Width of the square opening, in [0.11, 0.25].

    Raises:
        ValueError: The mouth lies outside its range.
    """

    mouth: float

    def __post_init__(self) -> None:
        low, high = MOUTH_RANGE
        if not low <= self.mouth <= high:
            raise ValueError(f"source: mouth is {self.mouth!r}; give a number from {low} to {high}")

    @property
    def lip(self) -> float:
        """Height of the lip, which is also how far it reaches inwards."""
        return INNER - self.mouth / 2

    def to_local(self, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(n, 3) points in the frame of the box's bottom centre, for a shoulder at (x, z, tilt)."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x, z = points[:, 0] - pose[0], points[:, 2] - pose[1]
        return np.stack([cos * x - sin * z + SOURCE_WIDTH / 2, points[:, 1], sin * x + cos * z + SOURCE_HEIGHT], axis=1)

    def contains(self, local: np.ndarray) -> np.ndarray:
        """(n,) whether points in the local frame lie inside the box or between the plates of its lip.

        Contacts are soft, and fast spheres dip into the walls: inside is what the walls push back inside,
        which they do up to their middle.
        """
        z = local[:, 2]
        lip = INNER - (z - SOURCE_HEIGHT) + LIP_WALL * math.sqrt(0.5)
        half = np.where(z < SOURCE_HEIGHT, INNER + SOURCE_WALL / 2, lip)
        return (
            (np.abs(local[:, 0]) < half)
            & (np.abs(local[:, 1]) < half)
            & (z > WALL - SOURCE_WALL / 2)
            & (z < SOURCE_HEIGHT + self.lip)
        )

    def through_mouth(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(n,) whether straight ways between (n, 3) points in the local frame lead through the opening."""
        top = SOURCE_HEIGHT + self.lip
        rise = after[:, 2] - before[:, 2]
        crosses = (before[:, 2] < top) != (after[:, 2] < top)
        share = np.where(crosses, (top - before[:, 2]) / np.where(rise == 0.0, 1.0, rise), 0.0)
        across = before[:, :2] + share[:, None] * (after[:, :2] - before[:, :2])
        return crosses & (np.abs(across) < self.mouth / 2 + WALL).all(axis=1)

    def outline(self) -> np.ndarray:
        """(n, 2) points along the outside of walls and lip in the x-z plane, relative to the shoulder."""
        out, top = INNER + SOURCE_WALL, SOURCE_HEIGHT
        slope = LIP_WALL * math.sqrt(0.5)
        tip = (INNER - self.lip + slope, top + self.lip + slope)
        corners = np.array(
            [
                (-out, WALL - SOURCE_WALL),
                (out, WALL - SOURCE_WALL),
                (out, top),
                tip,
                (-tip[0], tip[1]),
                (-out, top),
            ]
        )
        ends = np.roll(corners, -1, axis=0)
        points = [a + (b - a) * t for a, b in zip(corners, ends, strict=True) for t in np.linspace(0, 1, 8)[:-1]]
        return np.array(points) - (SOURCE_WIDTH / 2, SOURCE_HEIGHT)

    def mouth_centre(self, pose: np.ndarray) -> float:
        """The x of the middle of the opening, for the pose (x, z, tilt) of the shoulder."""
        return float(pose[0] - math.cos(pose[2]) * SOURCE_WIDTH / 2 + math.sin(pose[2]) * self.lip)


@dataclass(frozen=True)
class Receiver:
    """The receiving container: an open box on the floor that can be pushed and turned.

    Args:
        size: (length in x, width in y, height), each in [0.1, 1].

    Raises:
        ValueError: A size lies outside its range.
    """

    size: tuple[float, ...] = RECEIVER_SIZE

    def __post_init__(self) -> None:
        low, high = SIDE_RANGE
        if len(self.size) != 3 or not all(low <= side <= high for side in self.size):
            raise ValueError(f"receiver: size is {self.size!r}; give length, width, height from {low:g} to {high:g}")

    @property
    def rim(self) -> float:
        """Height of the upper edge."""
        return self.size[2]

    def to_local(self, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(n, 3) points in the receiver's frame, for its pose (x, y, yaw)."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x, y = points[:, 0] - pose[0], points[:, 1] - pose[1]
        return np.stack([cos * x + sin * y, cos * y - sin * x, points[:, 2]], axis=1)

    def above(self, local: np.ndarray) -> np.ndarray:
        """(n,) whether points in the receiver's frame lie over its footprint."""
        return (np.abs(local[:, 0]) < self.size[0] / 2) & (np.abs(local[:, 1]) < self.size[1] / 2)

    def corners(self, pose: np.ndarray) -> np.ndarray:
        """(12,) x, y, z of the rim's corners, counter-clockwise from (+x, +y), for the pose (x, y, yaw)."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        a, b = self.size[0] / 2, self.size[1] / 2
        corners = [(a, b), (-a, b), (-a, -b), (a, -b)]
        return np.array(
            [(pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y, self.rim) for x, y in corners]
        ).ravel()


def required_lift(outline: np.ndarray, pose: np.ndarray, receiver: Receiver, receiver_x: float) -> float:
    """How far the source must rise so that its walls clear the floor, the receiver's rim and the poured heap.

    Args:
        outline: (n, 2) points of the source relative to its shoulder, from `Source.outline`.
        pose: (x, z, tilt) of the shoulder.
        receiver: The receiver.
        receiver_x: Where the receiver's centre is.

    Returns:
        The lift, 0 where the pose is clear already.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] + cos * outline[:, 0] + sin * outline[:, 1]
    z = pose[1] - sin * outline[:, 0] + cos * outline[:, 1]
    across = np.abs(x - receiver_x)
    half = receiver.size[0] / 2
    floor = WALL - SOURCE_WALL  # the source stands on its nominal bottom, not on the grown one
    ground = np.where(
        across < half - CLEARANCE, HEAP, np.where(across < half + CLEARANCE, receiver.rim + CLEARANCE, floor)
    )
    return max(0.0, float((ground - z).max()))
