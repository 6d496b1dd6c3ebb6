"""Every combination of selections, one after the other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from symgraph.errors import InputError
from symgraph.optimizers.lbfgs import Lbfgs
from symgraph.optimizers.problem import Optimizer, Problem, Run, Search
from symgraph.optimizers.starts import status_of
from symgraph.progress import Progress

MOST_COMBINATIONS = 100_000


@dataclass(frozen=True)
class Enumerate(Optimizer):
    """Run another optimizer for every combination of selections; the best of all results counts.

    No combination is left out, and none gets fewer starts because its samples look bad. The actions of a guess are
    tried in all of them.

    Args:
        optimizer: for each combination.

    Raises:
        InputError: from `solve`, where there are more than 100,000 combinations.
    """

    optimizer: Optimizer = field(default_factory=Lbfgs)

    def __post_init__(self) -> None:
        if not isinstance(self.optimizer, Optimizer) or isinstance(self.optimizer, Enumerate):
            raise InputError(f"Enumerate: optimizer is {self.optimizer!r}; give another one, e.g. Lbfgs()")

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        if problem.combinations > MOST_COMBINATIONS:
            raise InputError(
                f"Enumerate: the selections have {problem.combinations:,} combinations, more than "
                f"{MOST_COMBINATIONS:,}; hold some with fixed=, or take Lbfgs(), which tries the most promising"
            )
        runs: list[Run] = []
        for code in range(problem.combinations):
            if runs and problem.stop:
                break
            (choices,) = problem.decode(np.array([code]))
            allowed = tuple((int(choice),) for choice in choices)
            guesses = tuple((point, choices) for point, _ in problem.guesses)
            one = replace(problem, allowed=allowed, guesses=guesses, progress=Progress("", shown=False))
            search = self.optimizer.run(one, rng)
            runs += search.runs
            if search.interrupted:
                return Search(runs, "", interrupted=True)
            problem.progress.update(code + 1, problem.combinations)
        all_tried = len({run.choices.tobytes() for run in runs}) == problem.combinations
        head = f"enumerated {problem.combinations} combinations of selections: " if all_tried else ""
        return Search(runs, f"{head}{status_of(problem, runs)}")
