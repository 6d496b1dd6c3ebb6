"""Every operation on matrices of CasADi in compiled kernels, values and gradients, among curved functions."""

from functools import partial

import casadi as ca
import numpy as np
import pytest
from compiled_functions import assert_agrees, bound, code_for, compiled, expected, function_of

ROWS, COLUMNS = 3, 4
N = ROWS * COLUMNS
LOWER = ca.Sparsity.lower(3)
KEPT = ca.Sparsity.triplet(3, 4, [0, 2, 1, 0, 2], [0, 0, 1, 3, 3])
FIXED = ca.DM(np.random.default_rng(5).normal(size=(4, 3)).round(2))
GRID = np.linspace(-2.0, 2.0, 9)
TABLE = np.sin(np.add.outer(GRID, 0.5 * GRID**2)).ravel(order="F")
LINEAR = ca.interpolant("linear", "linear", [GRID, GRID], TABLE)
SPLINE = ca.interpolant("spline", "bspline", [GRID, GRID], TABLE)


def with_part(x, where, part):
    """A copy with some of its numbers replaced."""
    copy = ca.MX(x)
    copy[where] = part
    return copy


def with_numbers(x, where, numbers):
    copy = ca.MX(x)
    copy.nz[where] = numbers
    return copy


def regular(x):
    """A square matrix (3, 3) that can be inverted well."""
    return x[:, :3] + 3 * ca.MX.eye(3)


def lower(x):
    return ca.project(x[:, :3], LOWER)


def kept(x):
    return ca.project(x, KEPT)


def gradient_of(make, at):
    """CasADi's own gradient, written out in the function."""
    z = ca.MX.sym("z", *at.shape)
    return ca.substitute(ca.gradient(make(z), z), z, at)


