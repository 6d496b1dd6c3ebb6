"""Functions that call functions in compiled kernels: once, often, mapped, chosen by an index, with their own rules."""

from functools import partial

import casadi as ca
import numpy as np
import pytest
from compiled_functions import assert_agrees, bound, compiled, expected, function_of

from symgraph.compile import rules
from symgraph.compile.reading import INLINED

N = 4
SHAPES = [(5, 4), (3, 1), (1, 1)]  # of what is bound: a matrix w, a column q, a number b


def long_sx(name, n, m, length=INLINED, seed=0):
    """Scalar code of more than `length` instructions from a column (n) to one (m)."""
    rng = np.random.default_rng(seed)
    x = ca.SX.sym("x", n)
    y = ca.vertcat(*(ca.sin(ca.dot(ca.DM(rng.normal(size=n)), x)) for _ in range(m)))
    while ca.Function("f", [x], [y]).n_instructions() <= length:
        y = y + ca.sin(y + 0.3) * x[rng.integers(n)]
    return ca.Function(name, [x], [y])


def long_mx(name, n, m, seed=0, extra=()):
    """Matrix code of more than `INLINED` instructions, of a column (n) and further columns, to one (m)."""
    rng = np.random.default_rng(seed)
    x, more = ca.MX.sym("x", n), [ca.MX.sym(f"m{i}", size) for i, size in enumerate(extra)]
    y = ca.tanh(ca.DM(rng.normal(size=(m, n))) @ x)
    for part in more:
        y = y * ca.cos(ca.sum1(part)) + ca.sin(part[0] * y)
    while ca.Function("f", [x, *more], [y]).n_instructions() <= INLINED:
        y = ca.sin(ca.DM(rng.normal(size=(m, m))) @ y / m) + ca.DM(rng.normal(size=m)) * y
    return ca.Function(name, [x, *more], [y])


def of_columns(name, body, *sizes, **options):
    symbols = [ca.MX.sym(f"x{i}", size) for i, size in enumerate(sizes)]
    results = body(*symbols)
    return ca.Function(name, symbols, list(results) if isinstance(results, tuple) else [results], options)


SHORT_SX = long_sx("short", 4, 2, length=0)
LONG_SX = long_sx("long", 4, 2)
SCALAR_SX = long_sx("scalar", 1, 1)
LONG_MX = long_mx("long_mx", 4, 2)
LONG_MX_3 = long_mx("long_mx_3", 4, 2, extra=(5, 3))
NESTED = of_columns("nested", lambda x: LONG_MX(x) * LONG_SX(ca.sin(x)) + LONG_MX(2 * x), 4)
OUTER = of_columns("outer", lambda x, q: NESTED(x + q[0]) + NESTED(ca.cos(x)) * q[1], 4, 3)
SHIFT = of_columns("shift", lambda x, a: ca.sin(ca.reshape(ca.vertcat(x, x), 2, 4) @ a + 1), 4, 4)
TWO = of_columns("two", lambda x, q: (LONG_MX(x) * q[0], LONG_SX(x) + ca.sum1(q)), 4, 3)
EACH_SX = ca.Function("each", *(lambda x, y: ([x, y], [ca.sin(x * y) + x, x * y**2]))(ca.SX.sym("x"), ca.SX.sym("y")))
COLUMN_OF = ca.Function(
    "of", *(lambda x, y: ([x, y], [ca.vertcat(ca.sin(x * y), x, 3, y)]))(ca.SX.sym("x"), ca.SX.sym("y"))
)
EACH_COLUMN = of_columns("each_column", lambda x, q: LONG_MX(ca.vertcat(x, q[:2])) * q[2], 2, 3)

