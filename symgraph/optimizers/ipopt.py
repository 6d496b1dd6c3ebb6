"""IPOPT on the exact gradient and Hessian, from one point."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from symgraph.optimizers.lbfgs import positive_whole, promising_points
from symgraph.optimizers.problem import Optimizer, Outcome, Problem, Run, Search


@dataclass(frozen=True)
class Ipopt(Optimizer):
    """Interior-point search with second derivatives, through CasADi.

    Starts at each guess and keeps its selections; without a guess, at the best of `samples` points that are spread
    over the bounds and all combinations of selections.

    Args:
        iterations: at most.
        tolerance: of the optimality conditions.
        samples: points looked at for a start, shared by the combinations of selections.

    Source: Wächter & Biegler 2006.
    """

    iterations: int = 500
    tolerance: float = 1e-9
    samples: int = 256

    def __post_init__(self) -> None:
        positive_whole("iterations", self.iterations, "Ipopt")
        positive_whole("samples", self.samples, "Ipopt")

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        if problem.guesses:
            points, choices = problem.started_from_guesses(rng)
        else:
            samples = max(1, self.samples // problem.combinations)
            points, choices = promising_points(problem, rng, self.samples, samples)
            values, _ = problem.evaluate(points, choices)
            best = int(np.argmax(values))
            points, choices = points[best : best + 1], choices[best : best + 1]
        runs: list[Run] = []
        try:
            for point, choice in zip(points, choices, strict=True):
                runs.append(self._from(problem, point, choice))
        except KeyboardInterrupt:
            return Search(runs, "", interrupted=True)
        status = runs[0].outcome if len(runs) == 1 else f"best of {len(runs)} starts"
        return Search(runs, status)

    def _from(self, problem: Problem, point: np.ndarray, choice: np.ndarray) -> Run:
        evaluate = problem.evaluate
        start_value, _ = evaluate(point[None], choice[None])
        if problem.n == 0 or not np.isfinite(start_value[0]):
            outcome: Outcome = "converged" if np.isfinite(start_value[0]) else "not finite"
            return Run(point, point, choice, float(start_value[0]), outcome, 1, [float(start_value[0])])
        solver = problem.situation.build.ipopt(self.iterations, self.tolerance)
        low, high = evaluate.template.copy(), evaluate.template.copy()
        low[evaluate.free], high[evaluate.free] = problem.low, problem.high
        start = evaluate.complete(point[None])[0]
        parameters = np.concatenate([evaluate.one_hot(choice[None])[0], *map(np.ravel, evaluate.shared)])
        found = solver(x0=start, lbx=low, ubx=high, p=ca.DM(parameters))
        statistics = solver.stats()
        end = np.clip(np.array(found["x"]).ravel()[evaluate.free], problem.low, problem.high)
        value, _ = evaluate(end[None], choice[None])
        history = [-float(f) for f in statistics.get("iterations", {}).get("obj", [])]
        iterations = int(statistics["iter_count"])
        status = str(statistics["return_status"])
        if status == "User_Requested_Stop":
            raise KeyboardInterrupt
        if not value[0] >= start_value[0]:  # NaN half-way, or it went astray: the start is the better plan
            end, value = point, start_value
        outcomes: dict[str, Outcome] = {
            "Solve_Succeeded": "converged",
            "Solved_To_Acceptable_Level": "converged",
            "Maximum_Iterations_Exceeded": "iteration limit",
            "Invalid_Number_Detected": "not finite",
        }
        return Run(point, end, choice, float(value[0]), outcomes.get(status, "stalled"), iterations, history)