# Name → what is done with matrices x (3, 4), y (3, 4) and a column v (6) that follow from actions, a bound matrix
# p (4, 3), a bound column q (3), and numbers from 0 to 3: k from selections, b bound.
CASES = {
    # parts
    "slice": lambda x, y, v, p, q, k, b: x[1:3, ::2],
    "slice from behind": lambda x, y, v, p, q, k, b: v[::-2],
    "row": lambda x, y, v, p, q, k, b: x[-1, :],
    "rows and columns": lambda x, y, v, p, q, k, b: x[[0, 2], [3, 1, 1]],
    "numbers, some twice": lambda x, y, v, p, q, k, b: v[[0, 3, 3, 5, 0]],
    "number among others": lambda x, y, v, p, q, k, b: ca.sin(v) * ca.cos(v)[4],
    "numbers among others": lambda x, y, v, p, q, k, b: (
        ca.sin(x) * ca.tanh(x)[2, 1] + ca.exp(x) / (3 + ca.cos(x)[0, 0])
    ),
    "part of what is sparse": lambda x, y, v, p, q, k, b: lower(x)[1:, :2],
    "part of what is bound": lambda x, y, v, p, q, k, b: p[1::2, :] @ x @ p[:, [2, 2, 0]],
    "set": lambda x, y, v, p, q, k, b: with_part(x, (slice(0, 2), 1), v[:2]),
    "set row": lambda x, y, v, p, q, k, b: with_part(x, (1, slice(None)), 3.0),
    "set what was set": lambda x, y, v, p, q, k, b: with_part(with_part(x, (0, 0), v[0]), (slice(0, 2), 0), v[1:3]),
    "set rows and columns": lambda x, y, v, p, q, k, b: with_part(x, ([0, 2], [1, 3]), y[:2, :2]),
    "set in what is bound": lambda x, y, v, p, q, k, b: with_part(p, (slice(1, 3), 0), v[2:4]) @ x,
    "set what is bound": lambda x, y, v, p, q, k, b: with_part(x, (slice(None), 0), q),
    "set by number": lambda x, y, v, p, q, k, b: with_numbers(v, [4, 1], x[:2, 0]),
    "add": lambda x, y, v, p, q, k, b: gradient_of(lambda z: ca.sumsqr(ca.sin(z[[0, 3, 3, 5]])) * z[1], v),
    "add slice": lambda x, y, v, p, q, k, b: gradient_of(
        lambda z: ca.sumsqr(ca.sin(z[1:5:2])) + ca.sumsqr(z[:4] ** 2), v
    ),
    "add part": lambda x, y, v, p, q, k, b: gradient_of(lambda z: ca.sumsqr(z[:2, 1:] ** 3 * y[1:, 1:]), x),
    # zeros
    "project": lambda x, y, v, p, q, k, b: lower(x),
    "project on more": lambda x, y, v, p, q, k, b: ca.project(lower(x), ca.Sparsity.banded(3, 1)),
    "densify": lambda x, y, v, p, q, k, b: ca.densify(kept(x)) + y,
    "sum of sparse ones": lambda x, y, v, p, q, k, b: kept(x) + ca.sin(kept(y)) * kept(x) - y,
    "sparse times number": lambda x, y, v, p, q, k, b: lower(x) * v[0] + ca.cos(lower(y)),
    "diagonal": lambda x, y, v, p, q, k, b: ca.diag(ca.diag(x[:, :3])) + ca.diag(v[:3]),
    "triangles": lambda x, y, v, p, q, k, b: ca.tril2symm(lower(x)) + ca.triu(y[:, 1:]),
    # shapes
    "transpose": lambda x, y, v, p, q, k, b: x.T + p @ ca.diag(q),
    "sparse transpose": lambda x, y, v, p, q, k, b: kept(x).T + 2 * p,
    "reshape": lambda x, y, v, p, q, k, b: ca.reshape(x, 2, 6) * ca.horzcat(v, v**2).T,
    "sparse reshape": lambda x, y, v, p, q, k, b: ca.reshape(kept(x), 6, 2),
    "vertcat": lambda x, y, v, p, q, k, b: ca.vertcat(x, y, p.T, 7 * x[:1, :]),
    "horzcat": lambda x, y, v, p, q, k, b: ca.horzcat(x, q, v[:3], x, kept(y)),
    "diagcat": lambda x, y, v, p, q, k, b: ca.diagcat(x, v[0], lower(y)),
    "blockcat": lambda x, y, v, p, q, k, b: ca.blockcat([[x, y], [ca.sin(y), lower(x) @ y]]),
    "vertsplit": lambda x, y, v, p, q, k, b: ca.vertsplit(x, [0, 1, 3])[1] * ca.vertsplit(y, [0, 2, 3])[0],
    "horzsplit": lambda x, y, v, p, q, k, b: ca.horzsplit(x, [0, 1, 4])[1] @ ca.horzsplit(y.T, [0, 1, 3])[1][1:, :],
    "diagsplit": lambda x, y, v, p, q, k, b: ca.diagsplit(ca.diagcat(lower(x), y), [0, 3, 6], [0, 3, 7])[0],
    "split of what is sparse": lambda x, y, v, p, q, k, b: ca.horzsplit(kept(x), [0, 2, 4])[1],
    "repmat": lambda x, y, v, p, q, k, b: ca.repmat(x, 2, 3),
    "repmat of what is sparse": lambda x, y, v, p, q, k, b: ca.repmat(lower(x), 1, 3),
    "repsum": lambda x, y, v, p, q, k, b: ca.repsum(ca.horzcat(x, y**2), 1, 2),
    # sums and products
    "sums": lambda x, y, v, p, q, k, b: ca.sum1(x) + ca.sum1(ca.sum2(y)) * ca.sum2(p).T,
    "cumsum": lambda x, y, v, p, q, k, b: ca.cumsum(v),
    "dot": lambda x, y, v, p, q, k, b: ca.dot(x, y) * ca.dot(p, x.T) * ca.dot(v, v),
    "dot of what is sparse": lambda x, y, v, p, q, k, b: ca.dot(kept(x), y),
    "bilin": lambda x, y, v, p, q, k, b: ca.bilin(x, v[:3], v[2:]) * ca.bilin(p, y[0, :], q),
    "bilin of what is sparse": lambda x, y, v, p, q, k, b: ca.bilin(kept(x), v[:3], v[2:]),
    "rank1": lambda x, y, v, p, q, k, b: ca.rank1(x, v[0], v[1:4], y[0, :].T),
    "rank1 on what is sparse": lambda x, y, v, p, q, k, b: ca.rank1(kept(x), v[0], v[1:4], y[0, :].T),
    "sumsqr": lambda x, y, v, p, q, k, b: ca.sumsqr(x) * ca.sumsqr(p),
    "norms": lambda x, y, v, p, q, k, b: ca.vertcat(ca.norm_1(v), ca.norm_2(v), ca.norm_fro(x), ca.norm_inf(v)),
    "product": lambda x, y, v, p, q, k, b: x @ y.T,
    "bound factor left": lambda x, y, v, p, q, k, b: p @ x,
    "bound factor right": lambda x, y, v, p, q, k, b: x @ p,
    "products with a column": lambda x, y, v, p, q, k, b: ca.vertcat(p @ v[:3], p.T @ v[2:], x.T @ q, (q.T @ y).T),
    "fixed factor": lambda x, y, v, p, q, k, b: FIXED @ x + (x @ FIXED)[0, 1],
    "bound product": lambda x, y, v, p, q, k, b: (p @ p.T) @ x.T + ca.sin(p @ q),
    "sparse factor left": lambda x, y, v, p, q, k, b: lower(x) @ y,
    "sparse factor right": lambda x, y, v, p, q, k, b: x.T @ lower(y),
    "sparse factors": lambda x, y, v, p, q, k, b: lower(x) @ kept(y),
    "mac": lambda x, y, v, p, q, k, b: ca.mac(x, p, y[:, :3]),
    "mac on what is sparse": lambda x, y, v, p, q, k, b: ca.mac(x, p, lower(y)),
    "power": lambda x, y, v, p, q, k, b: ca.mpower(x[:, :3] / 2, 3),
    "kron": lambda x, y, v, p, q, k, b: ca.kron(x[:2, :2], y) + ca.kron(ca.kron(v[:2], q.T), p[:1, :2]).shape[0],
    "cross": lambda x, y, v, p, q, k, b: ca.cross(v[:3], v[3:]) + ca.skew(q) @ v[1:4],
    "trace": lambda x, y, v, p, q, k, b: ca.trace(x @ p) * x[:2, :],
    "einstein": lambda x, y, v, p, q, k, b: ca.einstein(
        ca.vec(x), ca.vec(p), [3, 4], [4, 3], [3, 3], [-1, -2], [-2, -3], [-1, -3]
    ),
    # systems of equations
    "solve": lambda x, y, v, p, q, k, b: ca.solve(regular(x), y),
    "solve with what is bound": lambda x, y, v, p, q, k, b: ca.solve(ca.DM.eye(3) * 3 + p[:3, :], v[:3]),
    "solve for what is bound": lambda x, y, v, p, q, k, b: ca.solve(regular(x).T, q),
    "solve triangle": lambda x, y, v, p, q, k, b: ca.solve(lower(x) + 3 * ca.MX.eye(3), v[:3]),
    "det": lambda x, y, v, p, q, k, b: ca.det(regular(x)),
    "inverse": lambda x, y, v, p, q, k, b: ca.inv(regular(x)) @ y,
    # extrema and choices
    "logsumexp": lambda x, y, v, p, q, k, b: ca.logsumexp(v) * v,
    "mmax": lambda x, y, v, p, q, k, b: ca.mmax(v) * x,
    "mmin": lambda x, y, v, p, q, k, b: ca.mmin(x) ** 2 * v,
    "if_else": lambda x, y, v, p, q, k, b: ca.if_else(v[0] > v[1], x, y),
    "if_else of selections": lambda x, y, v, p, q, k, b: ca.if_else(k > 1, x, y),
    "if_else of what is bound": lambda x, y, v, p, q, k, b: ca.if_else(b > 1, x * v[0], y),
    "fmax": lambda x, y, v, p, q, k, b: ca.fmax(x, y) * ca.fmin(x, 0.1) + ca.fmax(p.T, x),
    # numbers of an index
    "number of selections": lambda x, y, v, p, q, k, b: v.nz[k] * v,
    "numbers of selections": lambda x, y, v, p, q, k, b: v.nz[ca.vertcat(k, k + 1, k)],
    "bound number": lambda x, y, v, p, q, k, b: x[:, b],
    "number of actions": lambda x, y, v, p, q, k, b: v.nz[ca.floor(3 + v[0])] * v,
    "number of what is bound": lambda x, y, v, p, q, k, b: ca.sin(p).nz[ca.vertcat(k, ca.floor(3 + v[0]))] * v[1],
    "set number of selections": lambda x, y, v, p, q, k, b: with_numbers(v, k, x[0, 0]),
    "set bound number": lambda x, y, v, p, q, k, b: with_numbers(v, b, x[0, 0] ** 2),
    "set number of actions": lambda x, y, v, p, q, k, b: with_numbers(v, ca.floor(3 + v[0]), x[0, 0] ** 2),
    # tables
    "linear table": lambda x, y, v, p, q, k, b: LINEAR(v[:2]) * v,
    "spline": lambda x, y, v, p, q, k, b: SPLINE(v[:2]) * x,
    "spline of what is bound": lambda x, y, v, p, q, k, b: SPLINE(q[:2] / 3) * x + SPLINE(ca.vertcat(q[0] / 3, v[0])),
    "place in a table": lambda x, y, v, p, q, k, b: ca.low(ca.MX(ca.DM(GRID)), v[0]) * v,
    # others
    "assertion": lambda x, y, v, p, q, k, b: x.attachAssert(v[0] < 1e3, "too much"),
    "constants": lambda x, y, v, p, q, k, b: ca.MX(ca.DM(LOWER, range(6))) @ y + 0 * x + ca.MX.ones(3, 4),
    "a constant alone": lambda x, y, v, p, q, k, b: ca.MX(ca.DM([1.0, 2.0])),
    "what is bound alone": lambda x, y, v, p, q, k, b: p @ q,
    "selections alone": lambda x, y, v, p, q, k, b: ca.sin(k) * ca.DM([1.0, 2.0]),
}


