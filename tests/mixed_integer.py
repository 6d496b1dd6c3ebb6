"""Small mixed-integer problems with known optima, restated as graphs: what is 0 or 1 there is a selection here."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

import symgraph as sg

BINARY = ("no", "yes")


@dataclass(frozen=True)
class MixedInteger:
    """A graph with its best value, actions and selections."""

    name: str
    graph: Callable
    value: float  # of the cost, which the reward is the negative of
    actions: tuple[float, ...]
    selections: tuple[str, ...]
    source: str


def one_choice():
    """Minimise 2x + y with 1.25 - x² - y ≤ 0 and x + y ≤ 1.6."""
    slots = {"x": sg.Action(low=0, high=1.6), "y": sg.Selection(BINARY)}
    graph = sg.Graph(slots, start="decide")
    graph.choose("decide", "y", {"no": ("without", None), "yes": ("with", None)})
    for node, y in (("without", 0), ("with", 1)):
        graph.require(node, lambda x, y=y: ca.vertcat(1.25 - x**2 - y, x + y), high=[0, 1.6])
        graph.reward(node, lambda x, y=y: -(2 * x + y))
    return graph


def two_numbers():
    """Minimise -0.7y + 5 (x₁ - 0.5)² + 0.8 with -exp(x₁ - 0.2) - x₂ ≤ 0, x₂ + 1.1y ≤ -1 and x₁ - 1.2y ≤ 0.2."""
    slots = {"x": sg.Action(2, low=(0.2, -2.22554), high=(1.0, -1.0)), "y": sg.Selection(BINARY)}
    graph = sg.Graph(slots | {"spread": sg.State()}, start="decide")
    graph.edge("decide", "bought", lambda x: {"spread": ca.exp(x[0] - 0.2)})
    graph.require("bought", lambda spread, x: spread + x[1], low=0)
    graph.require("bought", lambda x, y: ca.vertcat(x[1] + 1.1 * y[1], x[0] - 1.2 * y[1]), high=[-1, 0.2])
    graph.reward("bought", lambda x, y: 0.7 * y[1] - 5 * (x[0] - 0.5) ** 2 - 0.8)
    return graph


def synthesis():
    """Which of three processes to build, and how much flows through them."""
    slots = {"x": sg.Action(3, low=0, high=(2, 2, 1)), "y1": sg.Selection(BINARY), "y2": sg.Selection(BINARY)}
    slots |= {"y3": sg.Selection(BINARY), "first": sg.State(), "second": sg.State()}
    graph = sg.Graph(slots, start="plan")
    graph.edge("plan", "run", lambda x: {"first": ca.log(x[1] + 1), "second": ca.log(x[0] - x[1] + 1)})
    graph.require("run", lambda first, second, x: 0.8 * first + 0.96 * second - 0.8 * x[2], low=0)
    graph.require("run", lambda first, second, x, y3: first + 1.2 * second - x[2] - 2 * y3[1], low=-2)
    graph.require("plan", lambda x, y1, y2: ca.vertcat(x[1] - x[0], x[1] - 2 * y1[1], x[0] - x[1] - 2 * y2[1]), high=0)
    graph.require("plan", lambda y1, y2: y1[1] + y2[1], high=1)
    graph.reward("plan", lambda y1, y2, y3: -(5 * y1[1] + 6 * y2[1] + 8 * y3[1]))
    graph.reward("run", lambda first, second, x: 18 * first + 19.2 * second - 10 * x[0] + 7 * x[2] - 10)
    return graph


def three_choices():
    """Minimise 2x₁ + 3x₂ + 1.5y₁ + 2y₂ - 0.5y₃ with two equations and three inequalities."""
    slots = {"x": sg.Action(2, low=0, high=(1.6, 2.3)), "y1": sg.Selection(BINARY), "y2": sg.Selection(BINARY)}
    slots |= {"y3": sg.Selection(BINARY)}
    graph = sg.Graph(slots, start="here")
    graph.require("here", lambda x, y1: x[0] ** 2 + y1[1], low=1.25, high=1.25)
    graph.require("here", lambda x, y2: (x[1] + 1e-12) ** 1.5 + 1.5 * y2[1], low=3, high=3)
    graph.require("here", lambda x, y1, y2: ca.vertcat(x[0] + y1[1], 1.333 * x[1] + y2[1]), high=[1.6, 3])
    graph.require("here", lambda y1, y2, y3: y3[1] - y1[1] - y2[1], high=0)
    graph.reward("here", lambda x, y1, y2, y3: -(2 * x[0] + 3 * x[1] + 1.5 * y1[1] + 2 * y2[1] - 0.5 * y3[1]))
    return graph


MIXED_INTEGER = (
    MixedInteger(
        "one choice", one_choice, 2.0, (0.5,), ("yes",), "Kocis & Grossmann, Ind. Eng. Chem. Res. 27, 1988, problem 1"
    ),
    MixedInteger(
        "two numbers",
        two_numbers,
        1.076543,
        (0.941937, -2.1),
        ("yes",),
        "Floudas, Nonlinear and Mixed-Integer Optimization, 1995, example 6.6.5",
    ),
    MixedInteger(
        "synthesis",
        synthesis,
        6.009759,
        (1.300976, 0.0, 1.0),
        ("no", "yes", "no"),
        "Duran & Grossmann, Mathematical Programming 36, 1986, test problem 1",
    ),
    MixedInteger(
        "three choices",
        three_choices,
        7.667180,
        (1.118034, 1.310371),
        ("no", "yes", "yes"),
        "Kocis & Grossmann, Computers & Chemical Engineering 13, 1989",
    ),
)
