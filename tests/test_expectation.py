"""The algebra of the expected sum of rewards: what may be changed in a graph without changing its value, and how."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import assert_close, fork, objective_of

import symgraph as sg
from symgraph.expectation import expected_value

POINT = {"u": [0.3, -0.7], "w": 0.2}
STATE = {"x": sg.Gaussian([0.5, -0.2], [[0.3, 0.1], [0.1, 0.2]]), "y": 1.5}
CHOICES = [{"way": "left"}, {"way": "right"}]


def step(x, u, y):
    return {"x": ca.vertcat(x[0] + y * u[0], ca.sin(x[1]) * u[1])}


def turn(x, w):
    return {"x": ca.vertcat(x[0] * ca.cos(w) - x[1], x[0] + x[1] * w)}


def odds(x, w):
    p = 1 / (1 + ca.exp(-x[0] - w))
    return {"hit": p, "miss": 1 - p}


def score(x, y):
    return ca.sumsqr(x) * y - x[0]


def bonus(x, w):
    return ca.cos(x[1]) * w


def build(order=("x", "y", "u", "w", "way"), identity=False, certain=False, scale=1.0, rewards=("score", "bonus")):
    """A task with every kind of group, in variants."""
    slots = {
        "x": sg.State(2),
        "y": sg.State(),
        "u": sg.Action(2, low=-1, high=1),
        "w": sg.Action(low=-1, high=1),
        "way": sg.Selection(["left", "right"]),
    }
    g = sg.Graph({label: slots[label] for label in order}, "start")
    g.choose("start", "way", {"left": ("chosen", step), "right": ("chosen", turn)})
    source = "chosen"
    if identity:
        g.edge("chosen", "same")
        source = "same"
    if certain:
        g.chance(source, {"surely": ("sure", turn)}, {"surely": 1.0})
    else:
        g.edge(source, "sure", turn)
    g.chance("sure", {"hit": ("end", step), "miss": ("start", None)}, odds)
    if "score" in rewards:
        g.reward("end", lambda x, y: scale * score(x, y))
    if "bonus" in rewards:
        g.reward("end", lambda x, w: scale * bonus(x, w))
        g.reward("sure", lambda x, w: scale * bonus(x, w))
    return objective_of(g, max_visits=2)


def numbers(objective, choice):
    gradient = objective.gradient(STATE, POINT, choice)
    return np.concatenate([[objective.value(STATE, POINT, choice)], gradient["u"], [gradient["w"]]])


@pytest.fixture(scope="module")
def plain():
    objective = build()
    return [numbers(objective, choice) for choice in CHOICES]


@pytest.mark.parametrize("order", [("way", "w", "u", "y", "x"), ("u", "x", "way", "y", "w")], ids=lambda o: "".join(o))
def test_the_order_of_the_slots_changes_nothing(plain, order):
    objective = build(order)
    for choice, expected in zip(CHOICES, plain, strict=True):
        assert_close(numbers(objective, choice), expected)


@pytest.mark.parametrize("change", [{"identity": True}, {"certain": True}], ids=["identity edge", "probability 1"])
def test_what_changes_nothing(plain, change):
    objective = build(**change)
    for choice, expected in zip(CHOICES, plain, strict=True):
        assert_close(numbers(objective, choice), expected)


@pytest.mark.parametrize("scale", [0.0, -3.0, 1e6])
def test_scaled_rewards_scale_the_value(plain, scale):
    objective = build(scale=scale)
    for choice, expected in zip(CHOICES, plain, strict=True):
        assert_close(numbers(objective, choice), scale * expected)


def test_reward_groups_add_up(plain):
    parts = [build(rewards=("score",)), build(rewards=("bonus",)), build(rewards=())]
    for choice, expected in zip(CHOICES, plain, strict=True):
        first, second, nothing = [numbers(part, choice) for part in parts]
        assert_close(first + second, expected)
        assert not nothing.any()


def test_labels_may_be_renamed():
    def value(state, action):
        g = sg.Graph({state: sg.State(), action: sg.Action(low=-1, high=1)}, "here")
        model = sg.Model(lambda x, u: {"x": x * ca.sin(u) + u}, rename={"x": state, "u": action})
        g.edge("here", "there", model)
        g.reward("there", sg.Model(lambda x: x**2, rename={"x": state}))
        objective = objective_of(g)
        arguments = {state: sg.Gaussian(0.4, 0.3)}, {action: 0.6}
        return objective.value(*arguments), objective.gradient(*arguments)[action]

    assert value("x", "u") == value("u", "x") == value("a_b", "größe")


@settings(max_examples=20)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=5).filter(lambda p: sum(p) > 0.1), st.data())
def test_constant_chances_are_a_weighted_mean(weights, data):
    shares = np.array(weights) / sum(weights)
    gains = np.array([data.draw(st.floats(-10, 10)) for _ in shares])
    g = sg.Graph({"x": sg.State()}, "here")
    g.chance(
        "here",
        {f"b{i}": (f"n{i}", lambda x, gain=gain: {"x": x + gain}) for i, gain in enumerate(gains)},
        {f"b{i}": share for i, share in enumerate(shares)},
    )
    for i, share in enumerate(shares):
        if share > 0:
            g.reward(f"n{i}", lambda x: x)
    assert_close(objective_of(g).value({"x": 2.0}), 2 + shares @ gains)


def test_groups_side_by_side_do_not_see_each_other():
    g = sg.Graph({"x": sg.State()}, "here")
    for i in range(3):
        g.edge("here", f"n{i}", lambda x, i=i: {"x": x + 10**i})
        g.reward(f"n{i}", lambda x: x)
    assert objective_of(g).value({"x": 1.0}) == 2 + 11 + 101


def test_one_selection_in_two_groups_has_one_value():
    g = sg.Graph({"x": sg.State(), "way": sg.Selection(["left", "right"])}, "here")
    for i in range(2):
        g.choose("here", "way", {"left": (f"l{i}", None), "right": (f"r{i}", None)})
        g.reward(f"l{i}", lambda x, i=i: 10**i * x)
        g.reward(f"r{i}", lambda x, i=i: 5 * 10**i * x)
    objective = objective_of(g)
    assert [objective.value({"x": 1}, {}, {"way": way}) for way in ("left", "right")] == [11, 55]


# A branch that is not selected


BROKEN = {
    "nan": lambda u: {"y": ca.sqrt(u - 5)},
    "infinite": lambda u: {"y": 1 / (u - u)},
    "overflow": lambda u: {"y": ca.exp(1e4 + u)},
    "infinite slope": lambda u: {"y": ca.sqrt(u - 0.5)},
}


@pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("kind", BROKEN)
def test_an_unselected_branch_may_be_broken(kind, compiled):
    objective = fork(lambda u: {"y": u**2}, BROKEN[kind], compiled=compiled)
    arguments = {}, {"u": 0.5}, {"way": "left"}
    assert objective.value(*arguments) == 0.25
    assert objective.gradient(*arguments) == {"u": 1.0}
    assert_close(objective.hessian(*arguments), [[2.0]])
    values, gradients = objective.evaluate({}, [[0.5, 0.1]], {"way": "left"})
    assert_close(values, [0.25, 0.01])
    assert_close(gradients, [[1.0, 0.2]])


def test_a_broken_branch_below_a_broken_branch():
    slots = {"u": sg.Action(low=0, high=1), "y": sg.State(), "one": sg.Selection(["a", "b"])}
    g = sg.Graph({**slots, "two": sg.Selection(["a", "b"])}, "n")
    g.choose("n", "one", {"a": ("m", lambda u: {"y": u}), "b": ("m", BROKEN["nan"])})
    g.choose("m", "two", {"a": ("end", lambda y: {"y": y * 2}), "b": ("end", lambda y: {"y": ca.sqrt(y - 5)})})
    g.reward("end", lambda y: y)
    objective = objective_of(g)
    assert objective.value({}, {"u": 0.5}, {"one": "a", "two": "a"}) == 1.0
    assert objective.gradient({}, {"u": 0.5}, {"one": "a", "two": "a"}) == {"u": 2.0}
    assert np.isnan(objective.value({}, {"u": 0.5}, {"one": "a", "two": "b"}))


# The expression


def test_exact_start_states_bring_no_covariance():
    g = sg.Graph({"x": sg.State(3), "y": sg.State()}, "n")
    g.reward("n", lambda x, y: ca.sumsqr(x) * y)
    tree = sg.unroll(g)
    assert expected_value(tree, frozenset()).inputs.covariances.numel() == 0
    assert expected_value(tree, frozenset(["x"])).inputs.covariances.numel() == 9
    assert expected_value(tree, frozenset(["x", "y"])).inputs.uncertain == ("x", "y")


def test_a_single_choice_needs_no_switch():
    g = sg.Graph({"x": sg.State(), "only": sg.Selection(["one"])}, "n")
    g.choose("n", "only", {"one": ("m", lambda x: {"x": 2 * x})})
    g.reward("m", lambda x: x)
    assert objective_of(g).value({"x": 3}, {}, {"only": "one"}) == 6


def test_large_trees_give_the_same_numbers():
    """Where the expression is too long to be flattened: the same chain, 12 steps and 600."""

    def chain(steps):
        g = sg.Graph({"x": sg.State(), "u": sg.Action(low=-1, high=1)}, "n")
        g.edge("n", "n", lambda x, u: {"x": ca.cos(x) + u * ca.sin(x) / steps})
        g.reward("n", lambda x: -((x - 1) ** 2))
        return objective_of(g, max_visits=steps)

    def by_hand(steps, u, x=0.3):
        total = 0.0
        for _ in range(steps):
            total -= (x - 1) ** 2
            x = np.cos(x) + u * np.sin(x) / steps
        return total

    for steps in (12, 600):
        objective, h = chain(steps), 1e-5
        assert_close(objective.value({"x": 0.3}, {"u": 0.4}), by_hand(steps, 0.4))
        slope = (by_hand(steps, 0.4 + h) - by_hand(steps, 0.4 - h)) / (2 * h)
        assert objective.gradient({"x": 0.3}, {"u": 0.4})["u"] == pytest.approx(slope, rel=1e-6)
