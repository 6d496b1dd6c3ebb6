"""What goes into an objective and what comes out; its numbers are judged in the other test_objective files."""

import casadi as ca
import numpy as np
import pytest
from small_tasks import assert_close, objective_of, over_box, refuses

import symgraph as sg
from symgraph import situation as situation_module
from symgraph.compile import toolchain

SLOTS = {
    "speed": sg.State(unit="m/s"),
    "target": sg.State(2, unit="m"),
    "spare": sg.State(),
    "theta": sg.Action(low=-1, high=1, unit="rad"),
    "push": sg.Action(2, low=[0, -1], high=[1, 2]),
    "cannon": sg.Selection(["lower", "upper"]),
}
STATE = {"speed": 3.0, "target": [1.0, 0.5]}
ACTIONS = {"theta": 0.2, "push": [0.5, 1.0]}
CANNON = {"cannon": "upper"}


def graph():
    g = sg.Graph(SLOTS, "aim")
    g.reward(
        "aim",
        lambda speed, target, theta, push, cannon: (
            -((speed * theta - target[0]) ** 2) + target[1] * ca.dot(push, push) + 3 * cannon[1]
        ),
    )
    return g


@pytest.fixture(scope="module")
def objective():
    return objective_of(graph())


def value(state=STATE, actions=ACTIONS, selections=CANNON):
    return lambda o: o.value(state, actions, selections)


def without(mapping, label):
    return {key: item for key, item in mapping.items() if key != label}