# Cases of an index, of very different lengths and tapes.
CASES = [
    of_columns("none", lambda x, q: ca.DM([1.0, 2.0]) * q[0], 4, 3),
    of_columns("little", lambda x, q: x[:2] * 2, 4, 3),
    of_columns("some", lambda x, q: ca.sin(x[:2] * q[1]) * ca.cos(x[2:]), 4, 3),
    of_columns("much", lambda x, q: LONG_MX(x * q[0]) + NESTED(ca.sin(x)), 4, 3),
]
WHICH = ca.Function.conditional("which", CASES[:-1], CASES[-1])
INSIDE = of_columns("inside", lambda k, x, q: WHICH(k, x, q) * LONG_MX(x) + WHICH(3 - k, ca.sin(x), q**2), 1, 4, 3)
INNER_WHICH = ca.Function.conditional("inner", [INSIDE, INSIDE], of_columns("o", lambda k, x, q: x[2:], 1, 4, 3))
ONE_CASE = ca.Function.conditional("one", CASES[:1], CASES[2])
SHORT_CASES = ca.Function.if_else("either", CASES[1], CASES[3])

UNFOLLOWED = of_columns(
    "unfollowed", lambda x, y: (ca.sin(x[:2]) * y[2:], x[2:] * y[:2]), 4, 4, is_diff_in=[True, False]
)
UNFOLLOWED_OUT = of_columns("out", lambda x: (ca.sin(x[:2]), ca.exp(x[2:])), 4, is_diff_out=[True, False])


W, X = ca.MX.sym("w", 5, 4), ca.MX.sym("x", 4)
DENSE = ca.Function("dense", [W, X], [long_mx("dense", 5, 5)(ca.tanh(W @ X))])
DENSE_TOO = ca.Function("dense_too", [W, X], [(W.T @ ca.cos(W @ X))[[0, 1, 2, 3, 0]]])


def with_row(w, x):
    changed = ca.MX(w)
    changed[1, :] = x.T
    return changed


def mapped(function, times, *args):
    return function.map(times)(*args)


