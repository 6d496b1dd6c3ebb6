"""Cutting a tree into functions changes how its expression is written, never what it is worth."""

import casadi as ca
import numpy as np
import pytest
from random_tasks import random_problem, to_symgraph

import symgraph as sg
from symgraph import structure


def step(x, a):
    return {"x": 0.95 * x + 0.1 * ca.vertcat(ca.sin(x[1]) + a[0], a[1] - x[0])}


def back(x, a):
    return {"x": x - 0.1 * ca.vertcat(ca.cos(x[1]) + a[0], a[1] - x[0])}


def cost(x):
    return -ca.sumsqr(x)


def up_or_down(x):
    return {"up": 1 / (1 + ca.exp(-x[0])), "down": 1 / (1 + ca.exp(x[0]))}


def loop(model=step):
    graph = sg.Graph({"x": sg.State(2), "a": sg.Action(2, low=-1, high=1)}, start="here")
    graph.edge("here", "here", model)
    graph.reward("here", cost)
    return graph


def branching():
    graph = sg.Graph({"x": sg.State(2), "a": sg.Action(2, low=-1, high=1)}, start="here")
    graph.chance("here", {"up": ("here", step), "down": ("here", back)}, up_or_down)
    graph.reward("here", cost)
    return graph


def everything(graph, options, given, compiled=False):
    objective = sg.Objective(sg.unroll(graph, **options), compiled=compiled)
    gradient = objective.gradient(*given)
    stacked = np.concatenate([np.ravel(gradient[label]) for label in gradient]) if gradient else np.zeros(0)
    return objective.value(*given), stacked, objective.hessian(*given)


@pytest.mark.parametrize("seed", range(40))
def test_functions_of_three_nodes_are_worth_the_same(seed, monkeypatch):
    graph, options, given = to_symgraph(random_problem(seed))
    whole = everything(graph, options, given)
    monkeypatch.setattr(structure, "FUNCTION_NODES", 3)
    monkeypatch.setattr(structure, "SHARED_NODES", 2)
    for cut, uncut in zip(everything(graph, options, given), whole, strict=True):
        np.testing.assert_allclose(cut, uncut, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("make", "visits"), [(loop, 300), (branching, 8)])
def test_large_trees_in_compiled_code_match_the_interpreter_and_differences(make, visits):
    objective = sg.Objective(sg.unroll(make(), max_visits=visits))
    state = {"x": sg.Gaussian([0.3, 0.2], sd=0.1)}
    action = np.array([0.4, -0.2])
    values, gradients = objective.evaluate(state, action[:, None])
    value = objective.value(state, {"a": action})
    np.testing.assert_allclose(values[0], value, rtol=1e-12)
    h = 1e-5
    differences = [
        (objective.value(state, {"a": action + h * e}) - objective.value(state, {"a": action - h * e})) / (2 * h)
        for e in np.eye(2)
    ]
    np.testing.assert_allclose(gradients[:, 0], differences, rtol=1e-6)


def test_a_long_chain_equals_its_closed_form():
    # x' = 0.99 x + a, reward -x at each of the visits: a geometric series.
    graph = sg.Graph({"x": sg.State(), "a": sg.Action(low=-1, high=1)}, start="here")
    graph.edge("here", "here", lambda x, a: {"x": 0.99 * x + a})
    graph.reward("here", lambda x: -x)
    visits = 500
    objective = sg.Objective(sg.unroll(graph, max_visits=visits), compiled=False)
    k = np.arange(visits)
    states = 0.99**k * 2.0 + 0.1 * (1 - 0.99**k) / 0.01
    assert objective.value({"x": 2.0}, {"a": 0.1}) == pytest.approx(-states.sum(), rel=1e-12)
    slope = -((1 - 0.99**k) / 0.01).sum()
    assert objective.gradient({"x": 2.0}, {"a": 0.1})["a"] == pytest.approx(slope, rel=1e-12)


def test_equal_subtrees_share_one_function():
    tree = sg.unroll(branching(), max_visits=9)  # 1023 nodes, but a subtree depends on its depth alone
    found = structure.Structure(tree)
    assert len(set(found.kinds)) == 10  # nine depths and the cut leaves
    apart = {found.kinds[node.index] for node in tree.nodes if found.apart[node.index]}
    assert 1 <= len(apart) < 10


def test_what_a_function_needs_is_what_its_subtree_reads_first():
    slots = {"x": sg.State(), "y": sg.State(), "z": sg.State(), "s": sg.Selection(["one", "two"])}
    graph = sg.Graph(slots, start="fork")
    graph.choose("fork", "s", {"one": ("end", lambda x: {"y": x}), "two": ("end", lambda z: {"y": z})})
    graph.reward("end", lambda y: y)
    tree = sg.unroll(graph)
    one, two = tree.nodes[0].groups[0].branches
    found = structure.Structure(tree)
    assert found.needs(one) == ("x",)
    assert found.needs(two) == ("z",)
    assert found.apart == [False, True, True]
