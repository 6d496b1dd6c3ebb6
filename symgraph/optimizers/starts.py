"""Where searches start and how they climb on: what several optimizers share."""

from __future__ import annotations

import numpy as np

from symgraph.optimizers.problem import Choices, Problem, Run
from symgraph.slots import Array

MOST_SAMPLES = 1024  # of one combination of selections: all are compared with each other


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
            ended = problem.kernel.climb(points[p], hot[p], iterations, tolerance * problem.scale(choices[p]))
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
        problem.remember_scale(groups[k], values[block])
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
