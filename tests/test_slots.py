"""States, actions, selections, and the Gaussians that slots hold."""

import copy
import dataclasses
import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_tasks import refuses

import symgraph as sg

NAN, INF = float("nan"), float("inf")

numbers = st.floats(-1e3, 1e3)


@pytest.mark.parametrize("kind", [sg.State, lambda size: sg.Action(size, low=0, high=1)], ids=["State", "Action"])
@pytest.mark.parametrize("size", [0, -1, 1.0, "2", None, True, [2]], ids=repr)
def test_size_must_be_a_positive_whole_number(kind, size):
    refuses(lambda: kind(size), sg.SlotError, f"size = {size!r}", "positive whole number")


def test_size_may_come_from_numpy():
    assert sg.State(np.int64(3)).size == 3
    assert sg.Action(np.int64(3), low=0, high=1).lower.shape == (3,)


REFUSED_ACTIONS = {
    "no low": ({"high": 1}, ["low is missing", "Action(low=0.0, high=1.0)"]),
    "no high": ({"low": 1}, ["high is missing", "finite bounds"]),
    "nan": ({"low": NAN, "high": 1}, ["low = nan is not finite"]),
    "infinite": ({"low": 0, "high": INF}, ["high = inf is not finite", "start points"]),
    "one element infinite": ({"size": 2, "low": 0, "high": [1, INF]}, ["high = [1, inf] is not finite"]),
    "swapped": ({"low": 2, "high": 1}, ["low = 2", "high = 1", "swap them"]),
    "one element swapped": ({"size": 2, "low": [0, 3], "high": [1, 2]}, ["low = 3", "high = 2", "element 1"]),
    "wrong size": ({"size": 3, "low": [0, 0], "high": 1}, ["low has 2 elements", "size is 3", "give 1 or 3"]),
    "words": ({"low": "least", "high": 1}, ["low = 'least' is not a number"]),
    "numerals": ({"low": "0", "high": 1}, ["low = '0' is not a number"]),
    "empty": ({"low": [], "high": 1}, ["low has 0 elements"]),
    "nothing": ({"low": {}, "high": 1}, ["low = {}"]),
}


@pytest.mark.parametrize("case", REFUSED_ACTIONS)
def test_action_refuses(case):
    arguments, words = REFUSED_ACTIONS[case]
    refuses(lambda: sg.Action(**arguments), sg.SlotError, "Action", *words)


def test_bounds_are_spread_over_the_elements():
    action = sg.Action(3, low=-1, high=[1, 2, 3], unit="m")
    np.testing.assert_array_equal(action.lower, [-1, -1, -1])
    np.testing.assert_array_equal(action.upper, [1, 2, 3])
    assert action == sg.Action(3, low=[-1] * 3, high=np.array([1, 2, 3]), unit="m")
    assert hash(action) == hash(sg.Action(3, low=(-1,) * 3, high=(1, 2, 3), unit="m"))


def test_low_may_equal_high():
    assert sg.Action(low=2, high=2).lower == 2


REFUSED_SELECTIONS = {
    "a string": ("tip", ["'tip' is one string", "['tip', 'shake']"]),
    "none": ([], ["no choices", "at least one"]),
    "twice": (["tip", "shake", "tip"], ["'tip' is listed twice", "'tip', 'shake'"]),
    "numbers": ([1, 2], ["choice 1 is not a name"]),
    "empty name": (["tip", ""], ["choice '' is not a name", "non-empty"]),
    "a number": (3, ["choices = 3", "['tip', 'shake']"]),
    "nothing": (None, ["choices = None", "['tip', 'shake']"]),
}


@pytest.mark.parametrize("case", REFUSED_SELECTIONS)
def test_selection_refuses(case):
    choices, words = REFUSED_SELECTIONS[case]
    refuses(lambda: sg.Selection(choices), sg.SlotError, "Selection", *words)


def test_selection_keeps_the_order_of_its_choices():
    selection = sg.Selection(["tip", "shake", "pour"])
    assert selection.choices == ("tip", "shake", "pour")
    assert selection.size == 3


