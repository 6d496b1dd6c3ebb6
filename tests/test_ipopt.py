"""IPOPT from one point."""

import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from known_optima import KNOWN
from small_tasks import fork, objective_of, over_box, refuses

import symgraph as sg


@pytest.mark.parametrize("name", ["iterations", "samples"])
@pytest.mark.parametrize("value", [0, -1, 2.0, "3", True, None], ids=repr)
def test_counts_are_positive_whole_numbers(name, value):
    refuses(lambda: sg.Ipopt(**{name: value}), sg.InputError, f"Ipopt: {name} = {value!r}", "positive whole")


@pytest.mark.parametrize("value", [0.0, -1e-9, float("nan"), float("inf"), "small", None], ids=repr)
def test_tolerance_is_a_positive_number(value):
    refuses(lambda: sg.Ipopt(tolerance=value), sg.InputError, f"Ipopt: tolerance = {value!r}", "give")


@pytest.mark.parametrize("known", KNOWN, ids=lambda known: known.name)
def test_local_optimum_of(known):
    """From near each known place, IPOPT and Adadelta alone come back to it."""
    objective = objective_of(known.graph())
    for place in known.places:
        start = {"u": np.array(place) + 0.02}
        plan = sg.solve(objective, {}, sg.Ipopt(), guess=start)
        np.testing.assert_allclose(plan.actions["u"], place, atol=1e-5)
        assert -plan.value == pytest.approx(known.value, abs=1e-8)
        assert plan.status == "converged"
        one = sg.Adadelta(starts=1, polish=False, epsilon=1e-8, run_iterations=5000, oscillation=10**6, tolerance=0.0)
        run = sg.solve(objective, {}, one, guess=start).runs[0]
        assert -run.value == pytest.approx(known.value, abs=1e-3)  # Rosenbrock's valley is nearly flat
        np.testing.assert_allclose(run.actions["u"], place, atol=0.05)


def test_it_starts_at_the_guess_and_keeps_its_selections():
    objective = fork(lambda u: {"y": -((u - 0.2) ** 2)}, lambda u: {"y": 9 - (u + 0.4) ** 2})
    plan = sg.solve(objective, {}, sg.Ipopt(), guess={"u": 0.9, "way": "left"})
    (run,) = plan.runs
    assert (run.start, plan.selections) == ({"u": 0.9}, {"way": "left"})
    assert plan.actions["u"] == pytest.approx(0.2, abs=1e-7)


def test_from_a_plan_it_does_not_get_worse():
    known = KNOWN[2]
    objective = objective_of(known.graph())
    plan = sg.solve(objective, {})
    polished = sg.solve(objective, {}, sg.Ipopt(), guess=plan)
    assert len(polished.runs) == 1
    assert polished.value >= plan.value - 1e-12


def test_several_guesses():
    known = KNOWN[1]
    objective = objective_of(known.graph())
    plan = sg.solve(objective, {}, sg.Ipopt(), guess=[{"u": np.array(place) + 0.1} for place in known.places])
    assert plan.status == "best of 4 starts"
    for run, place in zip(plan.runs, known.places, strict=True):
        np.testing.assert_allclose(run.actions["u"], place, atol=1e-5)


def test_without_a_guess_it_starts_at_the_best_sample_of_all_combinations():
    objective = fork(lambda u: {"y": ca.sin(9 * u)}, lambda u: {"y": 3 * ca.cos(9 * u)})
    plan = sg.solve(objective, {}, sg.Ipopt())
    assert plan.selections == {"way": "right"}
    assert plan.value == pytest.approx(3)


def test_bounds_are_kept_and_reached():
    plan = sg.solve(over_box(lambda u: u[0] - u[1], [-1, -2], [3, 4]), {}, sg.Ipopt())
    np.testing.assert_allclose(plan.actions["u"], [3, -2], atol=1e-7)
    assert plan.actions["u"][0] <= 3
    assert plan.actions["u"][1] >= -2


def test_iterations_are_limited():
    objective = objective_of(KNOWN[0].graph())
    plan = sg.solve(objective, {}, sg.Ipopt(iterations=2), guess={"u": [-1.2, 1.0]})
    assert plan.runs[0].outcome == "iteration limit"


def test_it_prints_nothing(capfd):
    sg.solve(over_box(lambda u: -ca.sqrt(u - 0.1), 0.0, 1.0), {}, sg.Ipopt(), guess={"u": 0.5})
    sg.solve(over_box(lambda u: -(u**2), -1.0, 1.0), {}, sg.Ipopt())
    assert capfd.readouterr() == ("", "")


def test_nan_half_way_keeps_what_was_finite():
    objective = over_box(lambda u: -ca.sqrt(u - 0.1), 0.0, 1.0)
    plan = sg.solve(objective, {}, sg.Ipopt(), guess={"u": 0.5})
    assert plan.value >= objective.value({}, {"u": 0.5})
    assert plan.value == objective.value({}, plan.actions)


def test_a_guess_that_is_not_finite_beside_one_that_is():
    objective = over_box(lambda u: -((ca.sqrt(u) - 0.5) ** 2), -1.0, 1.0)
    plan = sg.solve(objective, {}, sg.Ipopt(), guess=[{"u": -0.5}, {"u": 0.6}])
    assert [run.outcome for run in plan.runs] == ["not finite", "converged"]
    assert plan.runs[0].value == -np.inf
    assert plan.actions["u"] == pytest.approx(0.25, abs=1e-6)


def test_held_actions_stay():
    objective = over_box(lambda u: -ca.sumsqr(u - 3), [-5, -5], [5, 5])
    plan = sg.solve(objective, {}, sg.Ipopt(), fixed={"u": [1.0, 2.0]})
    np.testing.assert_array_equal(plan.actions["u"], [1.0, 2.0])
    assert plan.status == "converged"


def test_uncertain_states_and_changed_states_reuse_the_solver():
    objective = over_box(lambda u, x: -((u - x) ** 2), -5.0, 5.0, states={"x": sg.State()})
    for x in (1.0, -2.0, sg.Gaussian(0.5, 0.3)):
        mean = x.mean if isinstance(x, sg.Gaussian) else x
        assert sg.solve(objective, {"x": x}, sg.Ipopt()).actions["u"] == pytest.approx(mean, abs=1e-6)


SCRIPT = """
import os, signal, sys, threading
sys.path[:0] = [{root!r}, {root!r} + "/tests"]
import casadi as ca
import symgraph as sg
from small_tasks import objective_of

graph = sg.Graph({{"x": sg.State(10), "u": sg.Action(10, low=-1, high=1)}}, "n")
graph.edge("n", "n", lambda x, u: {{"x": ca.cos(x) + u * ca.sin(x)}})
graph.reward("n", lambda x: ca.sin(5 * ca.sum1(x)) - ca.sum1(ca.fabs(x - 0.7)))
objective = objective_of(graph, max_visits=20)
guesses = [{{"u": [0.003 * i] * 10}} for i in range(300)]
arguments = objective, {{"x": [0.3] * 10}}, sg.Ipopt()
sg.solve(*arguments, guess=guesses[0])  # builds the solver
threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
print(sg.solve(*arguments, guess=guesses).status)
"""


def test_a_real_ctrl_c():
    """Three hundred starts take many seconds; the signal comes after half a one, most likely inside IPOPT."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(root=str(Path(__file__).parents[1]))],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.startswith("interrupted: best of "), done.stdout + done.stderr
    assert done.stderr == ""
