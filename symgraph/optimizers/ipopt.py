"""IPOPT on the exact gradient and Hessian, from one point."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

import numpy as np

from symgraph.compile.kernel import Outcome
from symgraph.optimizers.lbfgs import number, positive_whole, promising_points
from symgraph.optimizers.problem import Choices, Optimizer, Problem, Run, Search
from symgraph.slots import Array

SMALLEST_TOLERANCE = 1e-15  # IPOPT refuses 0
_OUTCOMES: dict[str, Outcome] = {
    "Solve_Succeeded": "converged",
    "Solved_To_Acceptable_Level": "converged",
    "Maximum_Iterations_Exceeded": "iteration limit",
    "Invalid_Number_Detected": "not finite",
}


@dataclass(frozen=True)
class Ipopt(Optimizer):
    """Interior-point search with second derivatives, through CasADi.

    Starts at each guess and keeps its selections; without a guess, at the best of `samples` points that are spread
    over the bounds and all combinations of selections.

    Args:
        iterations: at most.
        tolerance: of the optimality conditions, with J divided by its spread over the bounds.
        samples: points looked at for a start, shared by the combinations of selections.

    Source: Wächter & Biegler 2006.
    """

    iterations: int = 500
    tolerance: float = 1e-9
    samples: int = 256

    def __post_init__(self) -> None:
        positive_whole("iterations", self.iterations, "Ipopt")
        positive_whole("samples", self.samples, "Ipopt")
        number("tolerance", self.tolerance, "Ipopt", SMALLEST_TOLERANCE)

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        if problem.guesses:
            points, choices = problem.started_from_guesses(rng)
        else:
            # One candidate for each combination of selections.
            groups = min(self.samples, problem.combinations)
            points, choices = promising_points(problem, rng, groups, max(1, self.samples // groups))
            best = int(np.argmax(problem.values(points, choices)))
            points, choices = points[best : best + 1], choices[best : best + 1]
        runs: list[Run] = []
        problem.progress.wait("planning")
        try:
            for point, choice in zip(points, choices, strict=True):
                runs.append(self._from(problem, point, choice))
        except KeyboardInterrupt:
            return Search(runs, "", interrupted=True)
        if len(runs) > 1:
            return Search(runs, f"best of {len(runs)} starts")
        ended = runs[0].outcome
        return Search(runs, ended if ended == "converged" else f"not converged: {ended}")

    def _from(self, problem: Problem, point: Array, choice: Choices) -> Run:
        hot = problem.one_hot(choice[None])
        start_value = float(problem.values(point[None], choice[None])[0])
        if not np.isfinite(start_value):
            return Run(point, point, choice, start_value, "not finite", np.array([start_value]))
        if problem.n == 0:
            return Run(point, point, choice, start_value, "converged", np.array([start_value]))
        solver = problem.situation.build.ipopt(self.iterations, self.tolerance)
        parameters = np.concatenate([hot[0], *problem.situation.shared, [problem.scale]])
        with _interrupts() as interrupted:
            found = solver(x0=point, lbx=problem.low, ubx=problem.high, p=parameters)
        if interrupted:
            raise KeyboardInterrupt
        statistics = solver.stats()
        status = str(statistics["return_status"])
        end = np.clip(np.array(found["x"]).ravel(), problem.low, problem.high)
        value = float(problem.values(end[None], choice[None])[0])
        if not value >= start_value:  # not finite half-way, or gone astray: the start is the better plan
            end, value = point, start_value
        objectives = statistics.get("iterations", {}).get("obj", [-start_value / problem.scale])
        history = -problem.scale * np.array(objectives)
        return Run(point, end, choice, value, _OUTCOMES.get(status, "stalled"), history)


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Note Ctrl-C in the list that is yielded: CasADi swallows the exception and reports one of several statuses."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only that one is interrupted
        yield noted
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)