def inner(u, p, q):
    """Curved columns x, y, v of actions and what is bound."""
    rng = np.random.default_rng(7)
    mixed = [ca.DM(rng.normal(size=(size, N)) / 3) @ u + ca.DM(rng.normal(size=size)) / 3 for size in (N, N, 6)]
    x, y = (ca.reshape(mixed[i], ROWS, COLUMNS) for i in (0, 1))
    return ca.sin(x) + 0.1 * p.T, ca.tanh(y) * x, ca.sin(mixed[2]) + 0.1 * ca.vertcat(q, q**2)


SHAPES = [(4, 3), (3, 1), (1, 1)]  # of p, q and b


def curved(case, u, s, p, q, b):
    """A curved sum of what a case comes to."""
    result = ca.vec(ca.densify(CASES[case](*inner(u, p, q), p, q, s[0], b)))
    factors = ca.DM(np.random.default_rng(result.numel()).normal(size=result.numel()))
    return ca.dot(factors, ca.sin(result) + 0.1 * result**2)


@pytest.fixture(scope="module", params=["lanes", "narrow", pytest.param("any processor", marks=pytest.mark.slow)])
def kernel(request):
    """All cases in one function, times weights that pick one."""

    def body(u, s, p, q, b, weights):
        return ca.dot(weights, ca.vertcat(*(curved(case, u, s, p, q, b) for case in CASES)))

    function = function_of(body, N, 1, [*SHAPES, (len(CASES), 1)])
    if request.param != "any processor":
        return compiled(function, request.param)
    with code_for(request.param):
        return compiled(function)


