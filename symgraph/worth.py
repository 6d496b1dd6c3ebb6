"""What a subtree is worth, as expressions: mean and variance of its rewards, margins of its requirements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from symgraph.binding import BoundModel
from symgraph.slots import Gaussian
from symgraph.tree import TreeBranch

# Scalar instructions up to which an expression is flattened: flat code runs several times faster, but the C compiler's
# time grows faster than its length.
FLATTEN_LIMIT = 5_000

Dictionary = dict[str, Gaussian]  # the super-state-action dictionary of a node: label → Gaussian of MX


@dataclass
class Worth:
    """What a subtree is worth: mean and variance of its sum of rewards, and the margins of its requirements."""

    value: ca.MX
    variance: ca.MX
    margins: list[ca.MX]

    def add(self, other: Worth) -> None:
        """Take in a group that happens side by side, independently."""
        self.value += other.value
        self.variance += other.variance
        self.margins += other.margins


def mixed(terms: list[tuple[ca.MX | float, Worth]], spread: bool) -> Worth:
    """Return the worth of a group of branches of which one happens: mean and, if asked for, variance of a mixture."""
    margins = [margin for _, worth in terms for margin in worth.margins]
    if len(terms) == 1 and isinstance(terms[0][0], float) and terms[0][0] == 1.0:
        return Worth(terms[0][1].value, terms[0][1].variance, margins)
    value, variance = ca.MX(0.0), ca.MX(0.0)
    for probability, worth in terms:
        value += probability * worth.value
    for probability, worth in terms if spread else ():
        variance += probability * (worth.variance + (worth.value - value) ** 2)
    return Worth(value, variance, margins)


def probability_of(branch: TreeBranch, shares: Dictionary) -> ca.MX | float:
    """Return the probability of a branch, given what the group's model returned."""
    label = branch.branch.label
    share = shares[label].mean if label in shares else branch.share
    return 1.0 if share is None else share


def applied(model: BoundModel | None, here: Dictionary) -> tuple[Dictionary, float]:
    """Return what a model writes, and its scalar instructions: infinitely many where it cannot be flattened."""
    if model is None:
        return {}, 0.0
    function, _ = model.moments(here)
    return model.apply(here), function.n_instructions() if function.is_a("SXFunction") else math.inf