REFUSED = {
    # states
    "no mapping": (value(state=[3.0]), ["state is list", "{label: number, array or Gaussian}"]),
    "missing": (
        value(state=without(STATE, "speed")),
        ["state 'speed' is missing", "node 'aim', reward", "reads it"],
    ),
    "both missing": (value(state={}), ["state 'speed' is missing", "Missing in all: 'speed', 'target'"]),
    "missing, another misspelt": (value(state={"sped": 3.0}), ["'sped' is not a slot", "did you mean 'speed'?"]),
    "misspelt": (
        value(state={**STATE, "taget": 1}),
        ["state 'taget' is not a slot", "did you mean 'target'?", "States: 'speed', 'target', 'spare'"],
    ),
    "no label": (value(state={**STATE, 3: 1}), ["state 3 is not a slot"]),
    "an action": (value(state={**STATE, "theta": 1}), ["'theta' is an action", "fixed={'theta': …}"]),
    "a selection": (value(state={**STATE, "cannon": 1}), ["'cannon' is a selection", "fixed="]),
    "size": (value(state={**STATE, "target": [1, 2, 3]}), ["state 'target' has 3 elements", "the slot has 2"]),
    "size of one that nothing reads": (value(state={**STATE, "spare": [1, 2]}), ["state 'spare' has 2 elements"]),
    "size of a mean": (
        value(state={**STATE, "target": sg.Gaussian(1, 1)}),
        ["state 'target'", "mean has 1 elements", "the slot 2"],
    ),
    "nan": (value(state={**STATE, "speed": float("nan")}), ["state 'speed' = nan is not finite"]),
    "infinite": (value(state={**STATE, "target": [1, np.inf]}), ["state 'target'", "not finite"]),
    "words": (value(state={**STATE, "speed": "fast"}), ["state 'speed' = 'fast' is not a number"]),
    "numerals": (value(state={**STATE, "speed": "3"}), ["state 'speed' = '3' is not a number"]),
    "complex": (value(state={**STATE, "speed": 1j}), ["state 'speed' = 1j is not a number"]),
    "symbol": (value(state={**STATE, "speed": ca.MX.sym("v")}), ["state 'speed'", "not a number"]),
    "Gaussian of symbols": (value(state={**STATE, "speed": sg.Gaussian(ca.MX.sym("v"))}), ["'speed'", "symbols"]),
    "matrix": (value(state={**STATE, "target": np.eye(2)}), ["state 'target' has shape (2, 2)"]),
    # actions
    "no actions": (value(actions=None), ["action 'theta' is missing", "'theta', 'push'"]),
    "action missing": (value(actions={"theta": 0.2}), ["action 'push' is missing"]),
    "action misspelt": (
        value(actions={**ACTIONS, "teta": 1}),
        ["'teta' is no action", "did you mean 'theta'?", "Actions: 'theta', 'push'"],
    ),
    "action is a state": (value(actions={**ACTIONS, "speed": 1}), ["'speed' is no action"]),
    "action size": (value(actions={**ACTIONS, "push": 1}), ["action 'push' has 1 elements", "the slot has 2"]),
    "action nan": (value(actions={**ACTIONS, "theta": np.nan}), ["action 'theta' = nan is not finite"]),
    "actions no mapping": (value(actions=[1]), ["actions is list", "{label: value}"]),
    # selections
    "no selections": (value(selections=None), ["selection 'cannon' is missing", "'lower', 'upper'"]),
    "selection misspelt": (
        value(selections={**CANNON, "canon": "lower"}),
        ["'canon' is no selection", "did you mean 'cannon'?"],
    ),
    "choice": (
        value(selections={"cannon": "lowr"}),
        ["selection 'cannon'", "'lowr' is not a choice", "did you mean 'lower'?", "Choices: 'lower', 'upper'"],
    ),
    "number": (value(selections={"cannon": 0}), ["selection 'cannon'", "0 is not a choice"]),
    "one-hot": (value(selections={"cannon": np.array([0, 1])}), ["selection 'cannon'", "is not a choice"]),
    "a word": (value(selections="lower"), ["selections is str", "{label: value}"]),
    # many points
    "points of one axis": (lambda o: o.evaluate(STATE, [1, 2, 3], CANNON), ["points has shape (3,)", "(3, P)"]),
    "points transposed": (lambda o: o.evaluate(STATE, np.zeros((5, 3)), CANNON), ["shape (5, 3)", "(3, P)"]),
    "points of words": (lambda o: o.evaluate(STATE, "abc", CANNON), ["points is 'abc'", "numbers"]),
    "ragged points": (lambda o: o.evaluate(STATE, [[1, 2], [3]], CANNON), ["points is [[1, 2], [3]]", "numbers"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(objective, case):
    call, words = REFUSED[case]
    refuses(lambda: call(objective), sg.InputError, *words)


@pytest.mark.parametrize("method", ["gradient", "hessian", "outcomes"])
def test_every_method_checks_what_it_is_given(objective, method):
    call = getattr(objective, method)
    refuses(lambda: call({}, ACTIONS, CANNON), sg.InputError, "state 'speed' is missing")
    refuses(lambda: call(STATE, {}, CANNON), sg.InputError, "action 'theta' is missing")
    refuses(lambda: call(STATE, ACTIONS, {}), sg.InputError, "selection 'cannon' is missing")


def test_an_objective_is_made_of_a_tree():
    refuses(lambda: sg.Objective(graph()), sg.InputError, "takes a tree, got Graph", "Objective(unroll(graph))")


def expected(theta=0.2, push=(0.5, 1.0)):
    return -((3 * theta - 1) ** 2) + 0.5 * np.dot(push, push) + 3


def test_what_comes_back(objective):
    got = objective.value(STATE, ACTIONS, CANNON)
    assert type(got) is float
    assert got == pytest.approx(expected())
    gradient = objective.gradient(STATE, ACTIONS, CANNON)
    assert list(gradient) == ["theta", "push"]
    assert type(gradient["theta"]) is float
    assert gradient["theta"] == pytest.approx(-6 * (0.6 - 1))
    assert_close(gradient["push"], [0.5, 1.0])
    assert_close(objective.hessian(STATE, ACTIONS, CANNON), np.diag([-18, 1, 1]))


def test_a_scalar_may_be_given_in_many_ways(objective):
    for speed in (3, np.float32(3), [3], np.array([[3.0]]), np.array(3), ca.DM(3)):
        state = {**STATE, "speed": speed}
        for theta in (0.2, [0.2], np.array([0.2])):
            assert objective.value(state, {**ACTIONS, "theta": theta}, CANNON) == pytest.approx(expected())


def test_a_column_is_an_array(objective):
    state = {**STATE, "target": np.array([[1.0], [0.5]])}
    assert objective.value(state, ACTIONS, CANNON) == pytest.approx(expected())


def test_values_outside_the_bounds_are_evaluated_as_they_are(objective):
    assert objective.value(STATE, {**ACTIONS, "theta": 7.0}, CANNON) == pytest.approx(expected(theta=7.0))


def test_many_points_stand_side_by_side_as_columns():
    points = np.random.default_rng(0).normal(size=(3, 7))
    for compiled in (False, True):
        o = objective_of(graph(), compiled=compiled)
        values, gradients = o.evaluate(STATE, points, CANNON)
        assert (values.shape, gradients.shape) == ((7,), (3, 7))
        for value_, gradient, (theta, *push) in zip(values, gradients.T, points.T, strict=True):
            actions = {"theta": theta, "push": push}
            assert value_ == pytest.approx(o.value(STATE, actions, CANNON), rel=1e-12)
            by_label = o.gradient(STATE, actions, CANNON)
            assert_close(gradient, [by_label["theta"], *by_label["push"]])


def test_no_points():
    values, gradients = objective_of(graph()).evaluate(STATE, np.zeros((3, 0)), CANNON)
    assert (values.shape, gradients.shape) == ((0,), (3, 0))


def test_slots_that_nothing_reads_have_gradient_zero():
    g = sg.Graph({**SLOTS, "idle": sg.Action(2, low=0, high=1)}, "aim")
    g.reward("aim", lambda theta: theta)
    o = objective_of(g)
    gradient = o.gradient({}, {**ACTIONS, "idle": [0, 0]}, CANNON)
    assert_close(np.concatenate([gradient["push"], gradient["idle"]]), np.zeros(4))
    assert not o.hessian({}, {**ACTIONS, "idle": [0, 0]}, CANNON).any()


def test_without_actions():
    g = sg.Graph({"x": sg.State()}, "n")
    g.reward("n", lambda x: x**2)
    o = objective_of(g)
    state = {"x": sg.Gaussian(2, 0.5)}
    assert o.value(state) == 4.5
    assert o.gradient(state) == {}
    assert o.hessian(state).shape == (0, 0)
    values, gradients = o.evaluate(state, np.zeros((0, 2)))
    assert_close(values, [4.5, 4.5])
    assert gradients.shape == (0, 2)


def test_without_rewards():
    g = sg.Graph(SLOTS, "aim")
    g.edge("aim", "end")
    o = objective_of(g)
    assert o.value({}, ACTIONS, CANNON) == 0.0
    assert not o.hessian({}, ACTIONS, CANNON).any()


# What is built, and when


@pytest.fixture
def builds(monkeypatch):
    """Counts the expressions that are written down."""
    made = []
    original = situation_module.expected_value

    def counted(*arguments, **options):
        made.append(arguments)
        return original(*arguments, **options)

    monkeypatch.setattr(situation_module, "expected_value", counted)
    return made


def test_one_build_for_each_set_of_uncertain_states(builds):
    o = objective_of(graph())
    assert not builds
    for speed in (3, 4.0, 5.0):
        o.value({**STATE, "speed": speed}, ACTIONS, CANNON)
        o.gradient({**STATE, "speed": speed}, ACTIONS, {"cannon": "lower"})
        o.evaluate(STATE, np.zeros((3, 4)), CANNON)
        o.hessian(STATE, ACTIONS, CANNON)
    assert len(builds) == 1
    for variance in (0.1, 0.2, 0.0):
        o.value({**STATE, "speed": sg.Gaussian(3, variance)}, ACTIONS, CANNON)
    assert len(builds) == 2
    o.value({**STATE, "spare": sg.Gaussian(3, 1)}, ACTIONS, CANNON)  # nothing reads it
    assert len(builds) == 2


class Gain:
    """y = k u with a gain k that may change."""

    reads = ("u",)
    writes = ("y",)

    def __init__(self):
        self.k = sg.Parameter(1.0, "k")
        self.parameters = [self.k]

    def propagate(self, inputs):
        return {"y": sg.Gaussian(self.k.symbol * inputs["u"].mean)}


def test_a_changed_parameter_needs_neither_build_nor_compiler(builds, monkeypatch):
    compilations = []
    monkeypatch.setattr(toolchain, "_compile", _counted(toolchain._compile, compilations))
    gain = Gain()
    g = sg.Graph({"u": sg.Action(low=-10, high=10), "y": sg.State()}, "n")
    g.edge("n", "m", gain)
    g.reward("m", lambda y: -((y - 6) ** 2))
    o = objective_of(g, compiled=True)
    for k in (1.0, 2.0, 3.0):
        gain.k.value = k
        assert o.value({}, {"u": 1.0}) == pytest.approx(-((k - 6) ** 2))
        assert o.gradient({}, {"u": 1.0})["u"] == pytest.approx(-2 * k * (k - 6))
        assert_close(o.hessian({}, {"u": 1.0}), [[-2 * k * k]])
        assert_close(o.evaluate({}, [[1.0, 2.0]])[0], [-((k - 6) ** 2), -((2 * k - 6) ** 2)])
        assert sg.solve(o, {}).actions["u"] == pytest.approx(6 / k)
        assert sg.solve(o, {}, sg.Ipopt()).actions["u"] == pytest.approx(6 / k)
        assert o.outcomes({}, {"u": 1.0})[1].states["y"].mean == k
    assert len(builds) == 1
    assert len(compilations) <= 1  # 0 where an earlier run left it in the cache


def _counted(function, calls):
    def counted(*arguments):
        calls.append(arguments)
        return function(*arguments)

    return counted


def test_bounds_are_stacked_in_the_order_of_the_slots(objective):
    low, high = objective.bounds
    assert_close(low, [-1, 0, -1])
    assert_close(high, [1, 1, 2])


def test_hessian_is_symmetric():
    o = over_box(lambda u: ca.sin(u[0] * u[1]) * ca.exp(u[2]), [-1] * 3, [1] * 3)
    hessian = o.hessian({}, {"u": [0.3, 0.5, -0.2]})
    assert_close(hessian, hessian.T)
    assert hessian[0, 2] != 0