# Name → what is done with a column x (4) that follows from actions, one of selections k (0 to 3), a bound matrix w
# (5, 4), a bound column q (3) and a bound number b (0 to 3).
CALLS = {
    "short, once": lambda x, k, w, q, b: SHORT_SX(x),
    "short, twice": lambda x, k, w, q, b: SHORT_SX(x) + SHORT_SX(ca.sin(x)),
    "long, twice": lambda x, k, w, q, b: LONG_SX(x) * LONG_SX(ca.sin(x)),
    "long, again with the same": lambda x, k, w, q, b: LONG_SX(x) * LONG_SX(x),
    "matrices": lambda x, k, w, q, b: LONG_MX(x) * LONG_MX(x**2),
    "several columns": lambda x, k, w, q, b: LONG_MX_3(x, w[:, 0], q) + LONG_MX_3(ca.sin(x), w @ x, x[:3] * q),
    "of what is bound": lambda x, k, w, q, b: LONG_MX(w[0, :].T) * LONG_MX(x) + LONG_SX(w[1, :].T),
    "of selections": lambda x, k, w, q, b: LONG_MX(ca.vertcat(k, q)) * LONG_MX(x) + LONG_MX(k * x),
    "of constants": lambda x, k, w, q, b: LONG_MX(ca.DM([1, 2, 3, 4])) * LONG_MX(x) + LONG_MX(ca.DM(4, 1)),
    "of equal constants": lambda x, k, w, q, b: SHIFT(x, ca.DM([2, 2, 2, 2])) + SHIFT(x, ca.DM.ones(4)),
    "nested": lambda x, k, w, q, b: NESTED(x) + OUTER(x, q) * OUTER(ca.sin(x), 2 * q),
    "two results": lambda x, k, w, q, b: ca.vertcat(*TWO(x, q)) * TWO(ca.sin(x), q)[0][0],
    "one of two results": lambda x, k, w, q, b: TWO(x, q)[1] + TWO(ca.sin(x), x[:3])[1],
    "results that are not used": lambda x, k, w, q, b: LONG_MX(x) + 0 * TWO(x, q)[0],
    "map of scalars": lambda x, k, w, q, b: ca.vertcat(*mapped(EACH_SX, 4, x.T, ca.sin(x).T)),
    "map of scalars that are bound": lambda x, k, w, q, b: ca.vertcat(*mapped(EACH_SX, 4, w[1, :], x.T)),
    "map of bound scalars alone": lambda x, k, w, q, b: ca.vertcat(*mapped(EACH_SX, 3, q.T, q.T + 1)),
    "map of scalars to columns": lambda x, k, w, q, b: mapped(COLUMN_OF, 4, x.T, w[1, :]),
    "map of long scalars": lambda x, k, w, q, b: mapped(SCALAR_SX, 4, x.T),
    "map of columns": lambda x, k, w, q, b: mapped(LONG_SX, 3, ca.horzcat(x, ca.sin(x), w[0, :].T)),
    "map of matrices": lambda x, k, w, q, b: mapped(LONG_MX, 5, x * w.T),
    "map of several": lambda x, k, w, q, b: mapped(EACH_COLUMN, 2, ca.reshape(x, 2, 2), ca.horzcat(q, x[1:])),
    "map with what is bound": lambda x, k, w, q, b: mapped(EACH_COLUMN, 2, ca.reshape(x, 2, 2), ca.horzcat(q, q**2)),
    "map that shares": lambda x, k, w, q, b: EACH_COLUMN.map("shared", "serial", 2, [1], [])(ca.reshape(x, 2, 2), q),
    "map that adds": lambda x, k, w, q, b: EACH_COLUMN.map("summed", "serial", 2, [1], [0])(ca.reshape(x, 2, 2), q),
    "map of nested": lambda x, k, w, q, b: mapped(NESTED, 2, ca.horzcat(x, w[2, :].T * x)),
    "map twice": lambda x, k, w, q, b: LONG_MX.map(2)(ca.horzcat(x, -x)) * LONG_MX.map(2)(ca.horzcat(x**2, x)),
    "mapaccum": lambda x, k, w, q, b: of_columns("a", lambda y, z: LONG_MX(ca.vertcat(y, z)) + y, 2, 2).mapaccum(3)(
        x[:2], ca.horzcat(x[2:], q[:2], x[1:3])
    ),
    "fold": lambda x, k, w, q, b: of_columns("a", lambda y, z: LONG_MX(ca.vertcat(y, z)), 2, 2).fold(4)(
        x[:2], ca.horzcat(x[2:], q[:2], x[1:3], x[:2])
    ),
    "switch": lambda x, k, w, q, b: WHICH(k, x, q),
    "switch, twice": lambda x, k, w, q, b: WHICH(k, x, q) * WHICH(3 - k, ca.sin(x), x[:3]),
    "switch beyond its cases": lambda x, k, w, q, b: WHICH(k - 2, x, q) + WHICH(7 * k, x, q),
    "switch by what is bound": lambda x, k, w, q, b: WHICH(b, x, q) + WHICH(b - 1, x, q),
    "switch of what is bound": lambda x, k, w, q, b: WHICH(b, w[0, :].T, q) + WHICH(k, w[1, :].T, q) * x[0],
    "switch by actions": lambda x, k, w, q, b: WHICH(ca.floor(2 + 2 * x[0]), x, q),
    "switch of a constant": lambda x, k, w, q, b: WHICH(2, x, q) + WHICH(0, x, x[1:]),
    "switch inside": lambda x, k, w, q, b: INSIDE(k, x, q) + INSIDE(b, ca.sin(x), x[:3]),
    "switch inside a switch": lambda x, k, w, q, b: INNER_WHICH(k, k, x, q),
    "switch of one case": lambda x, k, w, q, b: ONE_CASE(k, x, q),
    "switch of two": lambda x, k, w, q, b: SHORT_CASES(k > 1, x, q),
    "map of a switch": lambda x, k, w, q, b: mapped(
        WHICH, 2, ca.repmat(k, 1, 2), ca.horzcat(x, x**2), ca.horzcat(q, q)
    ),
    "input that is not followed": lambda x, k, w, q, b: ca.vertcat(*UNFOLLOWED(x, x)) * UNFOLLOWED(x[::-1], x**2)[0][0],
    "output that is not followed": lambda x, k, w, q, b: ca.vertcat(*UNFOLLOWED_OUT(x)) * UNFOLLOWED_OUT(2 * x)[1][0],
}

