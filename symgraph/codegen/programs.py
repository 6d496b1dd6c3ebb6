"""From an objective to the programs that a planner needs: what is computed when, and from what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from symgraph.compile import numbers
from symgraph.compile.differentiate import Differentiator, called, handed
from symgraph.compile.halves import in_halves
from symgraph.compile.hoist import Hoister
from symgraph.compile.program import CALLS, Kind, Program
from symgraph.compile.reading import Reader
from symgraph.expectation import Expectation
from symgraph.slots import Array

FIXED = 4  # inputs before the parameters: actions, selections, means, covariances


@dataclass
class Programs:
    """What a planner computes.

    Inputs are, in this order, actions, selections, means, covariances, parameters and what the attributes add.

    Attributes:
        early: means, covariances, parameters, derived → a block: what is the same in all gradients of a search.
        forward: …, pulls, derived, block → J, margins, tape.
        backward: …, pulls, derived, block, tape → the gradient of J + pulls · margins.
        foresee: …, its derived → shares, rewards, variances and moments of all nodes.
        weights: parameters → derived numbers, of the first three programs and of the last one.
    """

    early: Program
    forward: Program
    backward: Program
    foresee: Program
    weights: tuple[Program, Program]
    parameters: Expectation = field(repr=False)

    def derived(self, values: Sequence[Array]) -> list[Array]:
        """Return what follows from the values of the parameters alone, for `early`, … and for `foresee`."""
        return [numbers.run(program, values)[0] for program in self.weights]

    def reads(self) -> list[bool]:
        """Return which parameters are read at all, beyond what is derived from them."""
        count = len(self.parameters.inputs.parameters)
        read = [False] * count
        for program, first in ((self.early, 2), (self.forward, FIXED), (self.backward, FIXED), (self.foresee, FIXED)):
            for i in range(count):
                read[i] = read[i] or is_read(program, first + i)
        return read


def programs_of(expectation: Expectation, outcomes: ca.Function) -> Programs:
    """Cut an objective, its gradient and the outcomes of its nodes into programs.

    Args:
        expectation: the objective.
        outcomes: the expectation's inputs → shares, rewards, variances, moments.
    """
    symbols = expectation.inputs.symbols
    kinds = [Kind.LANE, Kind.BLOCK, Kind.BOUND, Kind.BOUND, *[Kind.WEIGHT] * (len(symbols) - FIXED)]
    function = ca.Function("task", symbols, [expectation.value, ca.densify(expectation.margins)], {"cse": True})
    whole = Differentiator().with_weighted_gradient(Reader(function).program(kinds), by=0)
    weights, rest = Hoister(lanes=False, kind=Kind.WEIGHT, packs=False).halves(whole)
    early, late = Hoister(lanes=False, kind=Kind.BOUND, packs=False).halves(rest)
    forward, backward = in_halves(late, 2)
    seen = Reader(outcomes).program(kinds)
    seen_weights, foresee = Hoister(lanes=False, kind=Kind.WEIGHT, packs=False).halves(seen)
    return Programs(early, forward, backward, foresee, (weights, seen_weights), expectation)


def is_read(program: Program, i: int) -> bool:
    """Whether a program does anything with its i-th input but hand it on to programs that do not."""
    value = program.inputs[i]
    if value in program.outputs:
        return value.size > 0
    for operation in program.operations:
        if value not in operation.args:
            continue
        if operation.code not in CALLS:
            return True
        if operation.code == "switch" and operation.args[0] is value:
            return True
        for callee, args in zip(called(operation), handed(operation), strict=True):
            if any(arg is value and is_read(callee, place) for place, arg in enumerate(args)):
                return True
    return False


def flattened(values: Sequence[Array]) -> Array:
    """Return arrays one after the other."""
    return np.concatenate([np.zeros(0), *values])
