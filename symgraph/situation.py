"""Situation: a checked start state, and all that is derived from the tree for it, functions and kernels."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from symgraph.compile import make_kernel
from symgraph.compile.interpreted import FlatFunction
from symgraph.compile.kernel import NEVER, BoundKernel, Kernel, Stop
from symgraph.expectation import Expectation, expected_value
from symgraph.slots import Array, Gaussian
from symgraph.tree import Tree


class Build:
    """All that is derived from the tree for one set of uncertain start states, each part when it is first needed."""

    def __init__(self, tree: Tree, uncertain: frozenset[str], compiled: bool, risk: float, single: bool) -> None:
        self._tree = tree
        self._uncertain = uncertain
        self._compiled = compiled
        self._risk = risk
        self._single = single
        self.kept: dict[Any, Any] = {}  # what optimizers derive from the expression and use again
        self.lock = threading.Lock()  # of what is kept

    @cached_property
    def expectation(self) -> Expectation:
        return expected_value(self._tree, self._uncertain, risk=self._risk)

    @cached_property
    def relaxed(self) -> Expectation:
        """With selections that may be anything between their choices."""
        return expected_value(self._tree, self._uncertain, relaxed=True, risk=self._risk)

    @cached_property
    def function(self) -> ca.Function:
        """inputs → J (1, 1), ∂J/∂actions (n, 1)."""
        return self.expectation.value_and_gradient()

    @cached_property
    def interpreted(self) -> FlatFunction:
        """The same in CasADi's interpreter, for single points."""
        return FlatFunction(self.function)

    @cached_property
    def hessian(self) -> FlatFunction:
        """inputs → ∂²J/∂actions² (n, n), in CasADi's interpreter."""
        return FlatFunction(self.expectation.hessian())

    @cached_property
    def margins(self) -> FlatFunction:
        """inputs → by how much constraints are missed (k, 1), in CasADi's interpreter."""
        return FlatFunction(self.expectation.margins_function())

    @cached_property
    def kernel(self) -> Kernel:
        """J and its gradient at many points, compiled where that is possible."""
        return make_kernel(self.expectation.value_function(), lambda: self.function, self._compiled, self._single)

    @cached_property
    def merit_kernel(self) -> Kernel:
        """Likewise of the augmented Lagrangian, by which constraints are kept."""
        expectation = self.expectation
        return make_kernel(expectation.merit_function(), expectation.merit_and_gradient, self._compiled, self._single)

    def compile(self) -> None:
        """Make all that searches need."""
        self.kernel  # noqa: B018 made when it is first asked for
        if self.expectation.constraints:
            self.merit_kernel.compile_for_one()  # by it one climbs from each start by itself

    @property
    def has_kernel(self) -> bool:
        return "kernel" in self.__dict__

    @property
    def has_merit_kernel(self) -> bool:
        return "merit_kernel" in self.__dict__


@dataclass(frozen=True)
class Situation:
    """A checked start state, ready to be evaluated: the objective's inputs but the actions and selections."""

    given: dict[str, Gaussian]
    build: Build
    means: Array
    covariances: Array

    @cached_property
    def shared(self) -> list[Array]:
        """The inputs after actions and selections, with the parameters' values when they are first asked for."""
        parameters = self.build.expectation.inputs.parameters
        return [self.means, self.covariances, *(p.value.ravel(order="F") for p in parameters)]

    def bind(self, low: Array, high: Array, stop: Stop = NEVER, threads: int = 1) -> BoundKernel:
        """Return the kernel of J at this state, for actions between bounds (n,); a stop ends searches early."""
        return self.build.kernel.bind(self.shared, low, high, stop, threads)

    def bind_merit(
        self, low: Array, high: Array, multipliers: Array, weights: Array, stop: Stop = NEVER
    ) -> BoundKernel:
        """Return the kernel of the augmented Lagrangian, with multipliers and weights (k,) of the constraints."""
        return self.build.merit_kernel.bind([*self.shared, multipliers, weights], low, high, stop)