@pytest.mark.parametrize("slot", [sg.State(2, unit="m"), sg.Action(low=0, high=1), sg.Selection(["a", "b"])])
def test_slots_are_immutable_and_can_be_copied(slot):
    with pytest.raises(dataclasses.FrozenInstanceError):
        slot.size = 5
    assert pickle.loads(pickle.dumps(slot)) == slot == copy.deepcopy(slot)


# Gaussians


REFUSED_GAUSSIANS = {
    "both": (lambda: sg.Gaussian(1, 1, sd=1), ["both covariance and sd"]),
    "nan mean": (lambda: sg.Gaussian(NAN), ["mean = nan is not finite"]),
    "infinite mean": (lambda: sg.Gaussian([0, INF], sd=1), ["mean = [0, inf] is not finite"]),
    "words": (lambda: sg.Gaussian("far"), ["mean = 'far' is not a number"]),
    "nothing": (lambda: sg.Gaussian(None), ["mean = None"]),
    "empty": (lambda: sg.Gaussian([]), ["mean is empty"]),
    "matrix mean": (lambda: sg.Gaussian(np.eye(2)), ["mean has shape (2, 2)", "1-D"]),
    "negative variance": (lambda: sg.Gaussian(0, -0.5), ["negative variance -0.5", "semi-definite"]),
    "negative sd": (lambda: sg.Gaussian(0, sd=-2), ["sd = -2 is negative"]),
    "sd size": (lambda: sg.Gaussian([0, 0], sd=[1, 1, 1]), ["sd has 3 elements", "the mean 2", "1 or 2"]),
    "nan sd": (lambda: sg.Gaussian(0, sd=NAN), ["sd = nan is not finite"]),
    "variances": (lambda: sg.Gaussian([0, 0], [1, 1]), ["shape (2,)", "(2, 2)", "sd=", "numpy.diag"]),
    "one variance": (lambda: sg.Gaussian([0, 0], 1), ["shape ()", "(2, 2)"]),
    "size": (lambda: sg.Gaussian([0, 0], np.eye(3)), ["shape (3, 3)", "(2, 2)"]),
    "nan covariance": (lambda: sg.Gaussian([0, 0], [[1, NAN], [NAN, 1]]), ["covariance", "not finite"]),
    "infinite": (lambda: sg.Gaussian(0, INF), ["covariance", "not finite"]),
    "words in it": (lambda: sg.Gaussian(0, "wide"), ["covariance = 'wide' is not a number"]),
    "asymmetric": (
        lambda: sg.Gaussian([0, 0], [[1, 0.5], [0.2, 1]]),
        ["not symmetric", "[0, 1] = 0.5", "[1, 0] = 0.2"],
    ),
    "indefinite": (lambda: sg.Gaussian([0, 0], [[1, 2], [2, 1]]), ["negative eigenvalue -1", "semi-definite"]),
    "symbolic row": (lambda: sg.Gaussian(ca.MX.sym("m", 1, 2)), ["mean is 1×2", "column"]),
    "symbolic size": (lambda: sg.Gaussian(ca.MX.sym("m", 2), ca.MX.sym("c", 3, 3)), ["3×3", "2×2"]),
    "symbolic sd": (lambda: sg.Gaussian(ca.MX.sym("m", 2), sd=ca.MX.sym("s", 3)), ["sd", "3", "2"]),
    "symbolic words": (lambda: sg.Gaussian(ca.MX.sym("m"), "wide"), ["symbols", "mixed"]),
    "two kinds": (lambda: sg.Gaussian(ca.MX.sym("m"), ca.SX.sym("c")), ["MX", "SX"]),
}


@pytest.mark.parametrize("case", REFUSED_GAUSSIANS)
def test_gaussian_refuses(case):
    call, words = REFUSED_GAUSSIANS[case]
    refuses(call, sg.SlotError, "Gaussian", *words)


@pytest.mark.parametrize("mean", [2, 2.0, [2], np.array([[2.0]]), np.float64(2), ca.DM(2)], ids=repr)
@pytest.mark.parametrize("spread", [{"covariance": 9}, {"covariance": [[9.0]]}, {"sd": 3}, {"sd": [3.0]}])
def test_one_element_reads_back_as_floats(mean, spread):
    g = sg.Gaussian(mean, **spread)
    assert (g.mean, g.covariance, g.sd) == (2.0, 9.0, 3.0)
    assert all(type(x) is float for x in (g.mean, g.covariance, g.sd))


