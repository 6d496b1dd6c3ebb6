"""Models and parameters as the user writes them; what becomes of them in a graph is tested in test_binding.py."""

import functools

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_tasks import objective_of, refuses

import symgraph as sg
from symgraph.model import is_propagator


class Own:
    """The smallest propagator."""

    reads = ("x",)
    writes = ("x",)

    def propagate(self, inputs):
        return inputs


def step(x):
    return {"x": x + 1}


REFUSED = {
    "no function": (lambda: sg.Model(3), ["3 is not a model", "function of slots"]),
    "nothing": (lambda: sg.Model(None), ["None is not a model"]),
    "twice": (lambda: sg.Model(sg.Model(step)), ["'step'", "wrapped in Model twice", "one Model"]),
    "rule": (
        lambda: sg.Model(step, propagation="liner"),
        ["'step'", "propagation = 'liner'", "did you mean 'linear'?", "Rules: 'mean', 'linear', 'second-order'"],
    ),
    "no rule": (lambda: sg.Model(step, propagation=["mean"]), ["propagation = ['mean']", "Rules:"]),
    "own rule": (
        lambda: sg.Model(Own(), propagation="mean"),
        ["'Own' propagates Gaussians by itself", "leave out propagation='mean'"],
    ),
    "rename": (lambda: sg.Model(step, rename="xy"), ["'step'", "rename = 'xy'", "give a dict"]),
    "noise": (lambda: sg.Model(step, noise=0.1), ["'step'", "noise = 0.1", "give a dict"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_model_refuses(case):
    call, words = REFUSED[case]
    refuses(call, sg.GraphError, *words)


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (step, "step"),
        (functools.partial(step), "step"),
        (functools.partial(functools.partial(step)), "step"),
        (lambda x: x, "<lambda>"),
        (Own(), "Own"),
    ],
)
def test_model_has_the_name_of_its_function(function, name):
    assert sg.Model(function).name == name
    assert repr(sg.Model(function)) == f"Model({name})"


def test_options_are_copied():
    rename = {"x": "y"}
    model = sg.Model(step, rename=rename)
    rename.clear()
    assert model.rename == {"x": "y"}


def test_propagators_are_known_by_what_they_offer():
    assert is_propagator(Own())
    assert isinstance(Own(), sg.Propagator)
    assert not is_propagator(step)


# Parameters


REFUSED_VALUES = {
    "words": "a",
    "nan": float("nan"),
    "infinite": [[1.0, np.inf], [0.0, 0.0]],
    "three axes": np.zeros((2, 2, 2)),
}


@pytest.mark.parametrize("case", REFUSED_VALUES)
def test_parameter_refuses(case):
    value = REFUSED_VALUES[case]
    refuses(lambda: sg.Parameter(value, "gain"), sg.SlotError, "parameter 'gain'")
    parameter = sg.Parameter(np.ones((2, 2)), "gain")
    refuses(lambda: setattr(parameter, "value", value), sg.SlotError, "parameter 'gain'")
    np.testing.assert_array_equal(parameter.value, np.ones((2, 2)))


@pytest.mark.parametrize("shape", [(3, 2), (6,), (6, 1), (2, 2)])
def test_a_parameter_keeps_its_shape(shape):
    parameter = sg.Parameter(np.zeros((2, 3)), "weights")
    refuses(lambda: setattr(parameter, "value", np.zeros(shape)), sg.SlotError, "'weights'", "shape is fixed")


@pytest.mark.parametrize(
    ("value", "shape"), [(2.0, (1, 1)), ([1.0, 2.0], (2, 1)), ([[1.0, 2.0]], (1, 2)), (np.eye(3), (3, 3))]
)
def test_a_parameter_and_its_symbol_have_one_shape(value, shape):
    parameter = sg.Parameter(value)
    assert parameter.value.shape == parameter.symbol.shape == shape
    parameter.value = value
    np.testing.assert_array_equal(parameter.value, np.reshape(value, shape))


def test_a_parameter_keeps_no_hold_on_what_it_was_given():
    value = np.zeros(2)
    parameter = sg.Parameter(value)
    value[0] = 5
    assert not parameter.value.any()


class Affine:
    """y = Wx + b with weights that may change."""

    reads = ("x",)
    writes = ("y",)

    def __init__(self, weights, offset):
        self.weights, self.offset = sg.Parameter(weights, "weights"), sg.Parameter(offset, "offset")
        self.parameters = [self.weights, self.offset]

    def propagate(self, inputs):
        x, w = inputs["x"], self.weights.symbol
        return {"y": sg.Gaussian(w @ x.mean + self.offset.symbol, w @ x.covariance @ w.T)}


matrices = hnp.arrays(float, (2, 3), elements=st.floats(-2, 2))


@pytest.fixture(scope="module")
def affine():
    model = Affine(np.zeros((2, 3)), np.zeros(2))
    graph = sg.Graph({"x": sg.State(3), "y": sg.State(2)}, start="here")
    graph.edge("here", "scored", model)
    graph.reward("scored", lambda y: ca.sumsqr(y - 1))
    return model, objective_of(graph)


@given(matrices, hnp.arrays(float, 2, elements=st.floats(-2, 2)))
def test_new_values_count_at_once(affine, weights, offset):
    """E|Wx + b - 1|^2 = |Wm + b - 1|^2 + tr(WSW')."""
    model, objective = affine
    model.weights.value, model.offset.value = weights, offset
    mean, covariance = np.array([0.3, -1.0, 0.7]), np.diag([0.1, 0.2, 0.3])
    value = objective.value({"x": sg.Gaussian(mean, covariance)})
    expected = np.sum((weights @ mean + offset - 1) ** 2) + np.trace(weights @ covariance @ weights.T)
    assert value == pytest.approx(expected, rel=1e-12, abs=1e-12)
