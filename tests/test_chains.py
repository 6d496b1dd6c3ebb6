"""Chains: rounds through the same nodes, folded into one function, against all of them written out."""

import inspect
import itertools

import casadi as ca
import numpy as np
import pytest
from small_tasks import assert_close

import symgraph as sg
from symgraph import structure

NOISE = {"x": 1e-4 * np.eye(2)}
STATE = {"x": [0.5, 0.1], "mass": 0.7, "seen": 0.2}


def swing(x, push, mass):
    return {"x": x + 0.05 * ca.vertcat(x[1], mass * push[0] - ca.sin(x[0]) - push[1] * x[1])}


def lasting(x):
    p = 1 / (1 + ca.exp(-3 - x[0]))
    return {"on": p, "off": 1 - p}


def task(visits, noise=None, lasts=1.0, two=False, aside=False, choice=False):
    """A pendulum that is pushed the same way again and again.

    Args:
        visits: of one node.
        noise: of the swing.
        lasts: probability of going on, a model if None.
        two: a round has two nodes.
        aside: each visit has a side path of two nodes.
        choice: the first visit decides which way all swing.
    """
    slots = {"x": sg.State(2), "mass": sg.State(), "seen": sg.State(), "push": sg.Action(2, low=-1, high=1)}
    graph = sg.Graph(slots | ({"way": sg.Selection(["swing", "fade"])} if choice else {}), start="here")
    onward = "there" if two else "here"
    model = sg.Model(swing, noise=noise)
    if choice:
        graph.choose("here", "way", {"swing": (onward, model), "fade": (onward, lambda x: {"x": 0.9 * x})})
    elif lasts == 1.0:
        graph.edge("here", onward, model)
    else:
        shares = lasting if lasts is None else {"on": lasts, "off": 1 - lasts}
        graph.chance("here", {"on": (onward, model), "off": ("over", lambda x: {"seen": x[0]})}, shares)
        graph.reward("over", lambda seen: -5 * seen**2)
    graph.reward("here", lambda x, push: -(x[0] ** 2) - 0.1 * push[0] ** 2)
    if two:
        graph.edge("there", "here", lambda x, seen: {"seen": seen + 0.1 * x[0], "x": 0.99 * x})
        graph.reward("there", lambda seen: -0.1 * seen**2)
    if aside:
        graph.edge("here", "look", lambda x: {"seen": ca.cos(x[1])})
        graph.edge("look", "judge", lambda seen: {"seen": seen**2})
        graph.reward("judge", lambda seen: seen)
    return sg.unroll(graph, max_visits=visits)


def results(tree, state=STATE, **options):
    """Value and gradient compiled and interpreted, and the Hessian, at three points."""
    objective = sg.Objective(tree, **options)
    selections = {label: slot.choices[0] for label, slot in objective.graph.selections().items()}
    points = np.random.default_rng(0).uniform(*objective.bounds, (3, objective.n_actions))
    values, gradients = objective.evaluate(state, points.T, selections)
    actions = objective.unstack(points[0])
    one = objective.value(state, actions, selections), objective.gradient(state, actions, selections)["push"]
    return values, gradients, *one, objective.hessian(state, actions, selections)


TASKS = {
    "certain": {},
    "noise": {"noise": NOISE},
    "it may end": {"lasts": 0.97},
    "a model says whether": {"lasts": None},
    "two nodes": {"two": True},
    "two nodes, noise, a model": {"two": True, "noise": NOISE, "lasts": None},
    "aside": {"aside": True},
    "all of it": {"aside": True, "two": True, "lasts": 0.9, "noise": NOISE},
    "a choice": {"choice": True},
}


@pytest.mark.parametrize("name", TASKS)
def test_folded_rounds_equal_all_of_them(monkeypatch, name):
    tree = task(43, **TASKS[name])
    assert structure.Structure(tree).chains
    folded = results(tree)
    monkeypatch.setattr(structure, "CHAIN_ROUNDS", 10**9)
    assert not structure.Structure(tree).chains
    for got, expected in zip(folded, results(tree), strict=True):
        assert_close(got, expected, 1e-11)


