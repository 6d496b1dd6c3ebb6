"""Multi-start L-BFGS: sample widely, climb from the most promising samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symgraph.optimizers.problem import Optimizer, Problem, Run, Search, best_of
from symgraph.optimizers.settings import number, positive_whole
from symgraph.optimizers.starts import climbed, promising_points, status_of
from symgraph.slots import Choices

NEIGHBOURS = 8  # of a combination of selections that are climbed in at once


@dataclass(frozen=True)
class Lbfgs(Optimizer):
    """Multi-start L-BFGS within the bounds; the default of `solve`.

    For each combination of selections, `samples` points are spread over the bounds and evaluated; of the better half,
    those farthest from any better one are climbed from, since they most likely lead to other maxima. Where there are
    more combinations than `starts`, those with the best samples are climbed in, and from each one goes on to
    neighbours, which differ in one selection, as long as one is better; the status says how many.

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
        runs, interrupted = climbed(problem, points, choices, self.iterations, self.tolerance)
        if problem.combinations > self.starts:  # not every combination was climbed in
            for first in list(runs):
                interrupted = interrupted or self._improve(problem, first, runs)
        return Search(runs, status_of(problem, runs), interrupted)

    def _improve(self, problem: Problem, best: Run, runs: list[Run]) -> bool:
        """Go from a run to better neighbours, adding theirs to the runs; return whether that was interrupted."""
        while not problem.stop:
            near = self._neighbours(problem, best, {run.choices.tobytes() for run in runs})
            starts = np.tile(best.point, (len(near), 1))
            more, interrupted = climbed(problem, starts, near, self.iterations, self.tolerance)
            runs += more
            found = best_of([best, *more])
            if interrupted or found is None or found is best:
                return interrupted
            best = found
        return False

    @staticmethod
    def _neighbours(problem: Problem, best: Run, tried: set[bytes]) -> Choices:
        """Return the most promising combinations (P, s) that differ from a run's in one selection."""
        near = []
        for s, allowed in enumerate(problem.allowed):
            for choice in allowed:
                one = best.choices.copy()
                one[s] = choice
                if one.tobytes() not in tried:
                    near.append(one)
        if not near:
            return np.zeros((0, len(problem.allowed)), dtype=np.int64)
        choices = np.array(near)
        points = np.tile(best.point, (len(near), 1))
        merits, met = problem.merits(points, choices, problem.values(points, choices))
        return choices[np.lexsort((-merits, ~met))[:NEIGHBOURS]]
