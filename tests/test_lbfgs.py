"""Multi-start L-BFGS, the default optimizer."""

import casadi as ca
import numpy as np
import pytest
from known_optima import KNOWN
from small_tasks import fork, objective_of, over_box, refuses
from wrapped_kernels import InterruptedLater, Interrupting, wrap_kernels

import symgraph as sg
from symgraph.compile import compiled as compiled_module
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel


@pytest.mark.parametrize("name", ["starts", "samples", "iterations"])
@pytest.mark.parametrize("value", [0, -1, 2.0, "3", True, None], ids=repr)
def test_counts_are_positive_whole_numbers(name, value):
    refuses(lambda: sg.Lbfgs(**{name: value}), sg.InputError, f"Lbfgs: {name} = {value!r}", "positive whole")


@pytest.mark.parametrize("value", [-1e-9, float("nan"), float("inf"), "small", None], ids=repr)
def test_tolerance_is_a_number_of_at_least_0(value):
    refuses(lambda: sg.Lbfgs(tolerance=value), sg.InputError, f"Lbfgs: tolerance = {value!r}", "give")


@pytest.fixture(scope="module", params=KNOWN, ids=lambda known: known.name)
def known(request):
    return request.param, objective_of(request.param.graph(), compiled=True)


@pytest.mark.parametrize("seed", range(5))
def test_global_optimum_of(known, seed):
    """With 128 starts, since Rastrigin's function has 121 minima in its box."""
    function, objective = known
    plan = sg.solve(objective, {}, sg.Lbfgs(starts=128) if function.name == "rastrigin" else None, seed=seed)
    assert -plan.value == pytest.approx(function.value, abs=1e-8)
    assert min(np.abs(plan.actions["u"] - place).max() for place in function.places) < 1e-4


def test_each_combination_of_selections_has_its_starts():
    objective = fork(lambda u: {"y": ca.sin(9 * u)}, lambda u: {"y": ca.cos(9 * u)})
    plan = sg.solve(objective, {}, sg.Lbfgs(starts=10))
    ways = [run.selections["way"] for run in plan.runs]
    assert (ways.count("left"), ways.count("right")) == (5, 5)
    assert plan.status == "best of 10 starts"


def test_each_combination_has_at_least_one_start_up_to_the_number_of_starts():
    slots = {f"s{i}": sg.Selection(["a", "b", "c"]) for i in range(3)}
    graph = sg.Graph({**slots, "u": sg.Action(low=-1, high=1)}, "n")
    for label in slots:
        graph.reward("n", sg.Model(lambda s, u: s[2] - (u - 0.25) ** 2, rename={"s": label}))
    objective = objective_of(graph)
    for starts, runs in ((27, 27), (40, 27), (5, None), (54, 54)):
        plan = sg.solve(objective, {}, sg.Lbfgs(starts=starts))
        combinations = {tuple(run.selections.values()) for run in plan.runs}
        if runs is None:  # fewer than there are combinations: neighbours come on top
            assert starts < len(combinations) == len(plan.runs) <= 27
        else:
            assert (len(plan.runs), len(combinations)) == (runs, 27)
        assert plan.selections == dict.fromkeys(slots, "c")
        assert plan.value == pytest.approx(3)


def test_starts_are_the_promising_samples_and_far_apart():
    """Two equal hills: both are climbed, from starts above the median of the samples."""

    def hills(u):
        return ca.exp(-((u + 0.5) ** 2) / 0.02) + ca.exp(-((u - 0.5) ** 2) / 0.02)

    objective = over_box(hills, -1.0, 1.0)
    for seed in range(10):
        plan = sg.solve(objective, {}, sg.Lbfgs(starts=4, samples=10), seed=seed)
        ends = [run.actions["u"] for run in plan.runs]
        assert min(abs(end + 0.5) for end in ends) < 1e-4
        assert min(abs(end - 0.5) for end in ends) < 1e-4
        assert plan.value == pytest.approx(1, abs=1e-9)


def test_iterations_are_limited():
    objective = objective_of(KNOWN[0].graph(), compiled=True)
    plan = sg.solve(objective, {}, sg.Lbfgs(starts=2, iterations=3))
    assert {run.outcome for run in plan.runs} == {"iteration limit"}
    assert all(run.gradients <= 3 for run in plan.runs)


def test_looser_tolerance_ends_sooner():
    objective = objective_of(KNOWN[0].graph(), compiled=True)
    gradients = [
        sum(run.gradients for run in sg.solve(objective, {}, sg.Lbfgs(tolerance=tolerance)).runs)
        for tolerance in (1.0, 1e-4, 1e-9)
    ]
    assert gradients[0] < gradients[1] < gradients[2]


