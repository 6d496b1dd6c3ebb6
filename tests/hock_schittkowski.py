"""Constrained test problems with known optima, restated as graphs: an edge computes, a node requires, a reward pays.

Source: Hock & Schittkowski, Test Examples for Nonlinear Programming Codes, Lecture Notes in Economics and Mathematical
Systems 187, Springer 1981; the numbers are theirs. Where they give no bounds, wide ones stand here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt

import casadi as ca

import symgraph as sg


@dataclass(frozen=True)
class Constrained:
    """Minimise a function over a box where low <= g(u) <= high."""

    number: int
    function: Callable
    g: Callable
    low: tuple[float, ...]
    high: tuple[float, ...]
    box: tuple[tuple[float, ...], tuple[float, ...]]
    value: float
    starts: tuple[tuple[float, ...], ...]  # theirs first

    def graph(self):
        low, high = self.box
        slots = {"u": sg.Action(len(low), low=low, high=high), "cost": sg.State(), "g": sg.State(len(self.low))}
        graph = sg.Graph(slots, start="decide")
        graph.edge("decide", "pay", lambda u: {"cost": self.function(u), "g": self.g(u)})
        graph.require("pay", lambda g: g, low=self.low, high=self.high)
        graph.reward("pay", lambda cost: -cost)
        return graph


def ten(n):
    return (-10.0,) * n, (10.0,) * n


HOCK_SCHITTKOWSKI = (
    Constrained(
        6,
        lambda u: (1 - u[0]) ** 2,
        lambda u: 10 * (u[1] - u[0] ** 2),
        (0,),
        (0,),
        ten(2),
        0.0,
        ((-1.2, 1.0), (3.0, -2.0), (0.0, 5.0)),
    ),
    Constrained(
        7,
        lambda u: ca.log(1 + u[0] ** 2) - u[1],
        lambda u: (1 + u[0] ** 2) ** 2 + u[1] ** 2,
        (4,),
        (4,),
        ten(2),
        -sqrt(3),
        ((2.0, 2.0), (0.5, 1.0), (1.0, 3.0)),
    ),
    Constrained(
        10,
        lambda u: u[0] - u[1],
        lambda u: -3 * u[0] ** 2 + 2 * u[0] * u[1] - u[1] ** 2 + 1,
        (0,),
        (inf,),
        ten(2),
        -1.0,
        ((-10.0, 10.0), (0.0, 0.0), (5.0, -5.0)),
    ),
    Constrained(
        14,
        lambda u: (u[0] - 2) ** 2 + (u[1] - 1) ** 2,
        lambda u: ca.vertcat(-(u[0] ** 2) / 4 - u[1] ** 2 + 1, u[0] - 2 * u[1] + 1),
        (0, 0),
        (inf, 0),
        ten(2),
        9 - 2.875 * sqrt(7),
        ((2.0, 2.0), (-1.0, 0.0), (0.0, -3.0)),
    ),
    Constrained(
        26,
        lambda u: (u[0] - u[1]) ** 2 + (u[1] - u[2]) ** 4,
        lambda u: (1 + u[1] ** 2) * u[0] + u[2] ** 4 - 3,
        (0,),
        (0,),
        ten(3),
        0.0,
        ((-2.6, 2.0, 2.0), (1.5, 0.5, 1.2), (0.5, 1.0, 1.0)),
    ),
    Constrained(
        39,
        lambda u: -u[0],
        lambda u: ca.vertcat(u[1] - u[0] ** 3 - u[2] ** 2, u[0] ** 2 - u[1] - u[3] ** 2),
        (0, 0),
        (0, 0),
        ten(4),
        -1.0,
        ((2.0, 2.0, 2.0, 2.0), (0.5, 0.5, 0.5, 0.5), (1.5, 2.0, 0.1, 0.1)),
    ),
    Constrained(
        43,
        lambda u: u[0] ** 2 + u[1] ** 2 + 2 * u[2] ** 2 + u[3] ** 2 - 5 * u[0] - 5 * u[1] - 21 * u[2] + 7 * u[3],
        lambda u: ca.vertcat(
            8 - ca.sumsqr(u) - u[0] + u[1] - u[2] + u[3],
            10 - u[0] ** 2 - 2 * u[1] ** 2 - u[2] ** 2 - 2 * u[3] ** 2 + u[0] + u[3],
            5 - 2 * u[0] ** 2 - u[1] ** 2 - u[2] ** 2 - 2 * u[0] + u[1] + u[3],
        ),
        (0, 0, 0),
        (inf, inf, inf),
        ten(4),
        -44.0,
        ((0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0), (-2.0, 0.0, 2.0, 0.0)),
    ),
    Constrained(
        71,
        lambda u: u[0] * u[3] * (u[0] + u[1] + u[2]) + u[2],
        lambda u: ca.vertcat(u[0] * u[1] * u[2] * u[3], ca.sumsqr(u)),
        (25, 40),
        (inf, 40),
        ((1.0,) * 4, (5.0,) * 4),
        17.0140173,
        ((1.0, 5.0, 5.0, 1.0), (2.0, 2.0, 2.0, 2.0), (1.0, 4.0, 4.0, 2.0)),
    ),
)
