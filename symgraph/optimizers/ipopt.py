"""IPOPT on the exact gradient and Hessian, from one point."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

import casadi as ca
import numpy as np

from symgraph.compile.kernel import NEVER, Outcome, Stop
from symgraph.expectation import Expectation
from symgraph.optimizers.problem import Optimizer, Problem, Run, Search, best_of
from symgraph.optimizers.settings import number, positive_whole
from symgraph.optimizers.starts import climbed, most_promising_point
from symgraph.situation import Build
from symgraph.slots import Array, Choices

SMALLEST_TOLERANCE = 1e-15  # IPOPT refuses 0
GAIN = 1e-6  # of the scale of J
SAME_DEPTH = 8  # operations down to which two expressions are compared
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
            points, choices = most_promising_point(problem, rng, self.samples)
        runs: list[Run] = []
        problem.progress.wait("planning")
        with _interrupts() as interrupted:
            for point, choice in zip(points, choices, strict=True):
                if runs and problem.stop:
                    break
                run = self._from(problem, point, choice, interrupted)
                if interrupted:
                    return Search(runs, "", interrupted=True)
                runs.append(run)
        if len(runs) > 1:
            return Search(runs, f"best of {len(runs)} starts")
        ended = runs[0].outcome
        return Search(runs, ended if ended == "converged" else f"not converged: {ended}")

    def _from(self, problem: Problem, point: Array, choice: Choices, interrupted: list[int]) -> Run:
        start_value = float(problem.values(point[None], choice[None])[0])
        ended: Outcome = "converged" if problem.n == 0 else "stalled"
        start = problem.judge(Run(point, point, choice, start_value, ended, np.array([start_value])))
        if problem.n == 0:
            return start
        if not np.isfinite(start_value):
            start.outcome = "not finite"
            return start
        situation, units = problem.cut(choice), np.zeros(0)
        if problem.constrained is not None:
            units = problem.constrained.units(choice)
            units = units[np.isfinite(units)]  # those of the constraints of the cut tree, in the same order
        with situation.build.lock:  # CasADi's solver is one for all threads
            solver = self._solver(situation.build, interrupted, problem.stop)
            if solver.equalities > np.count_nonzero(problem.low < problem.high):
                # More equations than unknowns, which IPOPT refuses; they may hold all the same.
                return climbed(problem, point[None], choice[None], self.iterations, self.tolerance)[0][0]
            scale = problem.scale(choice)
            found = solver.function(
                x0=point,
                lbx=problem.low,
                ubx=problem.high,
                lbg=solver.least,
                ubg=0.0,
                p=np.concatenate([problem.one_hot(choice[None])[0], *situation.shared, units, [scale]]),
            )
            statistics = solver.function.stats()
        outcome = "time limit" if problem.stop else _OUTCOMES.get(str(statistics["return_status"]), "stalled")
        history = -scale * np.array(statistics.get("iterations", {}).get("obj", [-start_value / scale]))
        at = np.clip(np.array(found["x"]).ravel(), problem.low, problem.high)
        end = problem.judge(Run(point, at, choice, float(problem.values(at[None], choice[None])[0]), outcome, history))
        # Not finite half-way, or gone astray: then the start is the better plan. By a little it only seems so, where it
        # misses a requirement by a little.
        gain = start.value - end.value if not end.missed and outcome == "converged" else np.inf
        best = end if gain <= GAIN * scale else best_of([end, start])
        if best is not end:
            start.outcome, start.history = ("time limit" if problem.stop else "stalled"), history
        return best or end

    def _solver(self, build: Build, interrupted: list[int], stop: Stop) -> _Solver:
        """Return IPOPT on −J/scale over the actions, held to the constraints, for the other inputs and the scales."""
        key = Ipopt, self.iterations, self.tolerance
        if key not in build.kept:
            build.kept[key] = _Solver(build, self.iterations, self.tolerance)
        solver: _Solver = build.kept[key]
        solver.watch.interrupted, solver.watch.stop = interrupted, stop
        return solver


class _Solver:
    """IPOPT for a tree, at any state.

    Attributes:
        function: CasADi's solver; its parameters are the inputs but the actions, the constraints' units, the scale.
        watch: what ends it early.
        least: lower bounds of the margins, whose upper ones are 0.
        equalities: how many equations they hold.
    """

    def __init__(self, build: Build, iterations: int, tolerance: float) -> None:
        expectation = build.expectation
        actions, *others = expectation.inputs.symbols
        scale, units = ca.MX.sym("scale"), ca.MX.sym("units", len(expectation.constraints))
        kept = _distinct(expectation)
        self.least = np.array([0.0 if expectation.constraints[k].is_equality else -np.inf for k in kept])
        self.equalities = int(np.count_nonzero(self.least == 0.0))
        parameters = ca.veccat(*others, units, scale)
        self.watch = _Watch(actions.numel(), parameters.numel(), len(kept))
        problem: Any = {
            "x": actions,
            "p": parameters,
            "f": -expectation.value / scale,
            "g": (expectation.margins / units)[kept],
        }
        options: Any = {
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "iteration_callback": self.watch,
            "ipopt": {"print_level": 0, "sb": "yes", "max_iter": iterations, "tol": tolerance},
        }
        self.function = ca.nlpsol("ipopt", "ipopt", problem, options)


def _distinct(expectation: Expectation) -> list[int]:
    """Return the constraints but for those that say the same once more, as at every visit of a loop."""
    parts = ca.vertsplit(expectation.margins) if expectation.constraints else []
    kept: list[int] = []
    for k, one in enumerate(expectation.constraints):
        alike = [other for other in kept if expectation.constraints[other].requirement is one.requirement]
        if not any(ca.is_equal(parts[other], parts[k], SAME_DEPTH) for other in alike):
            kept.append(k)
    return kept


class _Watch(ca.Callback):
    """Is called after each iteration of IPOPT and ends it after Ctrl-C or when time is over."""

    def __init__(self, n_actions: int, n_parameters: int, n_constraints: int) -> None:
        ca.Callback.__init__(self)
        self.interrupted: list[int] = []
        self.stop = NEVER
        self._sizes = {"x": n_actions, "lam_x": n_actions, "f": 1, "lam_p": n_parameters}
        self._sizes |= {"g": n_constraints, "lam_g": n_constraints}
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        size = self._sizes.get(self.get_name_in(i), 0)
        return ca.Sparsity.dense(size, 1) if size else ca.Sparsity(0, 0)

    def eval(self, arguments: Sequence[ca.DM]) -> list[ca.DM]:
        return [ca.DM(len(self.interrupted) + bool(self.stop))]


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Note Ctrl-C in the list that is yielded, since CasADi would swallow a KeyboardInterrupt."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only that one is interrupted
        yield noted
        return

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        if len(noted) > 1:  # the first did not end it
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if before is None else before)
