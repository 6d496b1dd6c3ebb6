"""Enumerate and Bonmin: selections that are all tried, and selections as integers."""

import casadi as ca
import numpy as np
import pytest
from mixed_integer import MIXED_INTEGER
from small_tasks import fork, objective_of, refuses

import symgraph as sg
from symgraph.constraints import violations

EVERY = pytest.mark.parametrize("known", MIXED_INTEGER, ids=lambda known: known.name)


@EVERY
@pytest.mark.parametrize(
    "optimizer", [sg.Enumerate(), sg.Enumerate(sg.Ipopt()), sg.Bonmin()], ids=["enumerate", "by ipopt", "bonmin"]
)
def test_known_optima(known, optimizer):
    plan = sg.solve(objective_of(known.graph()), {}, optimizer)
    assert -plan.value == pytest.approx(known.value, abs=1e-5)
    assert tuple(plan.selections.values()) == known.selections
    np.testing.assert_allclose(np.ravel(plan.actions["x"]), known.actions, atol=1e-4)
    assert plan.violation <= 1e-6


def test_every_combination_is_tried():
    known = MIXED_INTEGER[-1]
    plan = sg.solve(objective_of(known.graph()), {}, sg.Enumerate(sg.Lbfgs(starts=2)))
    tried = {tuple(run.selections.values()) for run in plan.runs}
    assert len(tried) == 8
    assert plan.status == "enumerated 8 combinations of selections: best of 16 starts"
    held = sg.solve(objective_of(known.graph()), {}, sg.Enumerate(), fixed={"y1": "no"})
    assert {run.selections["y1"] for run in held.runs} == {"no"}


def test_a_guess_is_tried_in_every_combination():
    objective = fork(lambda u: {"y": -((u - 0.5) ** 2)}, lambda u: {"y": 1 - (u + 0.5) ** 2})
    plan = sg.solve(objective, {}, sg.Enumerate(sg.Ipopt()), guess={"u": 0.1, "way": "left"})
    assert [run.start["u"] for run in plan.runs] == [0.1, 0.1]
    assert plan.selections == {"way": "right"}
    assert plan.actions["u"] == pytest.approx(-0.5)


def nested():
    """Both ways lead on to a second choice; what is earned below depends on both, and "a" decides twice."""
    slots = {"u": sg.Action(low=-1, high=1), "a": sg.Selection(["p", "q"]), "b": sg.Selection(["r", "s", "t"])}
    graph = sg.Graph(slots | {"y": sg.State()}, start="one")
    graph.choose("one", "a", {"p": ("two", lambda u: {"y": u}), "q": ("two", lambda u: {"y": 2 * u})})
    graph.choose("two", "b", {c: (f"end {c}", lambda y, k=k: {"y": y - k}) for k, c in enumerate("rst")})
    graph.choose("two", "a", {"p": ("three", None), "q": ("four", None)})
    for k, c in enumerate("rst"):
        graph.reward(f"end {c}", lambda y, k=k: k - (y + 0.5 * k) ** 2)
    graph.reward("four", lambda u: -0.1 * u)
    graph.require("end t", lambda y: y, high=-1.5)
    graph.require("end s", lambda y: y, low=-0.75, high=-0.75)
    return objective_of(graph)


def test_between_its_choices_a_relaxed_objective_is_a_blend_of_them():
    """At a choice it is the objective itself, margins included."""
    objective = nested()
    situation = objective.situation({})
    relaxed = situation.build.relaxed
    at = ca.Function("relaxed", relaxed.inputs.symbols, [relaxed.value, relaxed.margins])
    u = np.array([0.3])
    found = {}
    for a in "pq":
        for b in "rst":
            hot = objective.one_hot({"a": a, "b": b})
            value, margins = (np.array(x).ravel() for x in at(u, hot, *situation.shared))
            found[a, b] = value[0]
            assert value[0] == pytest.approx(objective.value({}, {"u": u}, {"a": a, "b": b}), abs=1e-12)
            missed = violations(margins, relaxed.constraints)
            assert missed.max() == pytest.approx(objective.violation({}, {"u": u}, {"a": a, "b": b}), abs=1e-12)
    blended, _ = at(u, [0.25, 0.75, 0.5, 0.5, 0.0], *situation.shared)
    expected = sum(0.5 * (0.25 * found["p", b] + 0.75 * found["q", b]) for b in "rs")
    assert float(blended) == pytest.approx(expected, abs=1e-12)


def test_bonmin_refines_what_it_found():
    objective = nested()
    plan = sg.solve(objective, {}, sg.Bonmin())
    assert plan.status == "branch and bound ended; converged"
    assert plan.violation <= 1e-8
    best = sg.solve(objective, {}, fixed=plan.selections)
    assert plan.value == pytest.approx(best.value, abs=1e-6)
    assert plan.value <= sg.solve(objective, {}, sg.Enumerate()).value + 1e-6


def test_bonmin_without_a_choice_is_ipopt():
    graph = sg.Graph({"u": sg.Action(low=-1, high=1)}, start="here")
    graph.reward("here", lambda u: -ca.cosh(u - 0.3))
    plan = sg.solve(objective_of(graph), {}, sg.Bonmin())
    assert plan.actions["u"] == pytest.approx(0.3, abs=1e-6)
    assert plan.status == "converged"


def test_bonmin_says_where_it_failed():
    """A branch that is not finite anywhere ends branch and bound; the start is refined all the same."""
    plan = sg.solve(fork(lambda u: {"y": ca.sqrt(u - 5)}, lambda u: {"y": -(u**2)}), {}, sg.Bonmin())
    assert plan.selections == {"way": "right"}
    assert plan.value == pytest.approx(0.0, abs=1e-9)
    assert plan.status.startswith("branch and bound failed (")


def test_bonmin_is_silent(capfd):
    sg.solve(objective_of(MIXED_INTEGER[0].graph()), {}, sg.Bonmin())
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


def test_settings_that_do_not_fit():
    refuses(lambda: sg.Enumerate(sg.Lbfgs), sg.InputError, "Enumerate: optimizer is", "Lbfgs()")
    refuses(lambda: sg.Enumerate(sg.Enumerate()), sg.InputError, "give another one")
    refuses(lambda: sg.Bonmin(samples=0), sg.InputError, "Bonmin: samples = 0")
    slots = {"u": sg.Action(low=0, high=1)} | {f"s{k}": sg.Selection(["a", "b"]) for k in range(17)}
    graph = sg.Graph(slots, start="here")
    graph.reward("here", lambda u: u)
    words = ["131,072 combinations", "fixed=", "Lbfgs()"]
    refuses(lambda: sg.solve(objective_of(graph), {}, sg.Enumerate()), sg.InputError, *words)
