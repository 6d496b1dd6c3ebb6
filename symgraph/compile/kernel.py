"""Kernels: a function of actions with its gradient, evaluated at many points, and local search next to it."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from symgraph.slots import Array

Outcome = Literal["converged", "iteration limit", "oscillation", "stalled", "not finite", "time limit", "drawn"]


class Stop:
    """Ends searches early; may be set from another thread. In another process it is never set.

    Args:
        seconds: after which it will be set, None if nobody means to.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = seconds
        self._flag = ctypes.c_int(0)

    @property
    def address(self) -> int:
        """Of an int that is not 0 once it is set."""
        return ctypes.addressof(self._flag)

    def set(self) -> None:
        self._flag.value = 1

    def __bool__(self) -> bool:
        return bool(self._flag.value)

    def __reduce__(self) -> tuple[type[Stop], tuple[()]]:
        return Stop, ()


NEVER = Stop()  # stays unset


@dataclass(frozen=True)
class AdadeltaSteps:
    """Settings of the ADADELTA iteration; see `symgraph.Adadelta`."""

    decay: float
    epsilon: float
    tolerance: float  # of the size of J
    oscillation: int
    scaled: bool
    keep_best: bool


@dataclass
class Ended:
    """Where a local search from one point ended.

    Attributes:
        point: (n,) actions.
        value: J there; -inf where the start was not finite.
        outcome: why it ended.
        history: J at each gradient on the way.
    """

    point: Array
    value: float
    outcome: Outcome
    history: Array


class BoundKernel(ABC):
    """A kernel with bounds and all inputs but actions and selections in place; of one thread at a time."""

    @abstractmethod
    def evaluate(self, actions: Array, selections: Array) -> tuple[Array, Array]:
        """Evaluate P points.

        Args:
            actions: (P, n), a row per point.
            selections: (P, m) one-hot rows.

        Returns:
            values (P,) and gradients (P, n); not finite where the model is not, or where it was stopped before.
        """

    @abstractmethod
    def climb(
        self, starts: Array, selections: Array, iterations: int, tolerances: Array
    ) -> Iterator[tuple[int, Ended]]:
        """Climb from points to local maxima within the bounds by L-BFGS.

        Args:
            starts: (P, n) actions.
            selections: (P, m) one-hot rows.
            iterations: gradients of one climb at most.
            tolerances: (P,) largest element of the projected gradient over (x − low)/(high − low) that is converged
                [reward].

        Yields:
            the number of a start and where its climb ended, as soon as it has; once a stop is set, not all may come.
        """

    @abstractmethod
    def ascend(
        self, starts: Array, selections: Array, limit: int, steps: AdadeltaSteps, scales: Array
    ) -> Iterator[tuple[int, Ended]]:
        """Move points by ADADELTA for at most `limit` steps each; the rest as for `climb`.

        On gradient g over the scale:  v ← ρv + (1 − ρ)g²,  Δ = g √(w + ε)/√(v + ε),  w ← ρw + (1 − ρ)Δ²,
        x ← clip(x + Δ).

        Args:
            starts: (P, n) actions.
            selections: (P, m) one-hot rows.
            limit: steps.
            steps: settings.
            scales: (P,) sizes of J [reward].

        Source: Zeiler, arXiv:1212.5701, algorithm 1, with the sign of ascent.
        """


class Kernel(ABC):
    """Value (1, 1) and gradient (n, 1) as a function of actions (n, 1), selections (m, 1) and further columns."""

    @abstractmethod
    def bind(
        self, shared: Sequence[Array], low: Array, high: Array, stop: Stop = NEVER, threads: int = 1
    ) -> BoundKernel:
        """Put in what a search does not change.

        Args:
            shared: the inputs after actions and selections, each flat in column-major order.
            low: (n,) lower bounds of the actions.
            high: (n,) upper bounds; an action with low = high is held there.
            stop: ends a search, and an evaluation of many points, after at least one gradient.
            threads: that share the points of one call, where that is possible.
        """

    @abstractmethod
    def compile_for_one(self) -> None:
        """Compile ahead what a search from one point needs."""
