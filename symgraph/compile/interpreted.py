"""Kernels in CasADi's virtual machine: no compiler needed, ready at once, several times slower."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any, cast

import casadi as ca
import numpy as np

from symgraph.compile.kernel import NEVER, AdadeltaSteps, BoundKernel, Ended, Kernel, Outcome, Stop
from symgraph.slots import Array

# The search of search.c, step for step: its constants.
FIRST_STEP = 0.05
LONGEST_STEP = 0.5
ARMIJO = 1e-4
SMALLEST_GAIN = 1e-15
MOST_PAIRS = 8
CURVATURE = 0.9
LOOSE = 1e3
HIDDEN = 10.0
DECREASE = 0.1
MOST_ROUNDS = 10
MOST_TRIES = 50


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
            try:
                self._evaluate()
            except RuntimeError:  # a model that calls solvers or Python failed at this point
                return [np.full_like(column, np.nan) for column in self._outputs]
            return [column.copy() for column in self._outputs]

    def __reduce__(self) -> tuple[type[FlatFunction], tuple[ca.Function]]:
        return FlatFunction, (self._function,)


class InterpretedKernel(Kernel):
    """A kernel in CasADi's virtual machine."""

    def __init__(self, function: ca.Function) -> None:
        self.function = FlatFunction(function)

    def bind(
        self, shared: Sequence[Array], low: Array, high: Array, stop: Stop = NEVER, threads: int = 1
    ) -> BoundKernel:
        return _BoundInterpreted(self.function, list(shared), low, high, stop)

    def compile_for_one(self) -> None:
        """There is nothing to compile."""


