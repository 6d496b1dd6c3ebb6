"""Kernels in CasADi's virtual machine: no compiler needed, ready at once, several times slower."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from symgraph.compile.kernel import AdadeltaSteps, BoundKernel, Ended, Kernel, Outcome
from symgraph.slots import Array


class FlatFunction:
    """A CasADi function between flat arrays, through its buffers: a tenth of the cost of its matrices."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._lock = threading.Lock()
        buffer: Any
        buffer, self._evaluate = function.buffer()
        self._buffer = buffer  # kept alive: it owns what evaluate reads
        self._inputs = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self._outputs = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, column in enumerate(self._inputs):
            buffer.set_arg(i, column.data)
        for i, column in enumerate(self._outputs):
            buffer.set_res(i, column.data)

    def __call__(self, columns: Sequence[Array]) -> list[Array]:
        """Return the results, each flat in column-major order."""
        with self._lock:  # the buffers are one set for all threads
            for kept, column in zip(self._inputs, columns, strict=True):
                kept[:] = column
            self._evaluate()
            return [column.copy() for column in self._outputs]

    def __reduce__(self) -> tuple[type[FlatFunction], tuple[ca.Function]]:
        return FlatFunction, (self._function,)


class InterpretedKernel(Kernel):
    """A kernel in CasADi's virtual machine."""

    def __init__(self, function: ca.Function) -> None:
        self.function = FlatFunction(function)

    def bind(self, shared: Sequence[Array], low: Array, high: Array) -> BoundKernel:
        return _BoundInterpreted(self.function, list(shared), low, high)


class _BoundInterpreted(BoundKernel):
    def __init__(self, function: FlatFunction, shared: list[Array], low: Array, high: Array) -> None:
        self._function = function
        self._shared = shared
        self._low = low
        self._high = high

    def evaluate(self, actions: Array, selections: Array) -> tuple[Array, Array]:
        values, gradients = np.empty(len(actions)), np.empty(actions.shape)
        for p in range(len(actions)):
            values[p], gradients[p] = self._at(actions[p], selections[p])
        return values, gradients

    def climb(self, start: Array, selection: Array, iterations: int, tolerance: float) -> Ended:
        from scipy.optimize import Bounds, minimize

        low, span = self._low, self._high - self._low
        best = Ended(start, -np.inf, "not finite", np.array([-np.inf]))
        history: list[float] = []

        def descend(u: Array) -> tuple[float, Array]:
            value, gradient = self._at(low + span * u, selection)
            if not (np.isfinite(value) and np.isfinite(gradient).all()):
                return np.inf, np.zeros(len(u))  # L-BFGS-B backs off
            if value > best.value:
                best.point, best.value = low + span * u, value
            history.append(best.value)
            return -value, -gradient * span

        u = np.clip((start - low) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
        if not np.isfinite(descend(u)[0]):
            return best
        outcome: Outcome = "converged"
        if (span > 0.0).any():
            options: Any = {"maxfun": iterations, "maxiter": iterations, "ftol": 1e-15, "gtol": tolerance, "maxls": 40}
            box = Bounds(np.zeros(len(u)), (span > 0.0).astype(float))
            found = minimize(descend, u, jac=True, method="L-BFGS-B", bounds=box, options=options)
            outcome = {0: "converged", 1: "iteration limit"}.get(int(found.status), "stalled")  # type: ignore[assignment]
        return Ended(best.point, best.value, outcome, np.array(history))

    def ascend(self, start: Array, selection: Array, limit: int, steps: AdadeltaSteps) -> Ended:
        x, low, high = start.copy(), self._low, self._high
        span = high - low if steps.scaled else np.ones_like(low)
        value, gradient = self._at(x, selection)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return Ended(x, -np.inf, "not finite", np.array([-np.inf]))
        best, best_value, falls = x, value, 0
        v, w = np.zeros_like(x), np.zeros_like(x)
        history = [value]
        outcome: Outcome = "iteration limit"
        while len(history) <= limit:
            before = value
            slope = gradient * span
            v = steps.decay * v + (1.0 - steps.decay) * slope * slope
            delta = slope * np.sqrt((w + steps.epsilon) / (v + steps.epsilon))
            w = steps.decay * w + (1.0 - steps.decay) * delta * delta
            x = np.clip(x + delta * span, low, high)
            value, gradient = self._at(x, selection)
            if not (np.isfinite(value) and np.isfinite(gradient).all()):
                value, outcome = -np.inf, "not finite"
                history.append(value)
                break
            history.append(value)
            if value > best_value:
                best, best_value = x, value
            if 0.0 <= value - before < steps.tolerance:
                outcome = "converged"
                break
            falls += value < before
            if falls >= steps.oscillation:
                outcome = "oscillation"
                break
        end, end_value = (best, best_value) if steps.keep_best else (x, value)
        return Ended(end, end_value, outcome, np.array(history))

    def _at(self, actions: Array, selection: Array) -> tuple[float, Array]:
        value, gradient = self._function([actions, selection, *self._shared])
        return float(value[0]), gradient