def test_a_plane_with_its_optimum_in_a_corner():
    low, high = [-1, -2, -3], [4, 5, 6]
    plan = sg.solve(over_box(lambda u: u[0] - 2 * u[1] + 1e-6 * u[2], low, high), {})
    np.testing.assert_allclose(plan.actions["u"], [4, -2, 6], atol=1e-12)


def test_badly_scaled_actions():
    """Ranges from 1e-6 to 1e6: steps are in units of the range."""
    scale = np.array([1e-6, 1.0, 1e6])
    objective = over_box(lambda u: -ca.sumsqr(u / ca.DM(scale) - 0.3) - (u[0] / 1e-6 * u[2] / 1e6), -scale, scale)
    plan = sg.solve(objective, {})
    unit = plan.actions["u"] / scale
    # -(a - .3)^2 - (b - .3)^2 - (c - .3)^2 - a c is stationary at a = c = 0.2
    np.testing.assert_allclose(unit, [0.2, 0.3, 0.2], atol=1e-6)


def test_a_constant_objective_is_converged_at_once():
    plan = sg.solve(over_box(lambda u: 5 + 0 * u, -1.0, 1.0), {})
    assert plan.value == 5
    assert all(run.outcome == "converged" and run.gradients <= 2 for run in plan.runs)


def test_ctrl_c_keeps_the_finished_runs(monkeypatch):
    wrap_kernels(monkeypatch, InterpretedKernel, lambda kernel: Interrupting(kernel, "climb", 4))
    plan = sg.solve(over_box(lambda u: -((u - 0.3) ** 2), 0.0, 1.0), {}, sg.Lbfgs(starts=16))
    assert len(plan.runs) == 3
    assert plan.status == "interrupted: best of 3 runs"
    assert plan.actions["u"] == pytest.approx(0.3, abs=1e-6)


def test_ctrl_c_before_anything_is_finished_is_ctrl_c(monkeypatch):
    wrap_kernels(monkeypatch, InterpretedKernel, lambda kernel: Interrupting(kernel, "climb", 1))
    with pytest.raises(KeyboardInterrupt):
        sg.solve(over_box(lambda u: -(u**2), 0.0, 1.0), {})


@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_in_compiled_code_keeps_the_finished_runs(monkeypatch, threads):
    wrap_kernels(monkeypatch, CompiledKernel, lambda kernel: InterruptedLater(kernel, "climb", 0.3))
    objective = over_box(lambda u: ca.sumsqr(ca.sin(ca.DM(range(500)) * u)), -1.0, 1.0, compiled=True)
    plan = sg.solve(objective, {}, sg.Lbfgs(starts=60_000, samples=1, tolerance=0.0), threads=threads)
    assert 1 <= len(plan.runs) < 60_000
    assert plan.status == f"interrupted: best of {len(plan.runs)} runs"
    assert plan.value == pytest.approx(max(run.value for run in plan.runs), rel=1e-12)  # the first of equals


def test_threads_and_slices_of_time_change_nothing(monkeypatch):
    """Points, values, histories and the order of runs."""
    objective = fork(lambda u: {"y": ca.sin(9 * u)}, lambda u: {"y": ca.cos(9 * u)}, compiled=True)
    plans = []
    for seconds, threads in ((1e-7, 1), (10.0, 1), (1e-7, 2), (10.0, 2)):
        monkeypatch.setattr(compiled_module, "SLICE", seconds)
        plan = sg.solve(objective, {}, sg.Lbfgs(starts=150), seed=2, threads=threads)
        plans.append(plan.to_dict() | {"seconds": 0})
    assert all(plan == plans[0] for plan in plans)


def test_more_combinations_than_starts_are_improved_by_neighbours():
    """Twelve switches of which each must be on: samples of sixteen combinations show only some."""
    slots = {"u": sg.Action(low=-1, high=1)} | {f"s{k}": sg.Selection(["off", "on"]) for k in range(12)}
    graph = sg.Graph(slots, start="here")
    for k in range(12):
        graph.reward("here", sg.Model(lambda s, u: s[1] - (u - 0.5) ** 2, rename={"s": f"s{k}"}))
    plan = sg.solve(objective_of(graph), {}, sg.Lbfgs(starts=4))
    assert set(plan.selections.values()) == {"on"}
    assert plan.value == pytest.approx(12.0)
    assert "of 4096 combinations of selections" in plan.status
    held = sg.solve(objective_of(graph), {}, sg.Lbfgs(starts=4), fixed={"s3": "off"})
    assert held.value == pytest.approx(11.0)
