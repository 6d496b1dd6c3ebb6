"""Multi-start L-BFGS: sample widely, climb from the most promising samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symgraph.optimizers.problem import Optimizer, Problem, Search
from symgraph.optimizers.settings import number, positive_whole
from symgraph.optimizers.starts import climbed, promising_points, status_of


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
        runs, interrupted = climbed(problem, points, choices, self.iterations, self.tolerance)
        return Search(runs, status_of(problem, runs), interrupted)
