"""BONMIN: branch and bound over selections, through CasADi."""

from __future__ import annotations

import contextlib
import io
import itertools
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from symgraph.optimizers.ipopt import Ipopt
from symgraph.optimizers.problem import Optimizer, Problem, Search
from symgraph.optimizers.settings import number, positive_whole
from symgraph.optimizers.starts import most_promising_point
from symgraph.situation import Build
from symgraph.slots import Array, Choices

NO_LIMIT = 1e9  # [s]
BAND = 1e-7  # of a constraint's unit, in which an equation holds until actions are refined
WHOLE = 1e-4  # of an element of a one-hot column: so far from 0 or 1 it is neither


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
            points, choices = most_promising_point(problem, rng, self.samples)
        best = problem.most_promising(points, choices)
        point, choice = points[best], choices[best]
        problem.progress.wait("planning")
        hot = problem.one_hot(choice[None])[0]
        units = np.zeros(0) if problem.constrained is None else problem.constrained.typical(choice)
        with problem.situation.build.lock:  # CasADi's solver is one for all threads
            start = np.concatenate([point, hot])
            found, status = self._searched(problem, start, np.concatenate([units, [problem.scale(choice)]]))
        reached = self._reached(problem, found)
        if reached is not None:  # whatever ended it: the best so far may be better than the start
            pair = np.array([point, reached[0]]), np.array([choice, reached[1]])
            if status == "SUCCESS" or problem.most_promising(*pair) == 1:
                point, choice = reached
        held = tuple((int(one),) for one in choice)
        refined = refine.run(replace(problem, allowed=held, guesses=((point, choice),)), rng)
        for run in refined.runs:
            run.start = points[best]
        how = {"SUCCESS": "branch and bound ended", "LIMIT_EXCEEDED": "branch and bound ran out of time"}
        told = how.get(status, f"branch and bound failed ({status})")
        interrupted = refined.interrupted or status == "USER_INTERRUPT"
        return Search(refined.runs, f"{told}; {refined.status}", interrupted)

    @staticmethod
    def _reached(problem: Problem, found: Array) -> tuple[Array, Choices] | None:
        """Return actions and choices of what branch and bound returned, None if selections are not whole numbers."""
        point, hot = np.clip(found[: problem.n], problem.low, problem.high), found[problem.n :]
        if not np.isfinite(found).all() or np.abs(hot - np.round(hot)).max(initial=0.0) > WHOLE:
            return None
        return point, _choices(hot, problem.sizes)

    def _searched(self, problem: Problem, start: Array, scales: Array) -> tuple[Array, str]:
        """Return where branch and bound ended, actions and one-hot selections, and its status."""
        situation = problem.situation
        solver = self._solver(situation.build, problem)
        allowed = np.concatenate([np.isin(range(n), a) for n, a in zip(problem.sizes, problem.allowed, strict=True)])
        low = np.concatenate([problem.low, np.zeros(len(allowed))])
        high = np.concatenate([problem.high, allowed.astype(float)])
        # Equations as narrow bands: with selections held there may be fewer unknowns than equations, and IPOPT refuses.
        bands = [BAND if one.is_equality else np.inf for one in situation.build.relaxed.constraints]
        # Some of its messages no option turns off. What other threads print meanwhile is lost with them.
        quiet = contextlib.redirect_stdout(io.StringIO())
        try:
            with quiet:
                result = solver(
                    x0=start,
                    lbx=low,
                    ubx=high,
                    lbg=[*(-band for band in bands), *np.ones(len(problem.sizes))],
                    ubg=[*(0.0 if np.isinf(band) else band for band in bands), *np.ones(len(problem.sizes))],
                    p=np.concatenate([*situation.shared, scales]),
                )
        except RuntimeError:  # what its branches raise, it does not catch
            return start, "a branch could not be evaluated"
        return np.array(result["x"]).ravel(), str(solver.stats()["return_status"])

    def _solver(self, build: Build, problem: Problem) -> ca.Function:
        """Return BONMIN on −J/scale over actions and one-hot selections, for the other inputs and the scales."""
        limit = NO_LIMIT if problem.stop.seconds is None else problem.stop.seconds
        kept_limit, kept = build.kept.get(self, (None, None))
        if kept_limit != limit:  # an option that it takes when it is built
            expectation = build.relaxed
            actions, selections, *others = expectation.inputs.symbols
            scale, units = ca.MX.sym("scale"), ca.MX.sym("units", len(expectation.constraints))
            ends = np.cumsum([0, *problem.sizes])
            sums = [ca.sum1(selections[a:b]) for a, b in itertools.pairwise(ends)]
            nlp: Any = {
                "x": ca.vertcat(actions, selections),
                "p": ca.veccat(*others, units, scale),
                "f": -expectation.value / scale,
                "g": ca.vertcat(expectation.margins / units, *sums),
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
            kept = ca.nlpsol("bonmin", "bonmin", nlp, options)
            build.kept[self] = limit, kept
        solver: ca.Function = kept
        return solver


def _choices(hot: Array, sizes: tuple[int, ...]) -> Choices:
    """Return which element is the largest in each of the one-hot columns."""
    ends = np.cumsum([0, *sizes])
    return np.array([int(np.argmax(hot[a:b])) for a, b in itertools.pairwise(ends)], dtype=np.int64)
