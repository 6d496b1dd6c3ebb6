"""What if_else does not choose is not a number in many models: it must not spoil what it does choose, nor its slope."""

import casadi as ca
import numpy as np
import pytest
from compiled_functions import bound, compiled, expected, function_of

NONE = np.zeros((2, 0))

# Name → a guarded value of x, and where what is not chosen is not finite.
GUARDED = {
    "root": (lambda x: ca.if_else(x > 0, ca.sqrt(x), 0), -1.0),
    "root at its end": (lambda x: ca.if_else(x > 0, ca.sqrt(x), 0), 0.0),
    "logarithm": (lambda x: ca.if_else(x > 0, ca.log(x), x**2), -1.0),
    "inverse": (lambda x: ca.if_else(x > 0, 1 / x, x), 0.0),
    "quotient": (lambda x: ca.if_else(x > 0, (1 + x) / x, x), 0.0),
    "power": (lambda x: ca.if_else(x > 0, x**0.3, 2 * x), -1.0),
    "overflow": (lambda x: ca.if_else(x < 5, ca.exp(ca.exp(x)), x), 20.0),
    "deep": (lambda x: ca.if_else(x > 0, ca.sin(3 * ca.sqrt(x) ** 3), x**2), -1.0),
    "deeper": (lambda x: ca.if_else(x > 0, ca.tanh(ca.sqrt(x) * ca.log(x) - x / ca.sqrt(x)), x**2), -1.0),
    "within": (lambda x: ca.sin(2 * ca.if_else(x > 0, 2 - ca.sqrt(x), x)) * x, -1.0),
    "in each other": (lambda x: ca.if_else(x > 0, ca.if_else(x > 1, ca.sqrt(x - 1), ca.sqrt(x)), x), -1.0),
    "in turn": (lambda x: ca.if_else(x > 0, ca.sqrt(x), 0) + ca.if_else(x < -2, ca.sqrt(-2 - x), x), -1.0),
    "of two": (lambda x: ca.if_else(x > 0, ca.atan2(ca.sqrt(x), ca.log(x)) + ca.fmax(ca.sqrt(x), 1), x), -1.0),
    "chosen": (lambda x: ca.if_else(x > 0, ca.sqrt(x), 0), 2.0),
}


def as_scalars(function):
    x = ca.SX.sym("x")
    return ca.Function("scalars", [x], [function(x)])


def of_kind(kind, function):
    return as_scalars(function) if kind == "SX" else function


@pytest.fixture(scope="module", params=["MX", "SX"])
def guarded(request):
    """A kernel in which s says which of them is meant."""
    x = ca.MX.sym("x")
    cases = [ca.Function("case", [x], [of_kind(request.param, function)(x)]) for function, _ in GUARDED.values()]
    which = ca.Function.conditional("which", cases[:-1], cases[-1])
    return bound(compiled(function_of(lambda u, s: which(s, u), 1, 1)))


@pytest.mark.parametrize("name", GUARDED)
def test_as_casadi_has_it(guarded, name):
    function, x = GUARDED[name]
    got = guarded.evaluate(np.full((2, 1), x), np.full((2, 1), float(list(GUARDED).index(name))))
    wanted = expected(function_of(lambda u, s: as_scalars(function)(u), 1), np.full((2, 1), x), NONE)
    for one, other in zip(got, wanted, strict=True):
        assert np.isfinite(other).all()
        np.testing.assert_allclose(one, other, rtol=1e-13)


def test_of_columns():
    """Each number has a guard, or one guards all."""

    def body(u, s, p):
        each = ca.sum1(ca.if_else(u > 0, ca.sqrt(u) * ca.log(u) / p, u**2))
        return each + ca.if_else(u[0] > 0, ca.sum1(u**0.3), ca.sum1(u)) + ca.if_else(u[1] > 0, ca.sumsqr(1 / u), 0)

    function = function_of(body, 3, 0, [(3, 1)])
    points, p = np.array([[-1.0, -2.0, 0.5], [-1.0, 0.0, -3.0]]), np.array([1.0, 2.0, 3.0])
    for build in ("lanes", "narrow"):
        got = bound(compiled(function, build), [p]).evaluate(points, NONE)
        for one, other in zip(got, expected(function, points, NONE, [p]), strict=True):
            assert np.isfinite(other).all()
            np.testing.assert_allclose(one, other, rtol=1e-13)


def test_by_what_is_bound():
    """As weights of requirements that have no part in a merit."""
    function = function_of(lambda u, s, w: ca.sum1(ca.if_else(w > 0, (u * w) ** 2 / (2 * w), 0)), 3, 0, [(3, 1)])
    points = np.array([[0.5, 0.7, -0.2], [1.0, 2.0, 3.0]])
    values, gradients = bound(compiled(function), [[1.0, 0.0, 2.0]]).evaluate(points, NONE)
    np.testing.assert_allclose(values, (points**2 * [0.5, 0, 1]).sum(axis=1), rtol=1e-14)
    np.testing.assert_allclose(gradients, points * [1, 0, 2], rtol=1e-14)


def test_by_selections():
    function = function_of(lambda u, s: ca.if_else(s[0] > 0, ca.log(u), u**2), 1, 1)
    values, gradients = bound(compiled(function)).evaluate(np.array([[-1.0], [2.0]]), np.array([[0.0], [1.0]]))
    np.testing.assert_allclose(values, [1, np.log(2)])
    np.testing.assert_allclose(gradients[:, 0], [-2, 0.5])


def test_what_is_chosen_and_not_finite_is_not_finite():
    function = function_of(lambda u, s: ca.if_else(u > 0, u, ca.sqrt(u)), 1)
    values, gradients = bound(compiled(function)).evaluate(np.array([[-1.0], [2.0]]), NONE)
    np.testing.assert_array_equal(values, [np.nan, 2])
    np.testing.assert_array_equal(gradients[:, 0], [np.nan, 1])


def long_root(x):
    """A root, in a function that is too long to be written out where it is called."""
    y = ca.MX.sym("y")
    long = ca.sqrt(y)
    for k in range(40):
        long = ca.sin(long) + 0.01 * k
    return ca.Function("long_root", [y], [long])(x)


def mapped_root(x):
    y = ca.MX.sym("y")
    return ca.sum2(ca.Function("root", [y], [long_root(y)]).map(2)(ca.horzcat(x, x)))


CALLED = {"call": long_root, "map": mapped_root}


@pytest.mark.parametrize("build", ["lanes", "narrow"])
@pytest.mark.parametrize("name", CALLED)
def test_of_what_is_called(name, build):
    """Slopes within functions that are called do not count either where the calls are not chosen."""
    called = CALLED[name]

    def body(u, s):
        return ca.if_else(u[0] > 0, called(u[0]), 0) + ca.if_else(u[1] > 0, called(u[1]), 0) + ca.sum1(u)

    kernel = bound(compiled(function_of(body, 2), build))
    points, step = np.array([[-1.0, 0.7], [0.3, -2.0], [0.2, 0.9]]), 1e-6
    values, gradients = kernel.evaluate(points, np.zeros((3, 0)))
    assert np.isfinite(values).all()
    for i in range(2):
        ends = [kernel.evaluate(points + k * step * np.eye(2)[i], np.zeros((3, 0)))[0] for k in (1, -1)]
        np.testing.assert_allclose(gradients[:, i], (ends[0] - ends[1]) / (2 * step), atol=1e-7)
