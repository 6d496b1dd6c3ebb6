"""Constraints: each side of each requirement at each visit of its node, and how searches are held to them.

A constraint's margin is by how much it is missed: at most 0, or 0 where it is an equality. The augmented Lagrangian

    J - Σ ψ(margin),   ψ(c) = (t² - λ²) / (2w),  t = max(0, λ + wc), without the max for equalities,

is what a search without constraints climbs instead of J: with the right multipliers λ its maximum is the one that meets
all constraints, for any weights w that are large enough.

Source: Rockafellar, The multiplier method of Hestenes and Powell applied to convex programming, JOTA 12, 1973.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from symgraph.requirement import Requirement, Side
from symgraph.slots import Array
from symgraph.tree import Tree

UNUSED = -1e30  # margin of an inequality on a branch that is not chosen; infinity times 0 would be NaN


@dataclass(frozen=True)
class Constraint:
    """A side of a requirement at a tree node.

    Attributes:
        node: index of the tree node.
        requirement: whose side it is.
        element: of what its model returns.
        side: "low", "high" or "equal".
        way: {selection: choice} that lead to the node.
    """

    node: int
    requirement: Requirement
    element: int
    side: Side
    way: Mapping[str, str]

    @property
    def bound(self) -> float:
        """What the element is compared with."""
        return float((self.requirement.high if self.side == "high" else self.requirement.low)[self.element])

    @property
    def is_equality(self) -> bool:
        return self.side == "equal"

    @property
    def unused(self) -> float:
        """The margin where it does not count."""
        return 0.0 if self.is_equality else UNUSED

    def told(self, tree: Tree) -> str:
        """Say what is demanded and where."""
        return f"{self.requirement.told(self.element, self.side)} at {tree.path(self.node)!r}"


def constraints_of(tree: Tree, root: int = 0) -> tuple[Constraint, ...]:
    """Return the constraints of a subtree in the order of the margins: from the root, one branch after the other."""
    found = []
    waiting: list[tuple[int, dict[str, str]]] = [(root, {})]
    while waiting:
        index, way = waiting.pop()
        node = tree.nodes[index]
        found += [
            Constraint(index, requirement, element, side, way)
            for requirement in node.requirements
            for element, side in requirement.sides
        ]
        children = [
            (
                branch.child,
                way if group.group.selection is None else {**way, group.group.selection: branch.branch.label},
            )
            for group in node.groups
            for branch in group.branches
            if branch.child is not None
        ]
        waiting += reversed(children)
    return tuple(found)


def counting(constraints: Sequence[Constraint], selections: Mapping[str, str]) -> npt.NDArray[np.bool_]:
    """Return which constraints count (k,) under {label: choice} of all selections."""
    return np.array([all(selections[label] == c for label, c in one.way.items()) for one in constraints], dtype=bool)


def merit(value: ca.MX, margins: ca.MX, multipliers: ca.MX, weights: ca.MX, constraints: Sequence[Constraint]) -> ca.MX:
    """Return the augmented Lagrangian; a constraint of weight 0 has no part in it.

    Args:
        value: J.
        margins: c (k, 1).
        multipliers: λ (k, 1) [reward per unit of the margin], at least 0 of inequalities.
        weights: w (k, 1) [reward per unit² of the margin], at least 0.
        constraints: k of them.
    """
    pulled = multipliers + weights * margins
    equality = ca.DM([float(one.is_equality) for one in constraints])
    pulled = ca.if_else(equality, pulled, ca.fmax(pulled, 0.0))
    divisor = 2.0 * weights + (weights <= 0.0)  # never 0: what has no part must not make slopes NaN either
    penalties = ca.if_else(weights > 0.0, (pulled**2 - multipliers**2) / divisor, 0.0)
    return value - ca.sum1(penalties)


def violations(margins: Array, constraints: Sequence[Constraint]) -> Array:
    """Return by how much constraints are missed, each at least 0, for their margins (…, k)."""
    equality = np.array([one.is_equality for one in constraints], dtype=bool)
    return np.where(equality, np.abs(margins), np.maximum(margins, 0.0))
