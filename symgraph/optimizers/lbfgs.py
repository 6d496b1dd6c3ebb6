"""Multi-start L-BFGS: sample widely, climb from the most promising samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symgraph.errors import InputError
from symgraph.optimizers.problem import Choices, Optimizer, Problem, Run, Search
from symgraph.slots import Array

MOST_SAMPLES = 1024  # of one combination of selections: all are compared with each other


@dataclass(frozen=True)
class Lbfgs(Optimizer):
    """Multi-start L-BFGS within the bounds; the default of `solve`.

    For each combination of selections, `samples` points are spread over the bounds and evaluated; of the better half,
    those farthest from any better one are climbed from, since they most likely lead to other maxima. Where there are
    more combinations than `starts`, those with the best samples are climbed in, and the status says how many.

    Args:
        starts: points climbed from, shared evenly by the combinations of selections (at least one each).
        samples: points evaluated per start, up to 1024 for a combination.
        iterations: gradient evaluations of one climb at most.
        tolerance: largest element of the projected gradient, per range and relative to the spread of J over the bounds,
            that counts as converged.

    Source: Liu & Nocedal 1989 (L-BFGS); Lewis & Overton 2013 (its line search, which gets past kinks); the choice of
        start points after Rinnooy Kan & Timmer 1987.
    """

    starts: int = 16
    samples: int = 8
    iterations: int = 2000
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        for name in ("starts", "samples", "iterations"):
            positive_whole(name, getattr(self, name), "Lbfgs")
        number("tolerance", self.tolerance, "Lbfgs", 0.0)

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        points, choices = promising_points(problem, rng, self.starts, self.samples)
        if problem.guesses:
            guessed, guessed_choices = problem.started_from_guesses(rng)
            points, choices = np.concatenate([guessed, points]), np.concatenate([guessed_choices, choices])
        runs = climbed(problem, points, choices, self.iterations, self.tolerance)
        return Search(runs, status_of(problem, runs, len(points)), interrupted=len(runs) < len(points))


def status_of(problem: Problem, runs: list[Run], starts: int) -> str:
    """Say how many starts a result is the best of, and whether combinations of selections were left out."""
    tried = len({run.choices.tobytes() for run in runs})
    if tried == problem.combinations:
        return f"best of {starts} starts"
    return f"best of {starts} starts, which tried {tried} of {problem.combinations} combinations of selections"


def climbed(problem: Problem, points: Array, choices: Choices, iterations: int, tolerance: float) -> list[Run]:
    """Climb from points (P, n) under choices (P, s); an interrupt ends it with the runs so far."""
    hot = problem.one_hot(choices)
    runs: list[Run] = []
    try:
        for p in range(len(points)):
            ended = problem.kernel.climb(points[p], hot[p], iterations, tolerance * problem.scale)
            runs.append(Run.of(points[p], choices[p], ended))
            problem.progress.update(p + 1, len(points))
    except KeyboardInterrupt:
        pass
    return runs


def promising_points(problem: Problem, rng: np.random.Generator, starts: int, samples: int) -> tuple[Array, Choices]:
    """Return start points (P, n) and their choices (P, s): the most promising of samples spread over the bounds."""
    looked_at = min(problem.combinations, max(starts, MOST_SAMPLES))
    groups = problem.draw_choices(rng, looked_at, evenly=True)
    each = max(1, starts // looked_at)
    count = max(each, min(each * samples, MOST_SAMPLES)) if problem.n else 1
    points = np.concatenate([problem.draw_points(rng, count, "spread") for _ in groups])
    choices = np.repeat(groups, count, axis=0)
    values = problem.values(points, choices)
    unit = problem.unit(points)
    kept = []
    for k in range(looked_at):
        block = np.arange(k * count, (k + 1) * count)
        kept += [block[i] for i in _peaks(unit[block], values[block], each)]
    if looked_at > starts:  # not every combination has a start: those with the best samples have
        kept = [kept[i] for i in np.argsort(-values[kept], kind="stable")[:starts]]
    return points[kept], choices[kept]


def _peaks(unit: Array, values: Array, count: int) -> list[int]:
    """Return the indices of the best sample and of those in the better half that lie farthest from any better one."""
    order = np.argsort(-values, kind="stable")[: max(count, (len(values) + 1) // 2)]
    if len(order) <= count:
        return [int(i) for i in order]
    squares = (unit[order] ** 2).sum(axis=1)
    distances = squares[:, None] + squares[None] - 2.0 * unit[order] @ unit[order].T
    better = np.tri(len(order), k=-1, dtype=bool)  # [i, j]: j is better than i
    to_better = np.where(better, distances, np.inf).min(axis=1)
    return [int(i) for i in order[np.argsort(-to_better, kind="stable")[:count]]]


def number(name: str, value: object, owner: str, low: float, high: float = np.inf) -> None:
    """Raise InputError unless the setting is a finite number of at least `low` and below `high`."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value < high:
        limits = f"of at least {low:g}" if high == np.inf else f"in [{low:g}, {high:g})"
        raise InputError(f"{owner}: {name} = {value!r}; give a number {limits}")


def positive_whole(name: str, value: object, owner: str) -> None:
    """Raise InputError unless the setting is a positive whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{owner}: {name} = {value!r}; give a positive whole number")
