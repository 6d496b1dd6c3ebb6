"""ADADELTA from many start points that wait in a queue: the optimizer of the paper, section II-D."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from symgraph.errors import InputError
from symgraph.optimizers.climb import climb
from symgraph.optimizers.lbfgs import positive_whole
from symgraph.optimizers.problem import Choices, Evaluator, Optimizer, Outcome, Problem, Run, Search, best_of
from symgraph.slots import Array

LANES = 16  # points that one process moves side by side; they take the place of the paper's processes
POLISHED = 2  # best runs of each combination of selections that are polished
POLISH_ITERATIONS = 200


@dataclass(frozen=True)
class Adadelta(Optimizer):
    """Multi-start ADADELTA with a start-point queue and a list of finished points.

    A point is taken from the queue, moved for at most `run_iterations` steps and ends a run (1) converged:
    0 ≤ J_new − J < tolerance, (2) at the iteration limit, or (3) oscillating: `oscillation` steps lowered J.
    Case (1) joins the finished list, (2) and (3) only when better than all so far; every point goes back to the queue.
    The search ends when (a) `finished` points are finished, (b) the queue is empty, or (c) `total_iterations` are spent.
    From the queue comes the best point (probability 0.4), a random one (0.3), or else the worst is dropped for a
    perturbed copy of the best finished point.

    The defaults go beyond the paper where measurement showed gain: steps in units of the bounds' range, starts spread
    evenly over selections and bounds, the best iterate instead of the last, a polish by L-BFGS before selections are
    compared. `Adadelta.paper()` has the paper's settings.

    Args:
        starts: start points.
        decay: ρ of ADADELTA.
        epsilon: ε of ADADELTA [range² if scaled, else unit²]; sets the first steps, about √(ε/(1 − ρ)).
        run_iterations: steps of one run.
        total_iterations: steps of all runs together; default starts · run_iterations.
        finished: finished points wanted; default all starts.
        tolerance: gain below which a step counts as converged [reward].
        oscillation: falling steps that end a run.
        sampling: "spread" (Latin hypercube), "uniform" or "gaussian" (around the middle, a quarter of the range).
        evenly: spread the starts evenly over the combinations of selections and let each have its turn before any
            comes back; else selections and turns are random as in the paper.
        scaled: steps in units of the bounds' range.
        keep_best: a run's result is its best iterate; else its last.
        polish: climb on from the best runs of each combination with L-BFGS.
        start_per_selection: one more start for each selection variable, as in the paper.
        processes: worker processes that share the runs.

    Source: Yamaguchi & Atkeson, Humanoids 2016, section II-D; Zeiler, arXiv:1212.5701 (ADADELTA).
    """

    starts: int = 20
    decay: float = 0.9
    epsilon: float = 1e-4
    run_iterations: int = 300
    total_iterations: int | None = None
    finished: int | None = None
    tolerance: float = 1e-10
    oscillation: int = 10
    sampling: str = "spread"
    evenly: bool = True
    scaled: bool = True
    keep_best: bool = True
    polish: bool = True
    start_per_selection: bool = False
    processes: int = 1

    @classmethod
    def paper(cls, processes: int = 1) -> Adadelta:
        """Return the settings behind the paper's results."""
        return cls(
            starts=20,
            decay=0.98,
            epsilon=1e-6,
            run_iterations=50,
            total_iterations=2000,
            finished=20,
            tolerance=1e-6,
            oscillation=10,
            sampling="uniform",
            evenly=False,
            scaled=False,
            keep_best=False,
            polish=False,
            start_per_selection=True,
            processes=processes,
        )

    def __post_init__(self) -> None:
        for name in ("starts", "run_iterations", "oscillation", "processes"):
            positive_whole(name, getattr(self, name), "Adadelta")
        for name in ("total_iterations", "finished"):
            if getattr(self, name) is not None:
                positive_whole(name, getattr(self, name), "Adadelta")
        if not 0.0 < self.decay < 1.0:
            raise InputError(f"Adadelta: decay = {self.decay!r}; give a number between 0 and 1")
        if not self.epsilon > 0.0:
            raise InputError(f"Adadelta: epsilon = {self.epsilon!r}; give a positive number")
        if not self.tolerance >= 0.0:
            raise InputError(f"Adadelta: tolerance = {self.tolerance!r}; give a number of at least 0")
        if self.sampling not in ("spread", "uniform", "gaussian"):
            raise InputError(f"Adadelta: sampling = {self.sampling!r}; give 'spread', 'uniform' or 'gaussian'")

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        queue = _Queue(self, problem, rng)
        total = self.total_iterations or len(queue.waiting) * self.run_iterations
        wanted = self.finished or len(queue.waiting)
        spent = 0
        ended: list[Run] = []
        finished: list[Run] = []
        interrupted, deaths = False, 0
        try:
            with _workers(self.processes) as move:
                while len(finished) < wanted and queue.waiting and spent < total:
                    batch = queue.pop(LANES * self.processes, wanted - len(finished), finished)
                    limit = min(self.run_iterations, max(1, (total - spent) // len(batch)))
                    runs, died = move(self, problem, batch, limit)
                    deaths += died
                    for run in runs:
                        spent += run.iterations
                        best = best_of(finished)
                        if run.outcome == "converged" or (
                            run.outcome in ("iteration limit", "oscillation") and (best is None or run.value > best.value)
                        ):
                            finished.append(run)
                        if run.outcome in ("converged", "iteration limit", "oscillation"):
                            queue.waiting.append(run)
                    ended += runs
                    problem.progress.update(max(spent / total, len(finished) / wanted), 1.0)
                    if deaths > MAX_DEATHS:
                        break
        except KeyboardInterrupt:
            interrupted = True
        if self.polish and not interrupted:
            ended += self._polished(problem, ended)
            interrupted = any(run.outcome == "interrupted" for run in ended)
        status = f"best of {len(ended)} runs from {queue.starts} starts"
        return Search(ended, status, interrupted)

    def _polished(self, problem: Problem, runs: list[Run]) -> list[Run]:
        """Climb on from the best runs of each combination of selections."""
        by_choice: dict[bytes, list[Run]] = {}
        for run in sorted(runs, key=lambda run: -run.value):
            group = by_choice.setdefault(run.choices.tobytes(), [])
            if np.isfinite(run.value) and len(group) < POLISHED:
                group.append(run)
        chosen = [run for group in by_choice.values() for run in group]
        if not chosen:
            return []
        points, choices = np.array([run.point for run in chosen]), np.array([run.choices for run in chosen])
        polished = climb(problem, points, choices, POLISH_ITERATIONS, 1e-9)
        for before, after in zip(chosen, polished, strict=True):
            after.start = before.start
        return polished


class _Queue:
    """The start points that wait, fresh ones and those that come back."""

    def __init__(self, settings: Adadelta, problem: Problem, rng: np.random.Generator) -> None:
        self._problem = problem
        self._rng = rng
        count = settings.starts + (len(problem.allowed) if settings.start_per_selection else 0)
        choices = problem.draw_choices(rng, count, settings.evenly)
        points = problem.draw_points(rng, count, settings.sampling)
        if problem.guesses:
            guessed, guessed_choices = problem.started_from_guesses(rng)
            points, choices = np.concatenate([guessed, points]), np.concatenate([guessed_choices, choices])
        self.starts = len(points)
        values, _ = problem.evaluate(points, choices)
        self._turns = len(points) if settings.evenly else 0  # starts at the head of the queue that have their turn first
        self.waiting = [
            Run(point, point, choice, float(value), "iteration limit", 0)
            for point, choice, value in zip(points, choices, values, strict=True)
        ]

    def pop(self, most: int, wanted: int, finished: list[Run]) -> list[Run]:
        """Take up to `most` points, no more than are still wanted."""
        batch: list[Run] = []
        while self.waiting and len(batch) < min(most, wanted):
            batch.append(self._pop_one(finished))
        return batch

    def _pop_one(self, finished: list[Run]) -> Run:
        if self._turns:
            self._turns -= 1
            return self.waiting.pop(0)
        draw = self._rng.random()
        if draw < 0.4:
            return self.waiting.pop(int(np.argmax([run.value for run in self.waiting])))
        best = best_of(finished)
        if draw < 0.7 or best is None:
            return self.waiting.pop(int(self._rng.integers(len(self.waiting))))
        self.waiting.pop(int(np.argmin([run.value for run in self.waiting])))
        low, high = self._problem.low, self._problem.high
        noise = 0.001 * (high - low) * self._rng.standard_normal(self._problem.n)
        point = np.clip(best.point + noise, low, high)
        return Run(point, point, best.choices, -np.inf, "iteration limit", 0)


def ascend(settings: Adadelta, evaluate: Evaluator, box: tuple[Array, Array], points: Array, choices: Choices, limit: int) -> list[Run]:
    """Move points (P, n) by ADADELTA for at most `limit` steps each.

    ADADELTA on gradient g:  v ← ρv + (1 − ρ)g²,  Δ = g √(w + ε)/√(v + ε),  w ← ρw + (1 − ρ)Δ²,  x ← clip(x + Δ).

    Source: Zeiler, arXiv:1212.5701, algorithm 1, with the sign of ascent.
    """
    low, high = box
    span = high - low if settings.scaled else np.ones_like(low)
    rho, epsilon = settings.decay, settings.epsilon
    x = points.copy()
    value, gradient = evaluate(x, choices)
    best_x, best_value = x.copy(), value.copy()
    v, w = np.zeros_like(x), np.zeros_like(x)
    falls = np.zeros(len(x), dtype=np.int64)
    spent = np.zeros(len(x), dtype=np.int64)
    outcome: list[Outcome] = ["iteration limit"] * len(x)
    history = [[float(j)] for j in value]
    active = np.isfinite(value)
    for p in np.flatnonzero(~active):
        outcome[p] = "not finite"
    for _ in range(limit):
        rows = np.flatnonzero(active)
        if not rows.size:
            break
        g = gradient[rows] * span
        v[rows] = rho * v[rows] + (1.0 - rho) * g * g
        step = g * np.sqrt((w[rows] + epsilon) / (v[rows] + epsilon))
        w[rows] = rho * w[rows] + (1.0 - rho) * step * step
        x[rows] = np.clip(x[rows] + step * span, low, high)
        new, gradient[rows] = evaluate(x[rows], choices[rows])
        gain = new - value[rows]
        value[rows] = new
        spent[rows] += 1
        falls[rows] += gain < 0.0
        better = new > best_value[rows]
        best_x[rows[better]], best_value[rows[better]] = x[rows[better]], new[better]
        for row, j in zip(rows, new, strict=True):
            history[row].append(float(j))
        ends: tuple[tuple[Any, Outcome], ...] = (
            (falls[rows] >= settings.oscillation, "oscillation"),
            ((gain >= 0.0) & (gain < settings.tolerance), "converged"),
            (~np.isfinite(new), "not finite"),
        )
        for reached, name in ends:
            for row in rows[reached]:
                outcome[row], active[row] = name, False
    if settings.keep_best:
        x, value = best_x, best_value
    return [Run(points[p], x[p], choices[p], float(value[p]), outcome[p], int(spent[p]), history[p]) for p in range(len(x))]


MAX_DEATHS = 2  # workers that may die before the search ends with what it has


@contextmanager
def _workers(processes: int) -> Iterator[Any]:
    """Yield the function that moves a batch of runs, in this process or in several."""
    if processes == 1:
        yield _move_here
        return
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    with Parallel(n_jobs=processes, max_nbytes=None) as parallel:

        def move(settings: Adadelta, problem: Problem, batch: list[Run], limit: int) -> tuple[list[Run], int]:
            blocks = [batch[i::processes] for i in range(processes) if batch[i::processes]]
            tasks = [delayed(ascend)(*_ascend_arguments(settings, problem, block, limit)) for block in blocks]
            try:
                runs = [run for block in parallel(tasks) for run in block]
            except TerminatedWorkerError:
                for run in batch:
                    run.outcome = "worker died"
                return batch, 1
            order = [run for block in blocks for run in block]
            return _with_starts(order, runs), 0

        yield move


def _move_here(settings: Adadelta, problem: Problem, batch: list[Run], limit: int) -> tuple[list[Run], int]:
    return _with_starts(batch, ascend(*_ascend_arguments(settings, problem, batch, limit))), 0


def _ascend_arguments(settings: Adadelta, problem: Problem, batch: list[Run], limit: int) -> tuple[Any, ...]:
    points, choices = np.array([run.point for run in batch]), np.array([run.choices for run in batch])
    return settings, problem.evaluate, (problem.low, problem.high), points, choices, limit


def _with_starts(before: list[Run], after: list[Run]) -> list[Run]:
    """A point that came back from the queue keeps where it first started."""
    for old, new in zip(before, after, strict=True):
        new.start = old.start
    return after
