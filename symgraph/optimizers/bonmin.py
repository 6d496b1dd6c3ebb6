"""BONMIN: branch and bound over selections, through CasADi."""

from __future__ import annotations

import contextlib
import io
import itertools
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from symgraph.objective import Build
from symgraph.optimizers.ipopt import Ipopt
from symgraph.optimizers.problem import Optimizer, Problem, Search
from symgraph.optimizers.settings import number, positive_whole
from symgraph.optimizers.starts import promising_points
from symgraph.slots import Array, Choices

NO_LIMIT = 1e9  # [s]


@dataclass(frozen=True)
class Bonmin(Optimizer):
    """Branch and bound over the selections with IPOPT at its nodes, from one point.

    Selections are integers: one-hot columns whose elements may lie between 0 and 1 until they are branched on; a
    branch's value is weighed with its element. Then the actions are refined by IPOPT under the selections that were
    found. Proves nothing where J is not concave in the actions; and all branches are evaluated, so one that is not
    finite somewhere can end the search, which other optimizers would leave alone.

    Starts at the first guess; without one, at the best of `samples` points that are spread over the bounds and
    combinations of selections.

    Args:
        tolerance: of the optimality conditions, with J divided by its spread over the bounds.
        gap: branches that can gain less than this share of the best value are left out.
        samples: points looked at for a start.

    Source: Bonami et al., An algorithmic framework for convex mixed integer nonlinear programs, Discrete Optimization
        5, 2008.
    """

    tolerance: float = 1e-9
    gap: float = 0.0
    samples: int = 256

    def __post_init__(self) -> None:
        positive_whole("samples", self.samples, "Bonmin")
        number("tolerance", self.tolerance, "Bonmin", 1e-15)
        number("gap", self.gap, "Bonmin", 0.0)

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        refine = Ipopt(tolerance=self.tolerance, samples=self.samples)
        if problem.combinations == 1:
            return refine.run(problem, rng)
        if problem.guesses:
            points, choices = problem.started_from_guesses(rng)
        else:
            groups = min(self.samples, problem.combinations)
            points, choices = promising_points(problem, rng, groups, max(1, self.samples // groups))
        best = int(np.argmax(problem.merits(points, choices, problem.values(points, choices))))
        point, choice = points[best], choices[best]
        problem.progress.wait("planning")
        hot = problem.one_hot(choice[None])[0]
        found, status = self._searched(problem, np.concatenate([point, hot]), problem.scale(choice))
        if status == "SUCCESS":
            point, choice = found[: problem.n], _choices(found[problem.n :], problem.sizes)
        held = tuple((int(one),) for one in choice)
        refined = refine.run(replace(problem, allowed=held, guesses=((point, choice),)), rng)
        for run in refined.runs:
            run.start = points[best]
        how = {"SUCCESS": "branch and bound ended"}.get(status, f"branch and bound failed ({status})")
        return Search(refined.runs, f"{how}; {refined.status}", refined.interrupted)

    def _searched(self, problem: Problem, start: Array, scale: float) -> tuple[Array, str]:
        """Return where branch and bound ended, actions and one-hot selections, and its status."""
        situation = problem.situation
        solver = self._solver(situation.build, problem)
        allowed = np.concatenate([np.isin(range(n), a) for n, a in zip(problem.sizes, problem.allowed, strict=True)])
        low = np.concatenate([problem.low, np.zeros(len(allowed))])
        high = np.concatenate([problem.high, allowed.astype(float)])
        least = [0.0 if one.is_equality else -np.inf for one in situation.build.relaxed.constraints]
        quiet = contextlib.redirect_stdout(io.StringIO())  # some of its messages no option turns off
        try:
            with quiet:
                result = solver(
                    x0=start,
                    lbx=low,
                    ubx=high,
                    lbg=[*least, *np.ones(len(problem.sizes))],
                    ubg=[*np.zeros(len(least)), *np.ones(len(problem.sizes))],
                    p=np.concatenate([*situation.shared, [scale]]),
                )
        except RuntimeError:  # what its branches raise, it does not catch
            return start, "a branch could not be evaluated"
        return np.array(result["x"]).ravel(), str(solver.stats()["return_status"])

    def _solver(self, build: Build, problem: Problem) -> ca.Function:
        """Return BONMIN on −J/scale over actions and one-hot selections, for the other inputs and the scale."""
        limit = NO_LIMIT if problem.stop.seconds is None else problem.stop.seconds
        key = self, limit
        if key not in build.kept:
            expectation = build.relaxed
            actions, selections, *others = expectation.inputs.symbols
            scale = ca.MX.sym("scale")
            ends = np.cumsum([0, *problem.sizes])
            sums = [ca.sum1(selections[a:b]) for a, b in itertools.pairwise(ends)]
            nlp: Any = {
                "x": ca.vertcat(actions, selections),
                "p": ca.veccat(*others, scale),
                "f": -expectation.value / scale,
                "g": ca.vertcat(expectation.margins, *sums),
            }
            kinds = "bb_log_level", "nlp_log_level", "nlp_log_at_root", "milp_log_level", "lp_log_level", "print_level"
            quiet = dict.fromkeys(kinds, 0)
            options: Any = {
                "print_time": False,
                "error_on_fail": False,
                "show_eval_warnings": False,
                "discrete": [False] * actions.numel() + [True] * selections.numel(),
                "bonmin": {
                    **quiet,
                    "sb": "yes",
                    "tol": self.tolerance,
                    "allowable_fraction_gap": self.gap,
                    "time_limit": limit,
                },
            }
            build.kept[key] = ca.nlpsol("bonmin", "bonmin", nlp, options)
        solver: ca.Function = build.kept[key]
        return solver


def _choices(hot: Array, sizes: tuple[int, ...]) -> Choices:
    """Return which element is the largest in each of the one-hot columns."""
    ends = np.cumsum([0, *sizes])
    return np.array([int(np.argmax(hot[a:b])) for a, b in itertools.pairwise(ends)], dtype=np.int64)
