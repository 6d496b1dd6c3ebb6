"""What a plan leads to, node by node."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest
from random_tasks import random_problem, to_symgraph
from small_tasks import assert_close, fork, objective_of

import symgraph as sg


def chain():
    """x doubles, then a hit is paid and a miss tries again; y is written on the way."""
    slots = {"x": sg.State(unit="m"), "y": sg.State(2), "extra": sg.State(), "u": sg.Action(low=0, high=1)}
    g = sg.Graph(slots, "aim")
    g.edge("aim", "shot", lambda x, u: {"x": 2 * x, "y": ca.vertcat(u, x)})
    g.reward("aim", lambda x: x)
    g.chance("shot", {"hit": ("won", None), "miss": ("aim", None)}, {"hit": 0.75, "miss": 0.25})
    g.reward("won", lambda y: 10 * y[1])
    return objective_of(g, max_visits=2, cut_value=-5.0)


STATE = {"x": sg.Gaussian(1.0, 0.04), "extra": 7.0}


@pytest.fixture(scope="module")
def nodes():
    return chain().outcomes(STATE, {"u": 0.5})


def test_nodes_stand_in_tree_order(nodes):
    assert [(n.path, n.node, n.cut) for n in nodes] == [
        ("aim", "aim", False),
        ("aim/shot", "shot", False),
        ("aim/shot/won[hit]", "won", False),
        ("aim/shot/aim[miss]", "aim", False),
        ("aim/shot/aim[miss]/shot", "shot", False),
        ("aim/shot/aim[miss]/shot/won[hit]", "won", False),
        ("aim/shot/aim[miss]/shot/aim[miss]", "aim", True),
    ]


def test_probabilities_multiply_along_the_path(nodes):
    assert [n.probability for n in nodes] == [1, 1, 0.75, 0.25, 0.25, 0.1875, 0.0625]


def test_states_are_those_known_at_the_node(nodes):
    assert list(nodes[0].states) == ["x", "extra"]
    assert list(nodes[1].states) == ["x", "y", "extra"]
    assert nodes[0].states["x"] == STATE["x"]
    assert nodes[1].states["x"] == sg.Gaussian(2.0, 0.16)
    assert_close(nodes[1].states["y"].mean, [0.5, 1.0])
    assert_close(nodes[1].states["y"].covariance, np.diag([0, 0.04]))
    assert nodes[5].states["x"].mean == 4.0
    assert all(n.states["extra"] == sg.Gaussian(7.0) for n in nodes)


def test_rewards_and_values(nodes):
    assert [n.reward for n in nodes] == [1, 0, 10, 2, 0, 20, 0]
    later = 0.75 * 20 + 0.25 * -5
    first = 0.75 * 10 + 0.25 * (2 + later)
    assert [n.value for n in nodes] == pytest.approx([1 + first, first, 10, 2 + later, later, 20, -5])


def test_a_path_that_can_be_cut_is_noted(nodes):
    (note,) = nodes.notes()
    for words in ("more than 2 times", "probability 0.0625", "-5", "max_visits", "cut_value"):
        assert words in note


def test_it_is_a_sequence(nodes):
    assert len(nodes) == 7
    assert nodes[-1].cut
    assert nodes[-1].path == nodes[6].path
    assert [n.path for n in nodes[1:3]] == ["aim/shot", "aim/shot/won[hit]"]
    assert len(list(nodes)) == 7
    assert "7 nodes" in repr(nodes)
    with pytest.raises(IndexError):
        nodes[7]


def test_numbers_are_plain_numbers(nodes):
    for node in nodes:
        assert all(type(x) is float for x in (node.probability, node.reward, node.value))
        assert type(node.states["x"].mean) is float


@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_value_is_the_sum_of_what_is_paid_times_its_probability(seed):
    """J = sum over nodes of P(node) (rewards there, or the cut's worth)."""
    graph, options, arguments = to_symgraph(random_problem(seed))
    objective = objective_of(graph, **options)
    nodes = objective.outcomes(*arguments)
    value = objective.value(*arguments)
    cut_value = objective.tree.cut_value
    paid = [n.probability * (cut_value if n.cut else n.reward) for n in nodes if n.probability]
    scale = 1 + sum(abs(p) for p in paid)
    assert abs(sum(paid) - value) <= 1e-11 * scale
    assert abs(nodes[0].value - value) <= 1e-11 * scale
    assert nodes[0].probability == 1.0


def test_what_is_not_selected_has_probability_zero_and_may_be_nan():
    objective = fork(lambda u: {"y": u + 1}, lambda u: {"y": ca.sqrt(u - 9)})
    nodes = objective.outcomes({}, {"u": 0.5}, {"way": "left"})
    assert [n.probability for n in nodes] == [1.0, 1.0, 0.0]
    assert nodes[0].value == nodes[1].value == 1.5
    assert np.isnan(nodes[2].states["y"].mean)
    assert np.isnan(nodes[2].reward)
    assert nodes.notes() == []


@pytest.mark.parametrize(
    "how", [copy.deepcopy, lambda nodes: pickle.loads(pickle.dumps(nodes))], ids=["copy", "pickle"]
)
def test_outcomes_travel_with_their_nan(how):
    objective = fork(lambda u: {"y": u + 1}, lambda u: {"y": ca.sqrt(u - 9)})
    nodes = objective.outcomes({}, {"u": 0.5}, {"way": "left"})
    there = how(nodes)
    assert [n.path for n in there] == [n.path for n in nodes]
    assert there[1].states["y"] == nodes[1].states["y"]
    assert np.isnan(there[2].states["y"].mean)


def test_probabilities_that_do_not_sum_to_one_are_noted():
    g = sg.Graph({"p": sg.State(), "x": sg.State()}, "n")
    g.chance("n", {"hit": ("won", None), "miss": ("lost", None)}, lambda p: {"hit": p, "miss": 0.5})
    g.reward("won", lambda x: x)
    objective = objective_of(g)
    assert objective.outcomes({"p": 0.5 + 1e-9, "x": 1}).notes() == []
    (note,) = objective.outcomes({"p": 0.75, "x": 1}).notes()
    assert "probabilities at 'n' sum to 1.25" in note
    assert objective.value({"p": 0.75, "x": 1}) == 0.75


def test_a_node_that_cannot_be_reached_is_not_noted():
    g = sg.Graph({"p": sg.State()}, "n")
    g.chance("n", {"hit": ("won", None), "miss": ("n", None)}, lambda p: {"hit": p, "miss": 1 - p})
    objective = objective_of(g)
    assert objective.outcomes({"p": 1.0}).notes() == []
    assert len(objective.outcomes({"p": 0.5}).notes()) == 1


@pytest.mark.parametrize("propagation", ["mean", "linear", "second-order", "unscented", "quadrature"])
@pytest.mark.parametrize("spread", [0.0, 0.04])
def test_what_is_zero_everywhere_is_a_number(propagation, spread):
    g = sg.Graph({"u": sg.Action(low=-1, high=1), "x": sg.State(), "y": sg.State(2)}, "aim")
    g.edge("aim", "shot", sg.Model(lambda x: {"y": ca.vertcat(0 * x, 0 * x)}, propagation=propagation))
    g.reward("shot", sg.Model(lambda y: 0 * y[0], propagation=propagation))
    g.reward("shot", lambda u: -(u**2))
    plan = sg.solve(objective_of(g), {"x": sg.Gaussian(3.0, spread)}, progress=False)
    assert plan.value == pytest.approx(0.0, abs=1e-12)
    assert plan.nodes[1].reward == plan.value
    assert_close(plan.nodes[1].states["y"].mean, [0.0, 0.0])