def test_an_uncertain_start(monkeypatch):
    tree = task(40, noise=NOISE)
    state = {"x": sg.Gaussian([0.5, 0.1], 0.01 * np.eye(2)), "mass": sg.Gaussian(0.7, 0.01)}
    folded = results(tree, state)
    monkeypatch.setattr(structure, "CHAIN_ROUNDS", 10**9)
    for got, expected in zip(folded, results(tree, state), strict=True):
        assert_close(got, expected, 1e-11)


def test_risk_is_no_sum_over_rounds_and_writes_them_out(monkeypatch):
    folded = results(task(40), risk=0.5)
    monkeypatch.setattr(structure, "CHAIN_ROUNDS", 10**9)
    for got, expected in zip(folded, results(task(40), risk=0.5), strict=True):
        assert_close(got, expected, 1e-11)


def test_requirements_at_each_visit_write_them_out():
    tree = task(40)
    tree.graph.require("here", lambda x: x[0], high=2.0)
    assert not structure.Structure(sg.unroll(tree.graph, max_visits=40)).chains


def test_requirements_aside_write_them_out():
    """Their margins belong to each visit."""
    graph = task(40, aside=True).graph
    graph.require("look", lambda seen: seen, high=0.5)
    tree = sg.unroll(graph, max_visits=40)
    assert not structure.Structure(tree).chains
    plan = sg.solve(sg.Objective(tree), STATE, sg.Lbfgs(starts=2, iterations=20))
    assert plan.violation > 0.1  # the cosine is near 1


def test_a_choice_aside_evaluates_what_is_chosen_alone():
    slots = {
        "x": sg.State(),
        "y": sg.State(),
        "push": sg.Action(low=-1, high=1),
        "way": sg.Selection(["plain", "root"]),
    }
    graph = sg.Graph(slots, start="here")
    graph.edge("here", "here", lambda x, push: {"x": 0.9 * x + push})
    graph.edge("here", "fork")
    ways = {"plain": ("end", lambda x: {"y": x}), "root": ("end", lambda x: {"y": ca.sqrt(x - 99)})}
    graph.choose("fork", "way", ways)
    graph.reward("end", lambda y: -(y**2))
    tree = sg.unroll(graph, max_visits=40)
    assert structure.Structure(tree).chains
    objective = sg.Objective(tree)
    values, gradients = objective.evaluate({"x": 0.3}, [[0.2, -0.1]], {"way": "plain"})
    assert np.isfinite(values).all()
    assert np.isfinite(gradients).all()


def test_what_goes_on_growing_uncertain_is_written_out():
    """From round to round one more label is uncertain."""
    labels = [f"x{i}" for i in range(40)]
    slots = {label: sg.State() for label in labels} | {"u": sg.Action(low=-1, high=1)}

    def shift(**x):
        return {label: x[before] for before, label in itertools.pairwise(labels)} | {"x0": x["x0"] * 0.9}

    shift.__signature__ = inspect.Signature([inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY) for n in labels])
    graph = sg.Graph(slots, start="here")
    graph.edge("here", "here", shift)
    graph.reward("here", lambda x39, u: -(x39**2) - u**2)
    objective = sg.Objective(sg.unroll(graph, max_visits=45), compiled=False)
    state = dict.fromkeys(labels, 0.0) | {"x0": sg.Gaussian(1.0, 0.01)}
    assert np.isfinite(objective.value(state, {"u": 0.1}))


def test_the_number_of_functions_grows_with_the_logarithm():
    def functions(visits):
        objective = sg.Objective(task(visits))
        function = objective.situation(STATE).build.expectation.value_function()
        return len(function.find_functions())

    assert functions(4000) - functions(1000) <= 4
    assert functions(1000) < 30
