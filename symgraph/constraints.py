"""Constraints: each side of each requirement at each visit of its node, and how searches are held to them.

A constraint's margin is by how much it is missed: at most 0, or 0 where it is an equality. The augmented Lagrangian

    J - Σ ψ(margin),   ψ(c) = (t² - λ²) / (2w),  t = max(0, λ + wc), without the max for equalities,

is what a search without constraints climbs instead of J: with the right multipliers λ its maximum is the one that meets
all constraints, for any weights w that are large enough.

Source: Rockafellar, The multiplier method of Hestenes and Powell applied to convex programming, JOTA 12, 1973.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from symgraph.requirement import Requirement, Side
from symgraph.slots import Array
from symgraph.tree import Tree

UNUSED = -1e300  # margin of an inequality on a branch that is not chosen; infinity times 0 would be NaN


@dataclass(frozen=True)
class Constraint:
    """A side of a requirement at a tree node."""

    node: int
    requirement: Requirement
    element: int
    side: Side

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
    waiting = [root]
    while waiting:
        node = tree.nodes[waiting.pop()]
        found += [
            Constraint(node.index, requirement, element, side)
            for requirement in node.requirements
            for element, side in requirement.sides
        ]
        children = [branch.child for group in node.groups for branch in group.branches if branch.child is not None]
        waiting += reversed(children)
    return tuple(found)


def merit(value: ca.MX, margins: ca.MX, multipliers: ca.MX, weights: ca.MX, constraints: Sequence[Constraint]) -> ca.MX:
    """Return the augmented Lagrangian; a constraint of weight 0 and multiplier 0 has no part in it.

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
    halves = ca.if_else(weights > 0.0, 0.5 / weights, 0.0)
    return value - ca.dot(pulled**2 - multipliers**2, halves)


def violations(margins: Array, constraints: Sequence[Constraint]) -> Array:
    """Return by how much constraints are missed, each at least 0, for their margins (…, k)."""
    equality = np.array([one.is_equality for one in constraints], dtype=bool)
    return np.where(equality, np.abs(margins), np.maximum(margins, 0.0))