@pytest.mark.parametrize("case", CASES)
def test_as_casadi_has_it(kernel, case):
    rng = np.random.default_rng(len(case))
    points = rng.uniform(-1, 1, (11, N))
    selections = rng.integers(0, 4, (11, 1)).astype(float)
    picked = np.eye(len(CASES))[list(CASES).index(case)]
    shared = [rng.normal(size=(4, 3)), rng.normal(size=3), 2.0]
    wanted = expected(function_of(partial(curved, case), N, 1, SHAPES), points, selections, shared)
    got = bound(kernel, [*shared, picked]).evaluate(points, selections)
    assert_agrees(got, wanted)
    assert case.endswith(("alone", "constants")) or np.abs(wanted[1]).max() > 1e-3


def test_an_assertion_that_is_not_met_is_not_a_number():
    function = function_of(lambda u, s: ca.sumsqr(u).attachAssert(u[0] < 0.5, "too much"), 2)
    for build in ("lanes", "narrow"):
        values, gradients = bound(compiled(function, build)).evaluate(
            np.array([[0.2, 3.0], [0.7, 3.0], [0.4, 1.0]]), np.zeros((3, 0))
        )
        np.testing.assert_allclose(values, [9.04, np.nan, 1.16])
        np.testing.assert_allclose(gradients[[0, 2]], [[0.4, 6.0], [0.8, 2.0]])


def test_norms_and_roots_have_no_slope_at_zero():
    function = function_of(lambda u, s: ca.norm_2(u) + ca.sqrt(ca.sumsqr(u)), 2)
    values, gradients = bound(compiled(function)).evaluate(np.zeros((2, 2)), np.zeros((2, 0)))
    assert values.tolist() == [0, 0]
    assert not np.isfinite(gradients).any()
