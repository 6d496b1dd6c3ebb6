"""Plans: printed, stored, drawn."""

import copy
import json
import pickle

import casadi as ca
import numpy as np
import pytest
from small_tasks import fork, objective_of, refuses

import symgraph as sg


@pytest.fixture(scope="module")
def solved():
    """A plan with every kind of thing in it: units, vectors, chance, a cut, a NaN in what is not selected."""
    slots = {
        "x": sg.State(2, unit="m"),
        "fine": sg.State(),
        "angle": sg.Action(low=-1, high=1, unit="rad"),
        "push": sg.Action(2, low=0, high=1),
        "tool": sg.Selection(["tip", "shake"]),
    }
    g = sg.Graph(slots, "aim")
    g.choose(
        "aim",
        "tool",
        {
            "tip": ("moved", lambda x, angle, push: {"x": x + ca.vertcat(angle, push[0]), "fine": 1}),
            "shake": ("moved", lambda x, angle: {"x": ca.sqrt(x - 99) * angle, "fine": 0}),
        },
    )
    g.chance("moved", {"hit": ("won", None), "miss": ("aim", None)}, {"hit": 0.75, "miss": 0.25})
    g.reward("won", lambda x, push: 3 - ca.sumsqr(x - 0.5) - (push[1] - 0.5) ** 2)
    g.reward("moved", lambda fine: fine)
    objective = objective_of(g, max_visits=2, cut_value=0.5)
    state = {"x": sg.Gaussian([0.0, 0.1], np.diag([0.01, 0.02]))}
    return objective, state, sg.solve(objective, state)


@pytest.fixture
def plan(solved):
    return solved[2]


def test_value_is_the_sum_of_what_is_paid_times_its_probability(solved):
    objective, state, plan = solved
    cut = objective.tree.cut_value
    paid = sum(n.probability * (cut if n.cut else n.reward) for n in plan.nodes if n.probability)
    assert paid == pytest.approx(plan.value, rel=1e-12)
    assert plan.nodes[0].value == pytest.approx(plan.value, rel=1e-12)
    assert plan.value == pytest.approx(objective.value(state, plan.actions, plan.selections), rel=1e-12)


def test_value_is_that_of_the_best_run(plan):
    assert plan.value == pytest.approx(max(run.value for run in plan.runs), rel=1e-12)  # the first of equals
    assert all(run.value <= plan.value for run in plan.runs)


def test_print(plan):
    lines = str(plan).splitlines()
    assert lines[0] == "tool = tip"
    assert lines[1].startswith("angle = ")
    assert lines[1].endswith(" rad")
    assert lines[2].startswith("push = [")
    assert lines[3].startswith(f"value {plan.value:.6g}: best of 16 starts")
    assert "gradients in" in lines[4]
    assert "Lbfgs, seed 0" in lines[4]
    assert "note: a node recurs more than 2 times with probability 0.0625" in lines[5]
    text = "\n".join(lines[6:])
    assert "aim/moved[tip]/won[hit]: probability 0.75, reward" in text
    assert "(cut)" in text
    assert "shake" not in text  # nobody gets there
    assert "more nodes" not in text


def test_a_long_plan_is_printed_in_part():
    g = sg.Graph({"u": sg.Action(low=0, high=1)}, "n")
    for i in range(30):
        g.edge("n", f"m{i}")
    g.reward("n", lambda u: -u)
    text = str(sg.solve(objective_of(g), {}))
    assert "… and " in text
    assert len(text.splitlines()) < 20


def test_dictionary_holds_everything(plan):
    d = plan.to_dict()
    assert d["actions"]["angle"] == plan.actions["angle"]
    assert d["actions"]["push"] == plan.actions["push"].tolist()
    assert d["selections"] == {"tool": "tip"}
    assert d["units"] == {"x": "m", "angle": "rad"}
    assert (d["value"], d["status"], d["optimizer"], d["seed"]) == (plan.value, plan.status, "Lbfgs", 0)
    assert d["notes"] == list(plan.notes)
    assert len(d["nodes"]) == len(plan.nodes)
    assert len(d["runs"]) == len(plan.runs) == 16
    node = d["nodes"][1]
    assert (node["path"], node["node"], node["probability"], node["cut"]) == ("aim/moved[tip]", "moved", 1.0, False)
    assert node["states"]["x"]["covariance"] == plan.nodes[1].states["x"].covariance.tolist()
    run = d["runs"][0]
    assert set(run) == {"selections", "start", "actions", "value", "outcome", "gradients", "history"}
    assert run["gradients"] == len(run["history"])


