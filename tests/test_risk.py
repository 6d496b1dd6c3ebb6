"""Risk: the standard deviation of the sum of rewards, and plans that avoid it."""

import math

import casadi as ca
import numpy as np
import pytest
from small_tasks import assert_close, refuses

import symgraph as sg


def gamble():
    """A sure way that pays u, and a lottery that pays 10 with probability p(u); after it a noisy bonus."""
    slots = {"u": sg.Action(low=0, high=1), "way": sg.Selection(["sure", "lottery"]), "y": sg.State()}
    graph = sg.Graph(slots, start="go")
    graph.choose("go", "way", {"sure": ("paid", None), "lottery": ("drawn", None)})
    graph.chance("drawn", {"won": ("rich", None), "lost": ("poor", None)}, lambda u: {"won": u / 2, "lost": 1 - u / 2})
    graph.edge("rich", "bonus", sg.Model(lambda u: {"y": 3 * u}, noise={"y": 0.25}))
    graph.reward("paid", lambda u: u)
    graph.reward("rich", lambda: 10.0)
    graph.reward("bonus", lambda y: 2 * y)
    return graph


def lottery(u):
    """Mean and standard deviation of 10 + 2y, y ~ N(3u, 0.25), with probability u/2, else 0."""
    p, paid = u / 2, 10 + 6 * u
    return p * paid, math.sqrt(p * (4 * 0.25 + (1 - p) ** 2 * paid**2) + (1 - p) * p**2 * paid**2)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("risk", [0.5, -1.0])
def test_value_is_the_mean_less_deviations(compiled, risk):
    objective = sg.Objective(sg.unroll(gamble()), compiled=compiled, risk=risk)
    for u in (0.2, 0.7):
        mean, deviation = lottery(u)
        point = {}, {"u": u}, {"way": "lottery"}
        assert objective.value(*point) == pytest.approx(mean - risk * deviation, rel=1e-12)
        nodes = objective.outcomes(*point)
        assert nodes[0].value == pytest.approx(mean, rel=1e-12)
        assert nodes[0].deviation == pytest.approx(deviation, rel=1e-12)
        step = 1e-6
        ends = [objective.value({}, {"u": u + d}, {"way": "lottery"}) for d in (step, -step)]
        assert objective.gradient(*point)["u"] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)
        values, gradients = objective.evaluate({}, [[u]], {"way": "lottery"})
        assert_close([values[0], gradients[0, 0]], [objective.value(*point), objective.gradient(*point)["u"]])
        assert objective.value({}, {"u": u}, {"way": "sure"}) == pytest.approx(u, abs=1e-90)


def test_those_who_shun_risk_take_the_sure_way():
    ways = {}
    for risk in (0.0, 3.0):
        plan = sg.solve(sg.Objective(sg.unroll(gamble()), risk=risk), {})
        ways[risk] = plan.selections["way"]
        assert plan.value == pytest.approx(plan.nodes[0].value - risk * plan.deviation, abs=1e-9)
        assert plan.to_dict()["deviation"] == plan.deviation
    assert ways == {0.0: "lottery", 3.0: "sure"}


@pytest.mark.parametrize("optimizer", [sg.Ipopt(), sg.Bonmin(), sg.Adadelta(), sg.Enumerate()], ids=repr)
def test_every_optimizer_weighs_it(optimizer):
    """E - 0.5 sd of a quadratic with noise that grows with u, at its stationary point: 1 - u = 0.5 · 0.4 / 2."""
    slots = {"u": sg.Action(low=0.01, high=2), "y": sg.State(), "way": sg.Selection(["a", "b"])}
    graph = sg.Graph(slots | {"s": sg.State()}, start="go")
    graph.choose("go", "way", {"a": ("end", lambda u, s: {"y": u * s}), "b": ("off", None)})
    graph.reward("end", lambda y: y)
    graph.reward("end", lambda u: -((u - 1) ** 2) - u)
    graph.reward("off", lambda: -50.0)
    objective = sg.Objective(sg.unroll(graph), risk=0.5)
    plan = sg.solve(objective, {"s": sg.Gaussian(1.0, sd=0.4)}, optimizer)
    assert plan.actions["u"] == pytest.approx(1 - 0.1, abs=1e-6)
    assert plan.deviation == pytest.approx(0.4 * 0.9, abs=1e-6)


