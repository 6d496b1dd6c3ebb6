"""The virtual attraction that makes spheres behave like a viscous material."""

from __future__ import annotations

import numpy as np

from sims.pouring.geometry import SPHERE_RADIUS
from sims.pouring.materials import Material

# The constants K are given for spheres of density 1.
_REFERENCE_MASS = 4 / 3 * np.pi * SPHERE_RADIUS**3
# Squared distance below which overlapping spheres attract each other no more strongly.
_CLOSEST = SPHERE_RADIUS**2


class Attraction:
    """Accelerations by a_i = k sum_j (x_j - x_i) / |x_j - x_i|^2 over the spheres j within reach.

    It is evaluated once per command and held over the physics steps in between, as in the published
    simulator, whose step was that long. That, and working in place on whole matrices, keeps it below a tenth
    of the time of a step.

    Args:
        material: Attraction constant and reach.
        count: Number of spheres n.
    """

    def __init__(self, material: Material, count: int) -> None:
        self._k = material.attraction / _REFERENCE_MASS
        self._reach = material.reach**2
        self._ways = np.empty((3, count, count))
        self._squares = np.empty((3, count, count))
        self._near = np.empty((count, count), dtype=bool)

    @property
    def active(self) -> bool:
        """Whether there is any attraction to compute."""
        return self._k > 0

    def accelerations(self, positions: np.ndarray) -> np.ndarray:
        """Return the (n, 3) accelerations [length / time^2] of spheres at (n, 3) positions [length]."""
        # Element by element and row after row, without matrix products: these are rounded differently on
        # other processors, and a jam that breaks or holds by the last digit would be another one there.
        axes = positions.T
        np.subtract(axes[:, :, None], axes[:, None, :], out=self._ways)  # [axis, j, i] from i to j
        np.square(self._ways, out=self._squares)
        weights = self._squares[0]
        weights += self._squares[1]
        weights += self._squares[2]
        np.less(weights, self._reach, out=self._near)
        np.maximum(weights, _CLOSEST, out=weights)
        np.divide(self._k, weights, out=weights)
        weights *= self._near
        self._ways *= weights
        return self._ways.sum(axis=1).T