def plain(value):
    if isinstance(value, dict):
        return all(type(key) is str and plain(item) for key, item in value.items())
    if isinstance(value, list):
        return all(plain(item) for item in value)
    return type(value) in (str, int, float, bool, type(None))


@pytest.mark.parametrize("optimizer", [sg.Lbfgs(), sg.Adadelta(), sg.Adadelta.paper(), sg.Ipopt()], ids=repr)
def test_dictionary_holds_plain_python_only(solved, optimizer):
    objective, state, _ = solved
    assert plain(sg.solve(objective, state, optimizer, seed=np.int64(1)).to_dict())


def no_constant(name):
    raise AssertionError(f"JSON has no {name}")


def test_json_comes_back_with_null_for_nan(plan):
    back = json.loads(plan.to_json(), parse_constant=no_constant)
    expected = plan.to_dict()
    assert back["actions"] == expected["actions"]
    assert back["runs"][3]["selections"] == expected["runs"][3]["selections"]
    shaken = next(node for node in back["nodes"] if node["path"] == "aim/moved[shake]")
    assert shaken["states"]["x"]["mean"] == [None, None]
    assert shaken["probability"] == 0.0
    assert any(run["value"] is None for run in back["runs"])  # -inf: what shaking leads to


def test_json_may_be_one_line(plan):
    assert "\n" not in plan.to_json(indent=None)


@pytest.mark.parametrize("how", [copy.deepcopy, lambda plan: pickle.loads(pickle.dumps(plan))], ids=["copy", "pickle"])
def test_a_plan_travels(plan, how):
    there = how(plan)
    assert there.to_json() == plan.to_json()
    assert str(there) == str(plan)
    assert there.runs[0] == plan.runs[0] or there.runs[0].history == plan.runs[0].history


def test_a_plan_from_another_process_can_be_a_guess_but_not_drawn(solved):
    objective, state, plan = solved
    there = pickle.loads(pickle.dumps(plan))
    refuses(there.diagram, sg.GraphError, "another process", "draw one of solve's own")
    assert there._repr_svg_() is None
    again = sg.solve(objective, state, sg.Ipopt(), guess=there)
    assert again.value >= plan.value - 1e-9


def test_picture(plan):
    diagram = plan.diagram()
    by_key = {node.key: node for node in diagram.nodes}
    for i, node in enumerate(plan.nodes):
        assert by_key[str(i)].muted == (node.probability == 0)
        if node.probability:
            assert any(f"{node.value:.4g}" in line for line in by_key[str(i)].lines)
        assert by_key[str(i)].tooltip == node.path
    assert {edge.weight for edge in diagram.edges if edge.kind == "chance" and not edge.muted} == {0.75, 0.25}
    assert plan._repr_svg_().lstrip().startswith(("<svg", "<?xml"))


def test_plans_can_be_compared(solved):
    objective, state, plan = solved
    assert plan != sg.solve(objective, state, seed=1)
    assert plan == plan  # vectors inside must not stand in the way
    assert plan != "plan"


def test_runs_are_a_sequence(plan):
    assert len(plan.runs) == len(list(plan.runs))
    assert plan.runs[-1].history == plan.runs[len(plan.runs) - 1].history
    assert [run.value for run in plan.runs[2:4]] == [plan.runs[2].value, plan.runs[3].value]
    assert "16 runs" in repr(plan.runs)
    with pytest.raises(IndexError):
        plan.runs[len(plan.runs)]


def test_a_run_tells_how_it_went(plan):
    for run in plan.runs:
        assert run.gradients == len(run.history) >= 1
        assert run.outcome in ("converged", "iteration limit", "oscillation", "stalled", "not finite")
        assert run.value == pytest.approx(max(run.history), rel=1e-12)
        assert set(run.start) == set(run.actions) == {"angle", "push"}


def test_a_plan_that_is_sure_has_no_notes():
    plan = sg.solve(fork(lambda u: {"y": -(u**2)}, lambda u: {"y": u - 5}), {})
    assert plan.notes == ()
    assert "note" not in str(plan)


def test_probabilities_that_do_not_sum_to_one_are_noted():
    g = sg.Graph({"u": sg.Action(low=0, high=1), "x": sg.State()}, "n")
    g.chance("n", {"hit": ("m", None), "miss": ("o", None)}, lambda u: {"hit": u, "miss": 0.5})
    g.reward("m", lambda x: x)
    plan = sg.solve(objective_of(g), {"x": 1.0})
    assert "probabilities at 'n' sum to 1.5, not to 1" in str(plan)