class _BoundInterpreted(BoundKernel):
    def __init__(self, function: FlatFunction, shared: list[Array], low: Array, high: Array, stop: Stop) -> None:
        self._function = function
        self._shared = shared
        self._low = low
        self._high = high
        self._stop = stop

    def evaluate(self, actions: Array, selections: Array) -> tuple[Array, Array]:
        values, gradients = np.full(len(actions), np.nan), np.full(actions.shape, np.nan)
        for p in range(len(actions)):
            if p and self._stop:
                break
            values[p], gradients[p] = self._at(actions[p], selections[p])
        return values, gradients

    def climb(
        self, starts: Array, selections: Array, iterations: int, tolerances: Array
    ) -> Iterator[tuple[int, Ended]]:
        for p in range(len(starts)):
            if p and self._stop:
                return
            yield p, self._climb(starts[p], selections[p], iterations, float(tolerances[p]))

    def ascend(
        self, starts: Array, selections: Array, limit: int, steps: AdadeltaSteps, scales: Array
    ) -> Iterator[tuple[int, Ended]]:
        for p in range(len(starts)):
            if p and self._stop:
                return
            yield p, self._ascend(starts[p], selections[p], limit, steps, float(scales[p]))

    def _climb(self, start: Array, selection: Array, iterations: int, tolerance: float) -> Ended:
        def place(u: Array) -> Array:
            return np.clip(self._low + span * u, self._low, self._high)  # rounding must not carry it past a bound

        def descend(u: Array) -> tuple[float, Array, bool]:
            value, gradient = self._at(place(u), selection)
            with np.errstate(invalid="ignore"):  # an infinite slope by what is held
                gradient = -gradient * span
            return -value, gradient, bool(np.isfinite(value) and np.isfinite(gradient).all())

        span = self._high - self._low
        u = np.clip((start - self._low) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
        f, g, finite = descend(u)
        if not finite:
            return Ended(start, -np.inf, "not finite", np.array([-np.inf]))
        pairs: list[tuple[Array, Array]] = []  # (step, gradient change), newest last
        most = min(max(len(u), 1), MOST_PAIRS)
        history, outcome = [-f], "iteration limit"
        fresh, flat, tries, doubted = True, 0, 0, False
        d, descent, longest, slope = np.zeros_like(u), 0.0, 0.0, 0.0
        t, t_low, t_high = 1.0, 0.0, np.inf  # steps between which the line search looks
        f_low, u_low, g_low = f, u, g
        f_best, u_best, flattest = f, u, np.inf
        while True:
            noise = SMALLEST_GAIN * abs(f)
            accepted = False
            if self._stop:
                iterations, outcome = len(history), "time limit"
            if fresh:
                free = ~((span <= 0.0) | ((u <= 0.0) & (g > 0.0)) | ((u >= 1.0) & (g < 0.0)))
                slope = float(np.abs(g * free).max(initial=0.0))
                if slope <= tolerance:
                    outcome = "converged"
                    break
                if slope < flattest / 2.0:  # a gain that values are too coarse for
                    flattest, flat = slope, 0
                d = _direction(pairs, u, g, free.astype(float))
                if pairs and 0.0 < -(d @ g) <= noise and slope <= LOOSE * tolerance:
                    outcome = "converged"  # rounding would hide what is left to gain
                    break
                if not pairs or not d @ g < 0.0:  # nothing known of the curvature: along the gradient
                    d = -g * free * (FIRST_STEP / slope)
                descent, longest = float(d @ g), float(np.abs(d).max())
                t = LONGEST_STEP / longest if longest > LONGEST_STEP else 1.0
                t_low, t_high, tries, fresh = 0.0, np.inf, 0, False
            if len(history) >= iterations:
                accepted = t_low > 0.0
            else:
                trial = np.clip(u + t * d, 0.0, 1.0)
                predicted = float(g @ (trial - u))
                f_trial, g_trial, finite = descend(trial)
                slope_trial = float(g_trial @ (d * ((trial > 0.0) & (trial < 1.0))))
                tries += 1
                gained = f_trial <= f + ARMIJO * predicted + noise or (
                    f_trial <= f_best + HIDDEN * noise
                    and CURVATURE * descent <= slope_trial <= (2.0 * DECREASE - 1.0) * descent
                )
                if finite and predicted < 0.0 and gained:  # the best so far, if not yet a good one
                    t_low, f_low, u_low, g_low = t, f_trial, trial, g_trial
                    accepted = slope_trial >= CURVATURE * descent or f - f_trial <= noise or tries > MOST_TRIES
                    accepted = accepted or (t_high == np.inf and t * longest >= LONGEST_STEP)
                    t = min(4.0 * t, LONGEST_STEP / longest) if t_high == np.inf else (t_low + t_high) / 2.0
                else:
                    t_high = t
                    if t_low > 0.0:
                        t = (t_low + t_high) / 2.0
                    else:  # the minimum of the parabola through f, its slope and the new value, within bounds
                        rise = f_trial - f - predicted
                        shrink = -predicted / (2.0 * rise) if finite and rise > 0.0 else 0.1
                        t *= min(max(shrink, 1e-3 if doubted else 0.1), 0.5)
                    if tries > MOST_TRIES or np.abs(trial - u).max() <= 1e-16:
                        accepted = t_low > 0.0
                        if not accepted:  # no step gains; if the pairs are to blame, the gradient alone still will
                            if not pairs:
                                outcome = "converged" if doubted or slope <= LOOSE * tolerance else "stalled"
                            pairs, fresh = [], True
            if accepted:
                step, change = u_low - u, g_low - g
                if step @ change > 1e-12 * np.sqrt((step @ step) * (change @ change)):
                    pairs = [*pairs, (step, change)][-most:]
                if f - f_low > noise:
                    flat, doubted = 0, False
                elif tries == 1 or doubted:
                    flat += 1
                u, f, g, fresh = u_low, f_low, g_low, True
                if f < f_best:
                    f_best, u_best = f, u
            if len(history) >= iterations:
                break
            history.append(-(min(f, f_low) if t_low > 0.0 and not accepted else f))
            # Gains lost in rounding mean that it has arrived, if the gradient alone, without pairs, gains no more.
            if doubted and flat >= 1:
                outcome = "converged"
            if flat >= 2:
                flat, doubted, pairs = 0, True, []
            if outcome != "iteration limit":
                break
        return Ended(place(u_best), -f_best, cast(Outcome, outcome), np.array(history))

    def _ascend(self, start: Array, selection: Array, limit: int, steps: AdadeltaSteps, scale: float) -> Ended:
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
            if self._stop:
                outcome = "time limit"
                break
            before, last = value, x
            slope = gradient * span / scale
            v = steps.decay * v + (1.0 - steps.decay) * slope * slope
            delta = slope * np.sqrt((w + steps.epsilon) / (v + steps.epsilon))
            w = steps.decay * w + (1.0 - steps.decay) * delta * delta
            x = np.clip(x + delta * span, low, high)
            value, gradient = self._at(x, selection)
            if not (np.isfinite(value) and np.isfinite(gradient).all()):
                history.append(-np.inf)
                x, value, outcome = last, before, "not finite"  # the last finite iterate counts
                break
            history.append(value)
            if value > best_value:
                best, best_value = x, value
            if 0.0 <= value - before < steps.tolerance * scale:
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


def _direction(pairs: list[tuple[Array, Array]], u: Array, gradient: Array, mask: Array) -> Array:
    """Return −H·gradient, but send actions that it would carry past a bound to that bound (Bertsekas 1982)."""
    to_bound = np.zeros_like(u)
    for _ in range(MOST_ROUNDS):
        d = _two_loop(pairs, gradient, mask)
        end = u + d
        hits = (mask > 0.0) & ((end < 0.0) | (end > 1.0))
        if not hits.any():
            break
        downhill = hits & (d * gradient < 0.0)
        to_bound[downhill] = np.where(end < 0.0, 0.0, 1.0)[downhill] - u[downhill]
        mask = np.where(hits, 0.0, mask)
    return np.where(mask > 0.0, d, to_bound)


def _two_loop(pairs: list[tuple[Array, Array]], gradient: Array, mask: Array) -> Array:
    """Return −H·gradient within the free actions (Nocedal & Wright 2006, algorithm 7.4)."""
    d = -mask * gradient
    kept = []
    for s, y in reversed(pairs):
        sy = float((s * mask) @ y)
        used = sy > 1e-12 * np.sqrt(float((s * mask) @ s) * float((y * mask) @ y))
        rho = 1.0 / sy if used else 0.0
        alpha = rho * float((s * mask) @ d)
        d = d - alpha * mask * y
        kept.append((s, y, rho, alpha))
    for _, y, rho, _ in kept:  # the newest pair that can be used sets the scale
        if rho > 0.0:
            d = d / (rho * float((y * mask) @ y))
            break
    for s, y, rho, alpha in reversed(kept):
        d = d + (alpha - rho * float((y * mask) @ d)) * mask * s
    return d
