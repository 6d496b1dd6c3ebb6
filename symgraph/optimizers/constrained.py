"""Search under constraints: the method of multipliers around a search without them, and what counts as meeting all.

One climb after the other maximises the augmented Lagrangian of `symgraph.constraints`; between two, multipliers follow
what is missed, and weights grow where that does not fall.

Source: Birgin & Martínez, Practical Augmented Lagrangian Methods, SIAM 2014, algorithm 4.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from symgraph.compile.kernel import BoundKernel, Ended
from symgraph.constraints import Constraint, violations
from symgraph.slots import Array, Choices

MOVE = 1e-6  # of an action's range: what such moves would make up for counts as rounding
ROUNDING = 1e-9  # of a constraint's unit, likewise: where margins are flat, moves make up for nothing
CLOSE = 1e-10  # of a constraint's unit: what a search goes on to
SMALLEST_UNIT = 1e-100  # its square must still be a number
FIRST_WEIGHT = 1000.0  # less lets a climb leave for where nothing leads back to what is required
GROWTH = 10.0  # of weights
MOST_GROWTH = 1e9
ENOUGH = 0.25  # of what was missed before: while that much less is missed each time, weights stay
ROUNDS = 40
FIRST_TOLERANCE = 1e-2  # of a climb; the multipliers are not right yet


class Constrained:
    """The constraints of a problem at its start state.

    Each has a unit for each combination of selections, a typical size of its margin over the bounds, so that it does
    not matter in what unit a model computes.

    Args:
        constraints: k of them.
        low: (n,) bounds of the actions, also of those that are held.
        high: likewise.
        counts: choices (s,) → which constraints count (k,).
        margins: actions (n,) and one-hot selections (m,) → margins (k,).
        bind: multipliers (k,) and weights (k,) → the kernel of the augmented Lagrangian.
    """

    def __init__(
        self,
        constraints: Sequence[Constraint],
        low: Array,
        high: Array,
        counts: Callable[[Choices], npt.NDArray[np.bool_]],
        margins: Callable[[Array, Array], Array],
        bind: Callable[[Array, Array], BoundKernel],
    ) -> None:
        self._constraints = constraints
        self._moves = np.diag(MOVE * (high - low))
        self._middle = (low + high) / 2
        self._counts = counts
        self._margins = margins
        self._bind = bind
        self._equality = np.array([one.is_equality for one in constraints], dtype=bool)
        self._bounds = np.array([abs(one.bound) for one in constraints])
        self._units: dict[bytes, Array] = {}

    @property
    def count(self) -> int:
        """k."""
        return len(self._constraints)

    def margins(self, points: Array, hot: Array) -> Array:
        """Return the margins (P, k) at points (P, n) under one-hot selections (P, m)."""
        return np.array([self._margins(point, chosen) for point, chosen in zip(points, hot, strict=True)])

    def learn(self, choice: Choices, margins: Array) -> None:
        """Take the units under choices (s,) from margins at samples (P, k)."""
        sizes = np.sort(np.where(np.isfinite(margins), np.abs(margins), np.inf), axis=0)
        quarter = sizes[len(sizes) // 4]
        with np.errstate(invalid="ignore"):
            spread = np.where(np.isfinite(margins), margins, np.nan)
            ranges = np.nan_to_num(np.nanmax(spread, 0, initial=-np.inf) - np.nanmin(spread, 0, initial=np.inf))
        # A quarter of all margins are no larger: a few steep ones say nothing of those near 0. Nor does an offset.
        found = np.where((quarter > 0.0) & (quarter < ranges), quarter, ranges)
        units = np.where((found > SMALLEST_UNIT) & np.isfinite(found), found, np.maximum(self._bounds, 1.0))
        self._units[choice.tobytes()] = np.where(self._counts(choice), units, np.inf)

    def knows(self, choice: Choices) -> bool:
        """Whether `learn` was called for choices."""
        return choice.tobytes() in self._units

    def units(self, choice: Choices) -> Array:
        """Return the units (k,) under choices, infinite for what does not count."""
        return self._units[choice.tobytes()]

    def typical(self, choice: Choices) -> Array:
        """Return the units (k,) under choices, of what does not count the size of its bound."""
        units = self.units(choice)
        return np.where(np.isfinite(units), units, np.maximum(self._bounds, 1.0))

    def share(self, margins: Array, choice: Choices) -> Array:
        """Return the largest breach (…,) in units of the constraints, from margins (…, k)."""
        with np.errstate(invalid="ignore"):  # what does not count has an infinite unit
            shares = np.where(
                np.isinf(self.units(choice)), 0.0, violations(margins, self._constraints) / self.units(choice)
            )
        return np.asarray(shares.max(axis=-1))

    def breaches(self, point: Array, choice: Choices, hot: Array) -> Array:
        """Return by how much what counts is missed (k,) at a point (n,), and 0 where that is rounding.

        NaN where a margin is.
        """
        margins = self._margins(point, hot)
        found = np.where(self._counts(choice), violations(margins, self._constraints), 0.0)
        if not found.any():
            return found
        slack = np.zeros(self.count)
        inward = np.where(point > self._middle, -1.0, 1.0)
        with np.errstate(invalid="ignore"):  # infinite margins
            changes = [np.abs(self._margins(point + move, hot) - margins) for move in inward * self._moves]
        for change in changes:
            slack += np.where(np.isfinite(change), change, 0.0)
        typical = np.where(np.isfinite(self.units(choice)), self.units(choice), 0.0) if point.size else self._bounds
        return np.where(found <= slack + ROUNDING * typical, 0.0, found)

    def penalty(self, margins: Array, choice: Choices, scale: float) -> Array:
        """Return what `penalised` takes away (…,) at margins (…, k)."""
        weights = self._weights(choice, scale)
        with np.errstate(invalid="ignore", over="ignore"):  # infinite margins, and those whose squares are
            terms = np.where(weights > 0.0, weights / 2 * violations(margins, self._constraints) ** 2, 0.0)
        return np.asarray(terms.sum(axis=-1))

    def penalised(self, choice: Choices, scale: float) -> BoundKernel:
        """Return the kernel of J minus penalties, w/2 · breach²; the scale is that of J [reward]."""
        weights = self._weights(choice, scale)
        return self._bind(np.zeros_like(weights), weights)

    def climb(
        self, start: Array, choice: Choices, hot: Array, iterations: int, tolerance: float, scale: float
    ) -> Ended:
        """Climb from one point to a local maximum that meets all constraints.

        Where none is found, to where least is missed; but a point on the way that meets all is not given up.

        Args:
            start: (n,) actions.
            choice: (s,).
            hot: (m,) the same, one-hot.
            iterations: gradients at most.
            tolerance: as that of `BoundKernel.climb`, over the scale.
            scale: of J [reward].

        Returns:
            where it ended; its value is that of the augmented Lagrangian.
        """
        weights, multipliers, growth = self._weights(choice, scale), np.zeros(len(self._constraints)), 1.0
        units = self.units(choice)
        point, history = start, [np.zeros(0)]
        kept: tuple[float, Array] | None = None  # J and place of the best that meets all
        margins = self._margins(start, hot)
        before, slack, left = np.inf, FIRST_TOLERANCE, iterations
        while True:
            closeness = np.array([max(tolerance, slack) * scale])
            ((_, ended),) = self._bind(multipliers, weights).climb(point[None], hot[None], left, closeness)
            if len(history) == 1 and self.share(margins, choice) <= CLOSE:
                kept = float(ended.history[0] + self.penalty(margins, choice, scale)), start
            history.append(ended.history)
            left -= len(ended.history)
            if ended.outcome == "not finite":
                return Ended(point if kept is None else kept[1], 0.0, "not finite", np.concatenate(history))
            point, margins = ended.point, self._margins(ended.point, hot)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                pulled = np.where(weights > 0.0, multipliers + weights * margins, 0.0)
                pulled = np.where(self._equality, pulled, np.maximum(pulled, 0.0))
                taken = np.where(weights > 0.0, (pulled**2 - multipliers**2) / (2 * weights), 0.0).sum()
                # By how much constraints, or the multipliers of those that do not bind, are not yet right.
                wrong = float(np.abs(np.where(weights > 0.0, (pulled - multipliers) / weights / units, 0.0)).max())
            value, share = float(ended.value + taken), float(self.share(margins, choice))
            if share <= CLOSE and (kept is None or value >= kept[0]):
                kept = value, point
            settled = slack <= tolerance and wrong <= CLOSE
            over = left <= 0 or ended.outcome == "time limit" or len(history) > ROUNDS or growth > MOST_GROWTH
            if settled or over:
                end = point if settled or kept is None else kept[1]
                return Ended(end, ended.value, ended.outcome, np.concatenate(history))
            multipliers = pulled
            if wrong > ENOUGH * before and wrong > CLOSE:
                weights, growth = weights * GROWTH, growth * GROWTH
            before, slack = wrong, slack / 10.0

    def _weights(self, choice: Choices, scale: float) -> Array:
        units = self.units(choice)
        return FIRST_WEIGHT * scale / units / units  # the square of a unit may be no number
