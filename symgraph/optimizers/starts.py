"""Where searches start and how they climb on: what several optimizers share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from symgraph.optimizers.problem import Problem, Run
from symgraph.slots import Array, Choices

MOST_SAMPLES = 1024  # of one combination of selections: all are compared with each other


def status_of(problem: Problem, runs: Sequence[Run]) -> str:
    """Say how many starts a result is the best of, and what makes it less than that."""
    starts = len({run.start.tobytes() + run.choices.tobytes() for run in runs})
    tried = len({run.choices.tobytes() for run in runs})
    left_out = f", which tried {tried} of {problem.combinations} combinations of selections"
    return f"best of {starts} starts{'' if tried == problem.combinations else left_out}"


def climbed(
    problem: Problem, points: Array, choices: Choices, iterations: int, tolerance: float
) -> tuple[list[Run], bool]:
    """Climb from points (P, n) under choices (P, s); return the runs, and whether an interrupt ended it before all."""
    hot = problem.one_hot(choices)
    runs: dict[int, Run] = {}  # by start: which one ends first depends on the machine
    interrupted = False
    scales = np.array([problem.scale(choice) for choice in choices])
    try:
        if problem.constrained is None:
            for p, ended in problem.kernel.climb(points, hot, iterations, tolerance * scales):
                runs[p] = Run.of(points[p], choices[p], ended)
                problem.progress.update(len(runs), len(points))
        else:
            for p in range(len(points)):
                if p and problem.stop:
                    break
                problem.know(choices[p])
                ended = problem.constrained.climb(points[p], choices[p], hot[p], iterations, tolerance, scales[p])
                runs[p] = problem.judge(Run.of(points[p], choices[p], ended))
                problem.progress.update(p + 1, len(points))
    except KeyboardInterrupt:
        interrupted = True
    return [runs[p] for p in sorted(runs)], interrupted


def promising_points(problem: Problem, rng: np.random.Generator, starts: int, samples: int) -> tuple[Array, Choices]:
    """Return start points (P, n) and their choices (P, s): the most promising of samples spread over the bounds."""
    looked_at = min(problem.combinations, max(starts, MOST_SAMPLES))
    groups = problem.draw_choices(rng, looked_at, evenly=True)
    each = max(1, starts // looked_at)
    count = max(each, min(each * samples, MOST_SAMPLES)) if problem.n else 1
    points = problem.draw_points(rng, count, "spread", blocks=looked_at)
    choices = np.repeat(groups, count, axis=0)
    values = problem.values(points, choices)
    by_group = values.reshape(looked_at, count)
    for group, sampled in zip(groups, by_group, strict=True):
        problem.remember_scale(group, sampled)
    merits, met = problem.merits(points, choices, values)
    by_group = merits.reshape(looked_at, count)
    peaks = _peaks(problem.unit(points).reshape(looked_at, count, problem.n), by_group, each)
    kept = (peaks + count * np.arange(looked_at)[:, None]).ravel()
    if looked_at > starts:  # not every combination has a start: those with the best samples have
        kept = kept[np.lexsort((-merits[kept], ~met[kept]))[:starts]]
    else:  # all combinations in turn: a time limit should leave none out
        kept = kept.reshape(looked_at, -1).T.ravel()
    return points[kept], choices[kept]


def most_promising_point(problem: Problem, rng: np.random.Generator, samples: int) -> tuple[Array, Choices]:
    """Return the best (1, n) of samples spread over the bounds and all combinations of selections, with its choices."""
    groups = min(samples, problem.combinations)  # one candidate for each
    points, choices = promising_points(problem, rng, groups, max(1, samples // groups))
    best = problem.most_promising(points, choices)
    return points[best : best + 1], choices[best : best + 1]


def _peaks(unit: Array, values: Array, count: int) -> npt.NDArray[np.int64]:
    """Return in each group the best sample and those of the better half that lie farthest from any better one.

    Args:
        unit: (G, P, n) samples scaled to [0, 1].
        values: (G, P) their values.
        count: how many to return.

    Returns:
        (G, count) indices into P.
    """
    better_half = max(count, (values.shape[1] + 1) // 2)
    order = np.argsort(-values, axis=1, kind="stable")[:, :better_half]
    if better_half <= count:
        return order
    ordered = np.take_along_axis(unit, order[:, :, None], axis=1)
    squares = (ordered**2).sum(axis=2)
    distances = squares[:, :, None] + squares[:, None, :] - 2.0 * ordered @ ordered.transpose(0, 2, 1)
    distances[:, ~np.tri(better_half, k=-1, dtype=bool)] = np.inf  # to better ones only, which stand before
    farthest = np.argsort(-distances.min(axis=2), axis=1, kind="stable")[:, :count]
    return np.take_along_axis(order, farthest, axis=1)