def test_deviation_of_a_tree_against_draws(monkeypatch):
    """Loops, groups side by side and chance; drawn node by node from what each is said to be."""
    graph = sg.Graph({"u": sg.Action(low=-1, high=1), "x": sg.State(), "way": sg.Selection(["a", "b"])}, start="go")
    graph.edge("go", "more", lambda x, u: {"x": 0.5 * x + u})
    graph.chance("more", {"up": ("go", lambda x: {"x": x + 1}), "down": ("end", None)}, {"up": 0.4, "down": 0.6})
    graph.choose("more", "way", {"a": ("end", lambda x: {"x": 2 * x}), "b": ("end", lambda x: {"x": -x})})
    graph.reward("end", lambda x: 3 * x)
    graph.reward("go", lambda x: -x)
    tree = sg.unroll(graph)
    state, actions, selections = {"x": sg.Gaussian(0.5, sd=0.3)}, {"u": 0.2}, {"way": "b"}
    objective = sg.Objective(tree)
    nodes = objective.outcomes(state, actions, selections)
    rng = np.random.default_rng(0)
    count = 200_000

    def drawn(index, rows):
        node, total = tree.nodes[index], np.zeros(rows)
        if node.cut:
            return total
        x = nodes[index].states["x"]
        for group in node.groups:
            if group.group.kind == "reward":
                slope = 3 if node.name == "end" else -1
                total += rng.normal(slope * x.mean, abs(slope) * math.sqrt(np.ravel(x.covariance)[0]), rows)
                continue
            which = rng.random(rows)
            at = 0.0
            for branch in group.branches:
                share = float(branch.branch.label == "b") if group.group.kind == "choose" else branch.share
                chosen = (at <= which) & (which < at + share)
                at += share
                total[chosen] += drawn(branch.child, int(chosen.sum()))
        return total

    totals = drawn(0, count)
    assert nodes[0].value == pytest.approx(totals.mean(), abs=4 * totals.std() / math.sqrt(count))
    assert nodes[0].deviation == pytest.approx(totals.std(), rel=0.01)
    whole = sg.Objective(tree, risk=1.5).value(state, actions, selections)
    assert whole == pytest.approx(nodes[0].value - 1.5 * nodes[0].deviation, rel=1e-12)
    monkeypatch.setattr("symgraph.structure.FUNCTION_NODES", 3)
    monkeypatch.setattr("symgraph.structure.SHARED_NODES", 2)
    assert sg.Objective(tree, risk=1.5).value(state, actions, selections) == pytest.approx(whole, rel=1e-12)


def test_nothing_uncertain_has_no_risk_and_finite_slopes():
    graph = sg.Graph({"u": sg.Action(low=-1, high=1)}, start="go")
    graph.reward("go", lambda u: -ca.cosh(u))
    objective = sg.Objective(sg.unroll(graph), risk=2.0)
    assert objective.value({}, {"u": 0.5}) == pytest.approx(-math.cosh(0.5), rel=1e-12)
    assert objective.gradient({}, {"u": 0.5})["u"] == pytest.approx(-math.sinh(0.5), rel=1e-12)
    assert sg.solve(objective, {}).deviation == 0.0


@pytest.mark.parametrize("risk", [math.nan, math.inf, "much", True, None])
def test_a_risk_that_is_no_number(risk):
    graph = sg.Graph({"u": sg.Action(low=-1, high=1)}, start="go")
    graph.reward("go", lambda u: u)
    refuses(lambda: sg.Objective(sg.unroll(graph), risk=risk), sg.InputError, f"risk = {risk!r}", "finite number")