# The same with what is bound used in many ways.
BOUND = {
    "as it is": lambda x, k, w, q, b: w @ x,
    "transposed": lambda x, k, w, q, b: w.T @ (w @ x),
    "squared": lambda x, k, w, q, b: w**2 @ x**2 + (w**2) @ ca.DM.ones(4),
    "squared and transposed": lambda x, k, w, q, b: (w.T**2) @ (w @ x) ** 2 + (w**2).T @ (w @ x),
    "gathered": lambda x, k, w, q, b: ca.vertcat(w[[0, 2, 2], :] @ x, w[::2, 1:3] @ x[1:3]),
    "computed": lambda x, k, w, q, b: (ca.sin(w) @ ca.exp(-(w.T))) @ (w @ x) * ca.sumsqr(q),
    "many columns": lambda x, k, w, q, b: w @ ca.horzcat(*(ca.sin(i * x) for i in range(7))),
    "from the right": lambda x, k, w, q, b: ca.reshape(ca.vertcat(x, x**2, x**3), 3, 4) @ w.T,
    "in a call": lambda x, k, w, q, b: DENSE(w, x) * DENSE(w**2, ca.sin(x)) + DENSE(w, x[::-1]),
    "in a call of what is not": lambda x, k, w, q, b: DENSE(w, x) + DENSE(w * x[0], x),
    "in a map": lambda x, k, w, q, b: ca.sum2(mapped(DENSE, 2, ca.horzcat(w, w[::-1, :]), ca.horzcat(x, x**2))),
    "shared in a map": lambda x, k, w, q, b: DENSE.map("s", "serial", 2, [0], [])(w, ca.horzcat(x, x**2)),
    "in a switch": lambda x, k, w, q, b: ca.Function.conditional("d", [DENSE, DENSE_TOO], DENSE)(k, w, x),
    "divided by": lambda x, k, w, q, b: x / (3 + q[0]) + (2 + x) / (3 + w[0, :].T) + x[0] / (2 + x[1]) / (2 + x[1]),
    "set": lambda x, k, w, q, b: with_row(w, x) @ x,
}
ALL = {f"call: {name}": case for name, case in CALLS.items()} | {f"bound: {name}": case for name, case in BOUND.items()}


def curved(case, u, s, w, q, b):
    """A curved sum of what a case comes to."""
    mixed = ca.DM(np.random.default_rng(7).normal(size=(N, N)) / 2) @ u
    result = ca.vec(ca.densify(ALL[case](ca.sin(mixed + 0.3), s[0], w, q, b)))
    factors = ca.DM(np.random.default_rng(result.numel()).normal(size=result.numel()))
    return ca.dot(factors, ca.sin(result) + 0.1 * result**2)


def assert_case_agrees(kernel, case, more=()):
    rng = np.random.default_rng(len(case))
    points, selections = rng.uniform(-1, 1, (11, N)), rng.integers(0, 4, (11, 1)).astype(float)
    shared = [rng.normal(size=(5, 4)), rng.normal(size=3), 2.0]
    wanted = expected(function_of(partial(curved, case), N, 1, SHAPES), points, selections, shared)
    assert_agrees(bound(kernel, [*shared, *more]).evaluate(points, selections), wanted)
    assert np.abs(wanted[1]).max() > 1e-3 or case == "call: map of bound scalars alone"


@pytest.fixture(scope="module", params=["lanes", "narrow"])
def together(request):
    """All cases in one function, times weights that pick one."""

    def body(u, s, w, q, b, weights):
        return ca.dot(weights, ca.vertcat(*(curved(case, u, s, w, q, b) for case in ALL)))

    return compiled(function_of(body, N, 1, [*SHAPES, (len(ALL), 1)]), request.param)


@pytest.mark.parametrize("case", ALL)
def test_as_casadi_has_it(together, case):
    assert_case_agrees(together, case, [np.eye(len(ALL))[list(ALL).index(case)]])


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL)
def test_alone(case):
    """Where a function is called once it is written out there."""
    assert_case_agrees(compiled(function_of(partial(curved, case), N, 1, SHAPES)), case)


# Rules of their own


