"""Search under constraints: the method of multipliers around a search without them.

One climb after the other maximises the augmented Lagrangian of `symgraph.constraints`; between two, multipliers follow
what is missed, and weights grow where that does not fall.

Source: Birgin & Martínez, Practical Augmented Lagrangian Methods, SIAM 2014, algorithm 4.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from symgraph.compile.kernel import BoundKernel, Ended
from symgraph.constraints import UNUSED, Constraint, violations
from symgraph.slots import Array, Choices

MET = 1e-6  # what may be missed of a requirement, in units of how much its margin varies over the bounds
CLOSE = 1e-10  # as MET, what a search goes on to
FIRST_WEIGHT = 1000.0  # less lets a climb leave for where nothing leads back to what is required
GROWTH = 10.0  # of weights
ENOUGH = 0.25  # of what was missed before: while that much less is missed each time, weights stay
LARGEST_WEIGHT = 1e12
ROUNDS = 40
FIRST_TOLERANCE = 1e-2  # of a climb; the multipliers are not right yet


class Constrained:
    """The constraints of a problem at its start state.

    Args:
        constraints: k of them.
        margins: actions (n,) and one-hot selections (m,) → margins (k,).
        bind: multipliers (k,) and weights (k,) → the kernel of the augmented Lagrangian.
    """

    def __init__(
        self,
        constraints: Sequence[Constraint],
        margins: Callable[[Array, Array], Array],
        bind: Callable[[Array, Array], BoundKernel],
    ) -> None:
        self._constraints = constraints
        self._margins = margins
        self._bind = bind
        self._equality = np.array([one.is_equality for one in constraints], dtype=bool)
        self._spreads: dict[bytes, Array] = {}

    def margins(self, points: Array, hot: Array) -> Array:
        """Return the margins (P, k) at points (P, n) under one-hot selections (P, m)."""
        return np.array([self._margins(point, chosen) for point, chosen in zip(points, hot, strict=True)])

    def learn_spread(self, choice: Choices, margins: Array) -> None:
        """Take from samples (P, k) how much margins vary under choices (s,)."""
        finite = np.where(np.isfinite(margins), margins, np.nan)
        used = ~(margins == UNUSED).all(axis=0)
        with np.errstate(invalid="ignore"):
            low, high = np.nanmin(finite, axis=0, initial=np.inf), np.nanmax(finite, axis=0, initial=-np.inf)
        spread = np.where(used & (high > low), high - low, 1.0)
        self._spreads[choice.tobytes()] = np.where(used, spread, np.inf)  # what has no part in it weighs nothing

    def knows(self, choice: Choices) -> bool:
        """Whether `learn_spread` was called for choices."""
        return choice.tobytes() in self._spreads

    def missed(self, margins: Array, choice: Choices) -> Array:
        """Return the largest share (…,) of their spreads by which constraints are missed, from margins (…, k)."""
        return np.asarray((violations(margins, self._constraints) / self._spreads[choice.tobytes()]).max(axis=-1))

    def penalty(self, margins: Array, choice: Choices, scale: float) -> Array:
        """Return what `penalised` takes away (…,) at margins (…, k)."""
        weights = self._weights(choice, scale)
        return np.asarray((weights / 2 * violations(margins, self._constraints) ** 2).sum(axis=-1))

    def penalised(self, choice: Choices, scale: float) -> BoundKernel:
        """Return the kernel of J minus penalties, w/2 · missed²; the scale is that of J [reward]."""
        weights = self._weights(choice, scale)
        return self._bind(np.zeros_like(weights), weights)

    def climb(
        self, start: Array, choice: Choices, hot: Array, iterations: int, tolerance: float, scale: float
    ) -> tuple[Ended, float]:
        """Climb from one point to a local maximum that meets all constraints, or misses them least.

        Args:
            start: (n,) actions.
            choice: (s,).
            hot: (m,) the same, one-hot.
            iterations: gradients at most.
            tolerance: as that of `BoundKernel.climb`, over the scale.
            scale: of J [reward].

        Returns:
            where it ended, valued by the augmented Lagrangian, and what is missed there, see `missed`.
        """
        weights, multipliers = self._weights(choice, scale), np.zeros(len(self._constraints))
        spread = self._spreads[choice.tobytes()]
        point, history = start, [np.zeros(0)]
        before, slack = np.inf, FIRST_TOLERANCE
        left = iterations
        while True:
            ended = self._bind(multipliers, weights).climb(point, hot, left, max(tolerance, slack) * scale)
            history.append(ended.history)
            left -= len(ended.history)
            if ended.outcome == "not finite":
                ended.history = np.concatenate(history)
                return ended, np.inf
            point = ended.point
            margins = self._margins(point, hot)
            pulled = multipliers + weights * margins
            # By how much constraints, or the multipliers of those that do not bind, are not yet right.
            moved = np.where(self._equality, margins, np.maximum(margins, -multipliers / np.maximum(weights, 1e-300)))
            wrong = float(np.abs(np.where(weights > 0.0, moved / spread, 0.0)).max(initial=0.0))
            settled = slack <= tolerance and wrong <= CLOSE
            over = left <= 0 or ended.outcome == "time limit"
            if settled or over or len(history) > ROUNDS or weights.max() > LARGEST_WEIGHT * scale:
                ended.history = np.concatenate(history)
                return ended, float(self.missed(margins, choice))
            multipliers = np.where(self._equality, pulled, np.maximum(pulled, 0.0))
            if wrong > ENOUGH * before and wrong > CLOSE:
                weights = weights * GROWTH
            before, slack = wrong, slack / 10.0

    def _weights(self, choice: Choices, scale: float) -> Array:
        return FIRST_WEIGHT * scale / self._spreads[choice.tobytes()] ** 2