def test_left_out_covariance_is_zero():
    assert sg.Gaussian(1).covariance == 0.0
    np.testing.assert_array_equal(sg.Gaussian([1, 2]).covariance, np.zeros((2, 2)))


def test_symbolic_covariance_left_out_has_no_non_zeros():
    assert sg.Gaussian(ca.MX.sym("m", 3)).covariance.nnz() == 0
    assert sg.Gaussian(ca.SX.sym("m", 3)).covariance.shape == (3, 3)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_symbolic_sd_goes_to_the_diagonal_and_back(kind):
    mean, sd = kind.sym("m", 3), kind.sym("s", 3)
    for given_sd, factor in ((sd, 1), (sd[0], sd[0] / sd)):
        g = sg.Gaussian(mean, sd=given_sd)
        back = ca.Function("back", [sd], [ca.densify(g.covariance), ca.densify(g.sd - factor * sd)])
        covariance, error = back([1, 2, 3])
        assert np.array_equal(np.array(covariance) != 0, np.eye(3) != 0)
        np.testing.assert_allclose(error, 0, atol=1e-15)


def test_a_number_may_meet_a_symbol():
    g = sg.Gaussian([1.0, 2.0], ca.MX.sym("c", 2, 2))
    assert g.mean.shape == (2, 1)


def gaussians(n):
    roots = hnp.arrays(float, (n, n), elements=st.floats(-10, 10))
    return st.tuples(hnp.arrays(float, n, elements=numbers), roots).map(lambda p: sg.Gaussian(p[0], p[1] @ p[1].T))


@settings(max_examples=30)
@given(st.integers(1, 4).flatmap(gaussians))
def test_gaussian_round_trip(g):
    assert pickle.loads(pickle.dumps(g)) == g == copy.deepcopy(g)
    assert sg.Gaussian(g.mean, g.covariance) == g
    assert np.all(np.square(g.sd) == pytest.approx(np.diag(np.atleast_2d(g.covariance)), rel=1e-12))


@given(hnp.arrays(float, 3, elements=numbers), hnp.arrays(float, 3, elements=st.floats(0, 1e3)))
def test_sd_and_the_squares_on_the_diagonal_are_the_same(mean, sd):
    assert sg.Gaussian(mean, sd=sd) == sg.Gaussian(mean, np.diag(sd**2))


@settings(max_examples=30)
@given(hnp.arrays(float, (3, 3), elements=st.floats(-1e3, 1e3)))
def test_rounding_is_no_asymmetry(root):
    covariance = root @ root.T
    nudged = covariance * (1 + 1e-12 * np.triu(np.ones((3, 3))))
    kept = sg.Gaussian(np.zeros(3), nudged).covariance
    np.testing.assert_array_equal(kept, kept.T)


@given(numbers, st.floats(0, 1e3))
def test_a_scalar_gaussian_prints_as_it_is_written(mean, variance):
    g = sg.Gaussian(mean, variance)
    assert eval(repr(g), {"Gaussian": sg.Gaussian}) == g


def test_gaussians_differ_from_each_other_and_from_other_things():
    assert sg.Gaussian(1, 2) != sg.Gaussian(1, 3)
    assert sg.Gaussian(1, 2) != 1
    with pytest.raises(TypeError, match="unhashable"):
        hash(sg.Gaussian(1, 2))


def test_gaussian_is_immutable():
    with pytest.raises(AttributeError, match="immutable"):
        sg.Gaussian(1, 2).mean = 3


def test_gaussian_keeps_no_hold_on_the_arrays_it_was_given():
    mean, covariance = np.zeros(2), np.eye(2)
    g = sg.Gaussian(mean, covariance)
    mean[0] = covariance[0, 0] = 5
    assert g == sg.Gaussian([0, 0], np.eye(2))


def test_a_range_that_overflows_is_refused():
    with pytest.raises(sg.SlotError, match=r"range from low .* is not finite; narrow it"):
        sg.Action(low=-1e308, high=1e308)
