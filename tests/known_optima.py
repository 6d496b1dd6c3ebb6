"""Test functions of global optimisation with the optima that the literature gives, restated as graphs."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import casadi as ca

import symgraph as sg


@dataclass(frozen=True)
class Known:
    """A function to minimise over low <= u <= high, its least value and where it is taken."""

    name: str
    function: Callable
    low: tuple[float, ...]
    high: tuple[float, ...]
    value: float
    places: tuple[tuple[float, ...], ...]
    source: str

    def graph(self):
        """An edge computes the function, a reward pays its negative."""
        slots = {"u": sg.Action(len(self.low), low=self.low, high=self.high), "cost": sg.State()}
        graph = sg.Graph(slots, start="decide")
        graph.edge("decide", "pay", lambda u: {"cost": self.function(u)})
        graph.reward("pay", lambda cost: -cost)
        return graph


KNOWN = (
    Known(
        "rosenbrock",
        lambda u: 100 * (u[1] - u[0] ** 2) ** 2 + (1 - u[0]) ** 2,
        (-2.048, -2.048),
        (2.048, 2.048),
        0.0,
        ((1.0, 1.0),),
        "Rosenbrock, The Computer Journal 3, 1960",
    ),
    Known(
        "himmelblau",
        lambda u: (u[0] ** 2 + u[1] - 11) ** 2 + (u[0] + u[1] ** 2 - 7) ** 2,
        (-5.0, -5.0),
        (5.0, 5.0),
        0.0,
        ((3.0, 2.0), (-2.805118, 3.131312), (-3.779310, -3.283186), (3.584428, -1.848126)),
        "Himmelblau, Applied Nonlinear Programming, 1972",
    ),
    Known(
        "six-hump camel",
        lambda u: (4 - 2.1 * u[0] ** 2 + u[0] ** 4 / 3) * u[0] ** 2 + u[0] * u[1] + (4 * u[1] ** 2 - 4) * u[1] ** 2,
        (-3.0, -2.0),
        (3.0, 2.0),
        -1.031628453,
        ((0.089842, -0.712656), (-0.089842, 0.712656)),
        "Dixon & Szegö, Towards Global Optimisation 2, 1978",
    ),
    Known(
        "branin",
        lambda u: (
            (u[1] - 5.1 / (4 * pi**2) * u[0] ** 2 + 5 / pi * u[0] - 6) ** 2
            + 10 * (1 - 1 / (8 * pi)) * ca.cos(u[0])
            + 10
        ),
        (-5.0, 0.0),
        (10.0, 15.0),
        0.397887358,
        ((-pi, 12.275), (pi, 2.275), (9.424778, 2.475)),
        "Dixon & Szegö, Towards Global Optimisation 2, 1978",
    ),
    Known(
        "rastrigin",
        lambda u: 20 + ca.sumsqr(u) - 10 * (ca.cos(2 * pi * u[0]) + ca.cos(2 * pi * u[1])),
        (-5.12, -5.12),
        (5.12, 5.12),
        0.0,
        ((0.0, 0.0),),
        "Rastrigin 1974; Törn & Zilinskas, Global Optimization, 1989",
    ),
)
