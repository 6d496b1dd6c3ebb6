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
        self._squares = np.empty((count, count))
        self._near = np.empty((count, count), dtype=bool)
        self._diagonal = np.diag_indices(count)

    @property
    def active(self) -> bool:
        """Whether there is any attraction to compute."""
        return self._k > 0

    def accelerations(self, positions: np.ndarray) -> np.ndarray:
        """Return the (n, 3) accelerations [length / time^2] of spheres at (n, 3) positions [length]."""
        weights = self._squares
        centred = positions - positions.mean(axis=0)  # keeps the differences below accurate
        norms = np.einsum("ij,ij->i", centred, centred)
        np.matmul(centred, centred.T, out=weights)
        weights *= -2.0
        weights += norms
        weights += norms[:, None]
        np.less(weights, self._reach, out=self._near)
        np.maximum(weights, _CLOSEST, out=weights)
        np.divide(self._k, weights, out=weights)
        weights *= self._near
        weights[self._diagonal] = 0.0
        return weights @ centred - weights.sum(axis=1)[:, None] * centred
