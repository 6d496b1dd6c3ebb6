"""Projected L-BFGS over many points side by side: the local search behind `Lbfgs` and the polish of `Adadelta`.

Each row of an array is one point with its own step and memory; one evaluation of all of them per pass makes the cost of
Python small beside that of the gradients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from symgraph.optimizers.problem import Choices, Outcome, Problem, Run
from symgraph.slots import Array

FIRST_STEP = 0.05  # length of the first step as a share of the range: no curvature is known yet
LONGEST_STEP = 0.5  # no single step crosses more than half of the range
ARMIJO = 1e-4  # sufficient decrease (Nocedal & Wright 2006, equation 3.4)
SMALLEST_GAIN = 1e-15  # relative to the value: less cannot be told from rounding
MAX_BACKTRACKS = 40


@dataclass
class _Memory:
    """The last m steps and gradient changes of each point, newest last."""

    s: Array  # (P, m, n)
    y: Array  # (P, m, n)

    @classmethod
    def empty(cls, points: int, m: int, n: int) -> _Memory:
        return cls(np.zeros((points, m, n)), np.zeros((points, m, n)))

    def direction(self, gradient: Array, free: Array) -> Array:
        """Return −H·gradient within the free variables by the two-loop recursion (Nocedal & Wright 2006, algorithm 7.4)."""
        s, y = self.s * free[:, None, :], self.y * free[:, None, :]
        sy = np.einsum("pmn,pmn->pm", s, y)
        used = sy > 0.0
        rho = np.divide(1.0, sy, out=np.zeros_like(sy), where=used)
        q = gradient * free
        m = s.shape[1]
        alpha = np.zeros_like(sy)
        for i in range(m - 1, -1, -1):
            alpha[:, i] = rho[:, i] * (s[:, i] * q).sum(axis=1)
            q = q - alpha[:, i, None] * y[:, i]
        scale = np.ones(len(q))
        for i in range(m):  # the newest pair that can be used sets the scale
            yy = (y[:, i] * y[:, i]).sum(axis=1)
            scale = np.where(used[:, i], sy[:, i] / np.where(yy > 0, yy, 1.0), scale)
        q = q * scale[:, None]
        for i in range(m):
            beta = rho[:, i] * (y[:, i] * q).sum(axis=1)
            q = q + (alpha[:, i] - beta)[:, None] * s[:, i]
        return -q

    def push(self, rows: Array, s: Array, y: Array) -> None:
        self.s[rows] = np.concatenate([self.s[rows, 1:], s[:, None]], axis=1)
        self.y[rows] = np.concatenate([self.y[rows, 1:], y[:, None]], axis=1)

    def forget(self, rows: Array) -> None:
        self.s[rows] = 0.0
        self.y[rows] = 0.0


def climb(
    problem: Problem,
    points: Array,
    choices: Choices,
    iterations: int,
    tolerance: float,
    memory: int = 8,
    report: Callable[[int], None] = lambda passes: None,
) -> list[Run]:
    """Climb from each point to a local maximum within the bounds.

    Works on f = −J over u = (x − low)/(high − low) ∈ [0, 1]ⁿ, so that a slot of range 0.003 and one of range 3 move alike.

    Args:
        problem: the values, gradients and bounds.
        points: (P, n) start points.
        choices: (P, s) their selections, which stay.
        iterations: evaluations of one point at most.
        tolerance: largest element of the projected gradient in u, relative to 1 + |J|, that counts as converged.
        memory: pairs kept for the curvature.
        report: called with the number of passes.

    Returns:
        A run per point, best iterate kept; a KeyboardInterrupt ends all with the outcome "interrupted".
    """
    count, n = points.shape
    low, span = problem.low, problem.high - problem.low

    def evaluate(u: Array, rows: Array) -> tuple[Array, Array]:
        values, gradients = problem.evaluate(low + span * u, choices[rows])
        return -values, -gradients * span

    everyone = np.arange(count)
    u = np.clip((points - low) / np.where(span > 0, span, 1.0), 0.0, 1.0)
    f, g = evaluate(u, everyone)
    history = [[-float(value)] for value in f]
    spent = np.ones(count, dtype=np.int64)
    outcome: list[Outcome] = ["not finite" if not np.isfinite(value) else "iteration limit" for value in f]
    active = np.isfinite(f)
    if n == 0:
        active[:] = False
        outcome = ["converged" if o == "iteration limit" else o for o in outcome]
    pairs = _Memory.empty(count, min(memory, max(n, 1)), n)
    reach = np.full(count, FIRST_STEP)  # step length where no curvature is known
    fresh = np.ones(count, dtype=bool)  # needs a new direction (else: in the middle of a line search)
    d, t, backtracks = np.zeros_like(u), np.ones(count), np.zeros(count, dtype=np.int64)
    flat = np.zeros(count, dtype=np.int64)  # steps in a row whose gain was lost in rounding

    passes = 0
    try:
        while active.any():
            rows = np.flatnonzero(active & fresh)
            if rows.size:
                held = ((u[rows] <= 0.0) & (g[rows] > 0.0)) | ((u[rows] >= 1.0) & (g[rows] < 0.0))
                free = ~held
                slope = np.abs(np.where(held, 0.0, g[rows])).max(axis=1)
                done = slope <= tolerance * (1.0 + np.abs(f[rows]))
                for row in rows[done]:
                    outcome[row], active[row] = "converged", False
                rows, free = rows[~done], free[~done]
            if rows.size:
                own = _Memory(pairs.s[rows], pairs.y[rows])
                step = own.direction(g[rows], free.astype(float))
                blind = ~(own.s.any(axis=(1, 2)))
                descent = (step * g[rows]).sum(axis=1)
                blind |= ~(descent < 0.0)
                steepest = -g[rows] * free
                steepest *= (reach[rows] / np.abs(steepest).max(axis=1))[:, None]
                step = np.where(blind[:, None], steepest, step)
                longest = np.abs(step).max(axis=1)
                step *= np.minimum(1.0, LONGEST_STEP / longest)[:, None]
                d[rows], t[rows], backtracks[rows], fresh[rows] = step, 1.0, 0, False
            rows = np.flatnonzero(active)
            if not rows.size:
                break
            trial = np.clip(u[rows] + t[rows, None] * d[rows], 0.0, 1.0)
            f_new, g_new = evaluate(trial, rows)
            spent[rows] += 1
            moved = trial - u[rows]
            predicted = (g[rows] * moved).sum(axis=1)
            noise = SMALLEST_GAIN * np.abs(f[rows])
            good = f_new <= f[rows] + ARMIJO * predicted + noise
            good &= np.isfinite(f_new)

            up = rows[good]
            if up.size:
                s, y = moved[good], g_new[good] - g[up]
                sy, ss = (s * y).sum(axis=1), (s * s).sum(axis=1)
                curved = sy > 1e-12 * np.sqrt(ss * (y * y).sum(axis=1))
                pairs.push(up[curved], s[curved], y[curved])
                # Curved the wrong way: what was learnt does not help; go on along the gradient with longer steps.
                wrong = up[~curved]
                pairs.forget(wrong)
                reach[wrong] = np.clip(2.0 * np.sqrt(ss[~curved]), 1e-12, LONGEST_STEP)
                gain = f[up] - f_new[good]
                flat[up] = np.where(gain <= noise[good], flat[up] + 1, 0)
                u[up], f[up], g[up], fresh[up] = trial[good], f_new[good], g_new[good], True
                for row in up[flat[up] >= 2]:
                    outcome[row], active[row] = "converged", False
            for row in rows:
                history[row].append(-float(f[row]))
            down = rows[~good]
            if down.size:
                # Minimise the parabola through f, its slope and the new value, within a tenth to a half of the step.
                rise = f_new[~good] - f[down] - predicted[~good]
                with np.errstate(all="ignore"):
                    shrink = np.where(np.isfinite(rise), -predicted[~good] / (2.0 * rise), 0.1)
                t[down] *= np.clip(np.nan_to_num(shrink, nan=0.1), 0.1, 0.5)
                backtracks[down] += 1
                tiny = np.abs(moved[~good]).max(axis=1) <= 1e-16
                for row in down[(backtracks[down] > MAX_BACKTRACKS) | tiny]:
                    # No step gains any more. With curvature pairs this may be their fault: once more along the gradient.
                    if pairs.s[row].any():
                        pairs.forget(np.array([row]))
                        reach[row], fresh[row] = 1e-3, True
                    else:
                        outcome[row], active[row] = "stalled", False
            active &= spent < iterations
            passes += 1
            report(passes)
    except KeyboardInterrupt:
        outcome = ["interrupted" if running else o for o, running in zip(outcome, active, strict=True)]
    ends = low + span * u
    return [
        Run(points[p], ends[p], choices[p], -float(f[p]), outcome[p], int(spent[p]), history[p]) for p in everyone
    ]