@pytest.fixture
def ruled(monkeypatch):
    """A function x, y → x² y, sin(x y) with a rule that is wrong on purpose, so that its use is seen."""
    monkeypatch.setattr(rules, "_ADJOINTS", dict(rules._ADJOINTS))
    x, y, z, t, dz, dt = (ca.SX.sym(name) for name in ("x", "y", "z", "t", "dz", "dt"))
    function = ca.Function("ruled", [x, y], [x**2 * y, ca.sin(x * y)])
    rules.set_adjoint(function, ca.Function("adjoint", [x, y, z, t, dz, dt], [3 * z * dz + t * dt, x + dz + 10 * dt]))
    return function


def test_a_rule_is_used_instead_of_the_slope(ruled):
    def body(u, s, p):
        return ca.dot(ca.DM([2, 7]), ca.vertcat(*ruled(u[0], u[1] + p)))

    x, y, p = 0.5, 0.25, 1.0
    for build in ("lanes", "narrow"):
        kernel = bound(compiled(function_of(body, 2, 0, [(1, 1)]), build), [p])
        values, gradients = kernel.evaluate(np.array([[x, y]] * 3), np.zeros((3, 0)))
        z, t = x**2 * (y + p), np.sin(x * (y + p))
        np.testing.assert_allclose(values, 2 * z + 7 * t, rtol=1e-14)
        np.testing.assert_allclose(gradients, [[3 * z * 2 + t * 7, x + 2 + 70]] * 3, rtol=1e-14)


def test_a_rule_is_used_for_each_number_of_a_map(ruled):
    def body(u, s, p):
        return ca.dot(ca.DM([1, 2, 3, 4, 5, 6]).T, ca.horzcat(*ruled.map(3)(u.T, p.T)))

    u, p = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    kernel = bound(compiled(function_of(body, 3, 0, [(3, 1)])), [p])
    _, gradients = kernel.evaluate(np.array([u, u]), np.zeros((2, 0)))
    wanted = 3 * u**2 * p * [1, 2, 3] + np.sin(u * p) * [4, 5, 6]
    np.testing.assert_allclose(gradients, [wanted, wanted], rtol=1e-14)


def test_a_rule_is_used_within_functions_that_are_called(ruled):
    def body(u, s):
        x = ca.MX.sym("x", 2)
        inner = ca.Function("inner", [x], [long_mx("l", 2, 2)(ca.vertcat(*ruled(x[0], x[1])))])
        return ca.sum1(inner(u) + inner(u))

    z, outer = ca.MX.sym("z", 2), long_mx("l", 2, 2)
    slope = ca.Function("slope", [z], [ca.gradient(2 * ca.sum1(outer(z)), z)])
    u = np.array([0.3, 0.7])
    z, t = u[0] ** 2 * u[1], np.sin(u[0] * u[1])
    dz, dt = slope([z, t]).full().ravel()
    _, gradients = bound(compiled(function_of(body, 2))).evaluate(np.array([u, u]), np.zeros((2, 0)))
    np.testing.assert_allclose(gradients, [[3 * z * dz + t * dt, u[0] + dz + 10 * dt]] * 2, rtol=1e-13)


def test_of_what_is_bound_nothing_is_asked_of_a_rule(ruled):
    function = function_of(lambda u, s, p: u[0] * ruled(p, p)[0], 1, 0, [(1, 1)])
    values, gradients = bound(compiled(function), [2.0]).evaluate(np.array([[3.0], [4.0]]), np.zeros((2, 0)))
    assert values.tolist() == [24, 32]
    assert gradients.tolist() == [[8], [8]]


def test_casadis_own_derivative_stays_what_it_was(ruled):
    x = ca.SX.sym("x")
    assert float(ca.Function("f", [x], [ca.gradient(ruled(x, 3)[0], x)])(2.0)) == 12


# What calls nothing


@pytest.mark.parametrize("n", [0, 3])
def test_functions_of_nothing_much(n):
    bodies = {
        "a constant": lambda u, s: ca.MX(4.0),
        "selections": lambda u, s: s[0] * 2 + s[1],
        "a sum": lambda u, s: ca.sum1(u) + s[1],
    }
    points, selections = np.random.default_rng(0).normal(size=(5, n)), np.eye(2)[[0, 1, 1, 0, 0]]
    for body in bodies.values():
        function = function_of(body, n, 2)
        got = bound(compiled(function)).evaluate(points, selections)
        assert_agrees(got, expected(function, points, selections))
