"""Models in a graph: what is refused, and how functions and propagators meet the slots."""

import functools
import math

import casadi as ca
import numpy as np
import pytest
from small_tasks import assert_close, objective_of, refuses

import symgraph as sg

SLOTS = {
    "speed": sg.State(),
    "target": sg.State(2),
    "lower_muzzle": sg.State(2),
    "hit": sg.State(),
    "theta": sg.Action(low=-1, high=1),
    "way": sg.Selection(["left", "right"]),
}


def edge(model):
    return lambda: sg.Graph(SLOTS, "aim").edge("aim", "landed", model)


def reward(model):
    return lambda: sg.Graph(SLOTS, "aim").reward("aim", model)


def chance(model):
    branches = {"yes": ("landed", None), "no": ("lost", None)}
    return lambda: sg.Graph(SLOTS, "aim").chance("aim", branches, model)


class Own:
    """A propagator that does what the test wants."""

    def __init__(self, propagate, reads=("speed",), writes=("hit",)):
        self._propagate, self.reads, self.writes = propagate, reads, writes

    def propagate(self, inputs):
        return self._propagate(inputs)


FOREIGN = ca.MX.sym("w")
EDGE = ["edge 'aim' → 'landed': model"]

REFUSED = {
    # what it reads
    "misspelt slot": (
        edge(lambda muzle: {}),
        [*EDGE, "reads 'muzle'", "did you mean 'lower_muzzle'?", "Slots: 'speed', 'target'"],
    ),
    "unknown slot": (edge(lambda zzz: {}), [*EDGE, "reads 'zzz'", "Slots:"]),
    "renamed to unknown": (edge(sg.Model(lambda x: {}, rename={"x": "sped"})), ["reads 'sped'", "'speed'?"]),
    "any number": (edge(lambda *x: {}), ["'*x'", "name each slot"]),
    "any names": (edge(lambda **x: {}), ["'**x'", "name each slot"]),
    "by position": (edge(eval("lambda x, /: {}")), ["parameter 'x' is positional-only", "by name"]),
    "no signature": (edge(max), ["'max' shows no parameter names", "wrap it in a function"]),
    "wrong rename": (
        edge(sg.Model(lambda speed: {"hit": speed}, rename={"sped": "hit"})),
        ["rename names 'sped'", "neither reads nor writes", "did you mean 'speed'?", "Its names: 'speed', 'hit'"],
    ),
    # what it returns
    "nothing": (edge(lambda speed: None), [*EDGE, "returned nothing", "a dict {slot: value}"]),
    "a column": (edge(lambda speed: speed), ["returned SX", "a dict {slot: value}"]),
    "words": (edge(lambda speed: {"hit": "far"}), ["returned 'far' (str) for 'hit'", "CasADi column"]),
    "none": (edge(lambda speed: {"hit": None}), ["returned None", "for 'hit'"]),
    "a row": (edge(lambda target: {"target": target.T}), ["1×2 matrix for 'target'", "column", ".T"]),
    "misspelt write": (
        edge(lambda speed: {"tarket": speed}),
        [*EDGE, "writes 'tarket'", "did you mean 'target'?", "Slots:"],
    ),
    "number as label": (edge(lambda speed: {3: speed}), ["writes '3'", "Slots:"]),
    "an action": (edge(lambda speed: {"theta": speed}), ["writes 'theta', which is an action", "states only"]),
    "a selection": (edge(lambda speed: {"way": speed}), ["writes 'way', which is a selection", "states only"]),
    "wrong size": (edge(lambda speed: {"target": speed}), ["writes 'target' with 1 elements", "the slot has 2"]),
    "twice": (
        edge(sg.Model(lambda speed: {"hit": speed, "miss": speed}, rename={"miss": "hit"})),
        ["writes 'hit' twice", "rename"],
    ),
    "raises": (edge(lambda speed: {"hit": 1 / 0}), ["raised ZeroDivisionError: division by zero", "'speed'"]),
    "raises with a dot": (edge(lambda speed: {}["x"]), ["raised KeyError: 'x'"]),
    "branches on values": (
        edge(lambda speed: {"hit": 1 if speed > 0 else 2}),
        ["raised", "casadi.if_else", "no Python branches"],
    ),
    "math": (edge(lambda speed: {"hit": math.sin(speed)}), ["raised", "casadi.sin"]),
    "foreign symbol": (
        edge(lambda speed: {"hit": ca.SX.sym("w") * speed}),
        ["uses the symbol w", "read it as a slot"],
    ),
    # rewards
    "reward: a dict": (reward(lambda speed: {"hit": speed}), ["node 'aim', reward", "returned a dict", "one scalar"]),
    "reward: a vector": (reward(lambda target: target), ["returned 2 elements", "one scalar", "casadi.sum1"]),
    "reward: nothing": (reward(lambda target: None), ["returned None"]),
    "reward: no model": (reward(None), ["node 'aim', reward", "None is not a model"]),
    "reward: a number": (reward(5), ["5 is not a model"]),
    "reward: misspelt": (reward(lambda spead: spead), ["reads 'spead'", "did you mean 'speed'?"]),
    # probabilities
    "probability: not a dict": (
        chance(lambda speed: speed),
        ["node 'aim', probability", "a dict {branch: probability}"],
    ),
    "probability: other branches": (
        chance(lambda speed: {"yes": speed, "maybe": 1 - speed}),
        ["returned the branches 'yes', 'maybe'", "the chance has 'yes', 'no'"],
    ),
    "probability: a vector": (
        chance(lambda target: {"yes": target, "no": 1}),
        ["returned 2 elements for branch 'yes'", "scalar"],
    ),
    # noise
    "noise: misspelt": (
        edge(sg.Model(lambda speed: {"hit": speed}, noise={"hitt": 1})),
        ["noise on 'hitt'", "does not write", "did you mean 'hit'?"],
    ),
    "noise: not written": (edge(sg.Model(lambda speed: {"hit": speed}, noise={"speed": 1})), ["noise on 'speed'"]),
    "noise: on a reward": (reward(sg.Model(lambda speed: speed, noise={"speed": 1})), ["noise on 'speed'"]),
    "noise: size": (
        edge(sg.Model(lambda target: {"target": target}, noise={"target": 1})),
        ["noise on 'target'", "shape ()", "(2, 2)"],
    ),
    "noise: negative": (
        edge(sg.Model(lambda speed: {"hit": speed}, noise={"hit": -1})),
        ["noise on 'hit'", "negative variance -1"],
    ),
    "noise: asymmetric": (
        edge(sg.Model(lambda target: {"target": target}, noise={"target": [[1, 0], [0.5, 1]]})),
        ["noise on 'target'", "not symmetric"],
    ),
    # propagators
    "own: raises": (edge(Own(lambda i: 1 / 0)), ["'Own' raised ZeroDivisionError in propagate"]),
    "own: no dict": (edge(Own(lambda i: None)), ["propagate returned None", "{label: Gaussian}"]),
    "own: no Gaussian": (edge(Own(lambda i: {"hit": 1.0})), ["propagate returned {'hit': 1.0}", "{label: Gaussian}"]),
    "own: other labels": (
        edge(Own(lambda i: {"hot": i["speed"]})),
        ["propagate returned 'hot'", "its writes are 'hit'"],
    ),
    "own: other kind": (edge(Own(lambda i: {"hit": sg.Gaussian(ca.SX.sym("x"))})), ["SX", "MX"]),
    "own: foreign mean": (
        edge(Own(lambda i: {"hit": sg.Gaussian(FOREIGN * i["speed"].mean)})),
        ["uses the symbol w", "`parameters`"],
    ),
    "own: foreign covariance": (
        edge(Own(lambda i: {"hit": sg.Gaussian(i["speed"].mean, FOREIGN**2)})),
        ["uses the symbol w", "`parameters`"],
    ),
    "own: reads": (edge(Own(lambda i: i, reads=5)), ["reads is 5", "labels"]),
    "own: misspelt": (edge(Own(lambda i: i, reads=("sped",))), ["reads 'sped'", "did you mean 'speed'?"]),
    "own: size": (
        edge(Own(lambda i: {"hit": sg.Gaussian(ca.vertcat(1, i["speed"].mean))})),
        ["writes 'hit' with 2 elements", "the slot has 1"],
    ),
    "own: reward of two": (reward(Own(lambda i: dict(i, hit=i["speed"]), writes=("hit", "speed"))), ["one scalar"]),
    "own: a class": (reward(type("Class", (Own,), {"reads": (), "writes": ()})), ["raised TypeError in propagate"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    call, words = REFUSED[case]
    refuses(call, sg.GraphError, *words)


# What a function may be


def value_of(model, state=None, **options):
    graph = sg.Graph(SLOTS, "aim")
    graph.reward("aim", model)
    return objective_of(graph).value(state or {"speed": 2.0}, {"theta": 0.5}, {"way": "right"}, **options)


def double(speed, factor=2.0):
    return factor * speed


FUNCTIONS = {
    "a constant": (lambda: 7, 7),
    "a default is a constant": (double, 4),
    "a partial": (functools.partial(double, factor=3.0), 6),
    "keyword only": (lambda *, speed: speed, 2),
    "an action": (lambda theta, speed: theta * speed, 1),
    "a selection": (lambda way: 10 * way[0] + 20 * way[1], 20),
    "a casadi function": (lambda speed: ca.Function("f", [x := ca.MX.sym("x")], [x**2])(speed), 4),
    "a spline": (
        lambda speed: ca.interpolant("f", "bspline", [[0, 1, 2, 3, 4]], [0.0, 1.0, 4.0, 9.0, 16.0])(speed),
        4,
    ),
    "a table, which SX cannot hold": (
        lambda speed: ca.interpolant("f", "linear", [[0, 1, 3]], [0.0, 1.0, 5.0])(speed),
        3,
    ),
    "underscores": (eval("lambda __: __", {}), None),
    "umlauts": (eval("lambda größe: größe", {}), None),
}


@pytest.mark.parametrize("case", FUNCTIONS)
def test_function(case):
    model, expected = FUNCTIONS[case]
    if expected is None:  # names that CasADi would refuse
        label = next(iter(model.__code__.co_varnames))
        graph = sg.Graph({label: sg.State()}, "aim")
        model.__name__ = label
        graph.reward("aim", model)
        assert objective_of(graph).value({label: sg.Gaussian(2.0, 1.0)}) == 2.0
        return
    assert value_of(model) == pytest.approx(expected, rel=1e-12)


def test_what_an_edge_returns_may_be_numbers_lists_and_arrays():
    graph = sg.Graph(SLOTS, "aim")
    graph.edge("aim", "a", lambda speed: {"target": [speed, 1.0], "hit": 3})
    graph.edge("a", "b", lambda target: {"target": np.array([target[1], 2 * target[0]], dtype=object)})
    graph.edge("b", "c", lambda target: {"lower_muzzle": (target[0], np.float64(5))})
    graph.reward("c", lambda target, lower_muzzle, hit: hit + 10 * target[1] + 100 * lower_muzzle[0] + lower_muzzle[1])
    assert objective_of(graph).value({"speed": 2.0}, {"theta": 0}, {"way": "left"}) == 3 + 40 + 100 + 5


def test_an_edge_may_write_nothing():
    graph = sg.Graph(SLOTS, "aim")
    graph.edge("aim", "a", lambda speed: {})
    graph.reward("a", lambda speed: speed)
    assert objective_of(graph).value({"speed": 2.0}, {"theta": 0}, {"way": "left"}) == 2.0


def test_one_model_on_many_edges_with_other_labels():
    slots = {label: sg.State() for label in "abc"}
    graph = sg.Graph(slots, "n0")

    def swap(x, y):
        return {"x": y, "y": x}

    graph.edge("n0", "n1", sg.Model(swap, rename={"x": "a", "y": "b"}))
    graph.edge("n1", "n2", sg.Model(swap, rename={"x": "b", "y": "c"}))
    graph.reward("n2", lambda a, b, c: a + 10 * b + 100 * c)
    assert objective_of(graph).value({"a": 1, "b": 2, "c": 3}) == 2 + 30 + 100


def test_what_an_edge_writes_is_read_before_it_changes():
    graph = sg.Graph({"x": sg.State(), "y": sg.State()}, "n0")
    graph.edge("n0", "n1", lambda x, y: {"x": y, "y": x + y})
    graph.reward("n1", lambda x, y: 10 * x + y)
    assert objective_of(graph).value({"x": 1, "y": 2}) == 23


def test_noise_is_added_to_the_covariance():
    graph = sg.Graph({"x": sg.State(2)}, "n0")
    noise = np.array([[0.3, 0.1], [0.1, 0.2]])
    graph.edge("n0", "n1", sg.Model(lambda x: {"x": 2 * x}, noise={"x": noise}))
    nodes = objective_of(graph).outcomes({"x": sg.Gaussian([1, 2], np.eye(2))})
    assert_close(nodes[1].states["x"].covariance, 4 * np.eye(2) + noise)


@pytest.mark.parametrize(
    ("propagation", "mean", "variance"), [("mean", 4, 0), ("linear", 4, 16), ("second-order", 5, 16)]
)
def test_rule_of_an_edge(propagation, mean, variance):
    graph = sg.Graph({"x": sg.State(), "y": sg.State()}, "n0")
    graph.edge("n0", "n1", sg.Model(lambda x: {"y": x**2}, propagation=propagation))
    y = objective_of(graph).outcomes({"x": sg.Gaussian(2, 1)})[1].states["y"]
    assert (y.mean, y.covariance) == pytest.approx((mean, variance))


# Propagators


class Ramp:
    """y = max(0, x) under N(m, s), with the deterministic limit.

    E[y] = m F + s f and E[y^2] = (m^2 + s^2) F + m s f, where F and f are the standard normal distribution and
    density at m / s and s the standard deviation. Source: the moments of a rectified Gaussian.
    """

    reads = ("x",)
    writes = ("y",)

    def propagate(self, inputs):
        m, variance = inputs["x"].mean, ca.densify(inputs["x"].covariance)
        s = ca.sqrt(ca.fmax(variance, 1e-300))
        z = ca.fmin(ca.fmax(m / s, -30), 30)
        share, density = 0.5 * (1 + ca.erf(z / math.sqrt(2))), ca.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
        first = ca.if_else(variance > 0, m * share + s * density, ca.fmax(0, m))
        second = ca.if_else(variance > 0, (m**2 + variance) * share + m * s * density, ca.fmax(0, m) ** 2)
        return {"y": sg.Gaussian(first, second - first**2)}


class SquaredExcess(Ramp):
    """E[max(0, x)^2], the closed form of a one-sided quadratic penalty; compare equation (8) of the paper."""

    writes = ("anything",)

    def propagate(self, inputs):
        y = super().propagate(inputs)["y"]
        return {"anything": sg.Gaussian(y.covariance + y.mean**2)}


class Above:
    """P(x > 0) under N(m, s), a probability model in closed form."""

    reads = ("x",)
    writes = ("yes", "no")

    def propagate(self, inputs):
        x = inputs["x"]
        share = 0.5 * (1 + ca.erf(x.mean / x.sd / math.sqrt(2)))
        return {"yes": sg.Gaussian(share), "no": sg.Gaussian(1 - share)}


@pytest.mark.parametrize("mean", [-2.0, -0.3, 0.0, 0.8, 3.0])
@pytest.mark.parametrize("sd", [0.2, 1.0, 4.0])
def test_propagator_as_a_reward_agrees_with_sampling(mean, sd):
    graph = sg.Graph({"depth": sg.State()}, "here")
    graph.reward("here", sg.Model(SquaredExcess(), rename={"x": "depth"}))
    samples = np.maximum(0, mean + sd * np.random.default_rng(0).standard_normal(200_000)) ** 2
    value = objective_of(graph).value({"depth": sg.Gaussian(mean, sd=sd)})
    assert abs(value - samples.mean()) < 4 * samples.std() / math.sqrt(samples.size) + 1e-12


@pytest.mark.parametrize("mean", [-1.0, 0.5])
def test_propagator_has_its_deterministic_limit(mean):
    graph = sg.Graph({"x": sg.State(), "y": sg.State(), "u": sg.Action(low=-1, high=1)}, "here")
    graph.edge("here", "moved", lambda x, u: {"x": x + u})
    graph.edge("moved", "ramp", Ramp())
    graph.reward("ramp", lambda y: y**2)
    objective = objective_of(graph)
    for x in (mean, sg.Gaussian(mean, 0.0), sg.Gaussian(mean, 1e-16)):
        assert objective.value({"x": x}, {"u": 0.0}) == pytest.approx(max(0, mean) ** 2, abs=1e-12)
        assert objective.gradient({"x": x}, {"u": 0.0})["u"] == pytest.approx(2 * max(0, mean), abs=1e-6)


def test_propagator_on_an_edge_with_rename_and_noise():
    graph = sg.Graph({"depth": sg.State(), "spill": sg.State()}, "here")
    graph.edge("here", "next", sg.Model(Ramp(), rename={"x": "depth", "y": "spill"}, noise={"spill": 0.5}))
    graph.reward("next", lambda spill: spill)
    objective = objective_of(graph)
    state = {"depth": sg.Gaussian(0.0, 4.0)}
    spill = objective.outcomes(state)[1].states["spill"]
    # E[y] = 2 / sqrt(2 pi) and E[y^2] = 4 / 2
    assert spill.mean == objective.value(state) == pytest.approx(2 / math.sqrt(2 * math.pi))
    assert spill.covariance == pytest.approx(2 - 4 / (2 * math.pi) + 0.5)


def test_propagator_as_a_probability():
    graph = sg.Graph({"x": sg.State(), "gain": sg.State()}, "here")
    graph.chance("here", {"yes": ("won", None), "no": ("lost", None)}, Above())
    graph.reward("won", lambda gain: gain)
    value = objective_of(graph).value({"x": sg.Gaussian(1.0, sd=2.0), "gain": 10})
    assert value == pytest.approx(10 * 0.5 * (1 + math.erf(0.5 / math.sqrt(2))))


def test_propagator_may_return_numbers():
    graph = sg.Graph({"x": sg.State(2), "y": sg.State(2)}, "here")
    given = sg.Gaussian([1.0, 2.0], [[0.5, 0.1], [0.1, 0.5]])
    graph.edge(
        "here", "next", type("Given", (), {"reads": (), "writes": ("y",), "propagate": lambda *_: {"y": given}})()
    )
    assert objective_of(graph).outcomes({})[1].states["y"] == given


def test_propagator_sees_selections_and_actions_as_exact():
    seen = {}

    class Look:
        reads = ("speed", "theta", "way")
        writes = ("hit",)

        def propagate(self, inputs):
            seen.update({label: (g.mean.shape, g.covariance.nnz()) for label, g in inputs.items()})
            return {"hit": inputs["speed"]}

    graph = sg.Graph(SLOTS, "aim")
    graph.edge("aim", "landed", Look())
    graph.reward("landed", lambda hit: hit)
    objective_of(graph).value({"speed": sg.Gaussian(1, 1)}, {"theta": 0}, {"way": "left"})
    assert seen == {"speed": ((1, 1), 1), "theta": ((1, 1), 0), "way": ((2, 1), 0)}


def test_propagator_may_call_what_sx_cannot_hold():
    table = ca.interpolant("f", "linear", [[0, 1, 3]], [0.0, 1.0, 5.0])

    class Table:
        reads = ("x",)
        writes = ("y",)

        def propagate(self, inputs):
            return {"y": sg.Gaussian(table(inputs["x"].mean))}

    graph = sg.Graph({"x": sg.State(), "y": sg.State()}, "here")
    graph.edge("here", "next", Table())
    graph.reward("next", lambda y: y)
    assert objective_of(graph).value({"x": sg.Gaussian(2.0, 1.0)}) == 3.0


def test_models_with_large_matrices_are_not_written_out():
    """Products of constant matrices stay products: scalar by scalar they would be 120,000 instructions."""
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(200, 3)), rng.normal(size=(200, 200))

    def network(x):
        return {"y": ca.sum1(ca.DM(second) @ ca.tanh(ca.DM(first) @ x))}

    graph = sg.Graph({"x": sg.State(3), "y": sg.State()}, start="here")
    graph.edge("here", "there", network)
    graph.reward("there", lambda y: y)
    (model,) = [m for m in sg.unroll(graph).models if m.name == "network"]
    assert model.function_for(()).n_instructions() < 50
    mean = np.array([0.1, -0.2, 0.3])
    value = sg.Objective(sg.unroll(graph), compiled=False).value({"x": mean})
    assert value == pytest.approx(np.sum(second @ np.tanh(first @ mean)), rel=1e-12)


# What a bound model says of itself


def bound(model):
    """The model as a graph holds it, on the edge from "aim" to "landed"."""
    graph = sg.Graph(SLOTS, "aim")
    graph.edge("aim", "landed", model)
    ((group,),) = (graph.groups["aim"],)
    return group.branches[0].model


def test_names_of_a_model_lead_to_labels():
    plain = bound(lambda speed, target: {"hit": speed, "lower_muzzle": target})
    assert plain.sources == {"speed": "speed", "target": "target"}
    assert plain.targets == {"hit": "hit", "lower_muzzle": "lower_muzzle"}
    rename = {"x": "speed", "w": "speed", "y": "hit", "z": "target"}
    renamed = bound(sg.Model(lambda x, w, target: {"y": x * w, "z": target}, rename=rename))
    assert renamed.sources == {"x": "speed", "w": "speed", "target": "target"}
    assert renamed.targets == {"y": "hit", "z": "target"}
    assert renamed.reads == ("speed", "target")  # labels, each once
    assert bound(lambda speed: {}).targets == {}


def test_names_of_a_model_are_copies():
    model = bound(sg.Model(double_of, rename={"x": "speed"}))
    model.sources["x"] = model.targets["hit"] = "target"
    assert (model.sources, model.targets) == ({"x": "speed"}, {"hit": "hit"})


def double_of(x):
    return {"hit": 2 * x}


def test_a_reward_and_a_probability_have_targets_too():
    graph = sg.Graph(SLOTS, "aim")
    graph.chance("aim", {"yes": ("landed", None), "no": ("lost", None)}, lambda speed: {"yes": speed, "no": 1 - speed})
    graph.reward("landed", lambda hit: hit)
    assert graph.groups["aim"][0].probability.targets == {"yes": "yes", "no": "no"}
    assert set(graph.groups["landed"][0].branches[0].model.targets.values()) == {"reward"}


class Fitted(Own):
    """A propagator that can be fitted."""

    def fit(self, x, y):
        raise NotImplementedError


def test_a_learner_is_what_propagates_and_can_be_fitted():
    network = sg.learned.StochasticNetwork({"x": 1}, {"y": 1}, (3,))
    model = bound(sg.Model(network, rename={"x": "speed", "y": "hit"}))
    assert model.learner is network
    assert (model.sources, model.targets) == ({"x": "speed"}, {"y": "hit"})
    view = bound(sg.Model(network, rename={"x": "speed", "y": "hit"}, propagation="diagonal")).learner
    assert view.propagation == "diagonal"
    assert view.parameters[0] is network.parameters[0]  # so that a fit of either is one of both
    own = Fitted(lambda inputs: {"hit": inputs["speed"]})
    assert bound(own).learner is own
    branches = sg.learned.BranchNetwork({"speed": 1}, ["yes", "no"], (3,))
    graph = sg.Graph(SLOTS, "aim")
    graph.chance("aim", {"yes": ("landed", None), "no": ("lost", None)}, branches)
    assert graph.groups["aim"][0].probability.learner is branches


def test_what_cannot_be_fitted_or_does_not_propagate_is_no_learner():
    def with_fit(speed):
        return {"hit": speed}

    with_fit.fit = lambda x, y: None
    for model in (lambda speed: {"hit": speed}, with_fit, Own(lambda inputs: {"hit": inputs["speed"]})):
        assert bound(model).learner is None


def test_products_of_large_matrices_are_not_written_out():
    """A network of two layers in CasADi: thousands of scalars, a dozen operations on matrices."""
    w, v = ca.DM.ones(60, 3) / 7, ca.DM.ones(60, 60) / 60
    wide, narrow = (lambda x: {"y": ca.sum1(ca.mtimes(v, ca.tanh(ca.mtimes(w, x))))}), (lambda x: {"y": ca.sumsqr(x)})
    for model in (wide, narrow):
        graph = sg.Graph({"x": sg.Action(3, low=-1, high=1), "y": sg.State()}, start="a")
        graph.edge("a", "b", model)
        graph.reward("b", lambda y: y)
        objective = objective_of(graph)
        task = objective.situation({}).build.expectation.value_function()
        kinds = {f.class_name() for f in task.find_functions() if f.name() == "f_lambda"}
        assert ("MXFunction" in kinds) == (model is wide)
        x = ca.MX.sym("x", 3)
        expected = ca.Function("f", [x], [model(x)["y"]])([0.1, 0.2, -0.4])
        assert objective.value({}, {"x": [0.1, 0.2, -0.4]}) == pytest.approx(float(expected), rel=1e-13)
