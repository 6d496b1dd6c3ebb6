"""The pictures of a search show what the plan holds."""

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import pytest

import symgraph as sg


@pytest.fixture(autouse=True)
def no_windows(monkeypatch):
    plt.switch_backend("agg")
    yield
    plt.close("all")


@pytest.fixture
def himmelblau():
    # Himmelblau 1972: four maxima of equal height 0 in the negated function.
    graph = sg.Graph({"p": sg.Action(2, low=-5, high=5, unit="m"), "s": sg.Selection(["a", "b"])}, start="go")

    def value(p):
        return -((p[0] ** 2 + p[1] - 11) ** 2) - (p[0] + p[1] ** 2 - 7) ** 2

    graph.choose("go", "s", {"a": ("end", None), "b": ("worse", None)})
    graph.reward("end", value)
    graph.reward("worse", lambda p: value(p) - ca.sqrt(p[0]))  # NaN on one half
    objective = sg.Objective(sg.unroll(graph), compiled=False)
    return objective, sg.solve(objective, {}, sg.Lbfgs(starts=6))


def test_runs_are_drawn_once_each_and_end_where_they_ended(himmelblau):
    _, plan = himmelblau
    axes = sg.plot_runs(plan).axes[0]
    curves = [line for line in axes.lines if len(line.get_xdata()) > 1 or line.get_marker() == "None"]
    assert len(curves) == len(plan.runs)
    assert axes.get_xlabel() == "gradients"
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[0] == f"s = {plan.selections['s']}"


def test_curves_of_all_combinations_over_one_action(himmelblau):
    objective, plan = himmelblau
    axes = sg.plot_value(objective, {}, plan, "p[1]").axes[0]
    assert axes.get_xlabel() == "p[1] [m]"
    x, y = axes.lines[0].get_data()
    p = np.array([np.full_like(x, plan.actions["p"][0]), x])
    expected = -((p[0] ** 2 + p[1] - 11) ** 2) - (p[0] + p[1] ** 2 - 7) ** 2
    np.testing.assert_allclose(y, expected, rtol=1e-12)


def test_map_over_two_actions_has_starts_ends_and_plan(himmelblau):
    objective, plan = himmelblau
    axes = sg.plot_value(objective, {}, plan, ["p[0]", "p[1]"], points=20).axes[0]
    by_label = {line.get_label(): line for line in axes.lines}
    star = by_label[f"plan: {plan.value:.4g}"]
    np.testing.assert_allclose(np.ravel(star.get_data()), plan.actions["p"])
    runs = [run for run in plan.runs if run.selections == plan.selections]
    assert len(by_label["ends"].get_xdata()) == len(runs)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ("q", ["'q' is no action", "Actions: 'p'"]),
        ("p", ["2 elements", "'p[0]' to 'p[1]'"]),
        ("p[2]", ["'p[2]'", "2 elements"]),
        ("p[x]", ["'p[x]'"]),
        (["p[0]", "p[1]", "p[0]"], ["one or two actions", "3"]),
    ],
)
def test_refusals_name_what_exists(himmelblau, actions, words):
    objective, plan = himmelblau
    with pytest.raises(sg.InputError) as refused:
        sg.plot_value(objective, {}, plan, actions)
    for word in words:
        assert word in str(refused.value)


def test_without_matplotlib_the_extra_is_named(himmelblau, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.pyplot", None)
    with pytest.raises(sg.MissingExtraError, match=r"symgraph\[plots\]"):
        sg.plot_runs(himmelblau[1])
