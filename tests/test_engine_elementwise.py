"""Every elementwise operation of CasADi in compiled kernels: values and slopes, at kinks, poles and beyond them too."""

import casadi as ca
import numpy as np
import pytest
import scipy.special
from compiled_functions import PROCESSORS, bound, code_for, compiled

from symgraph.compile.elementwise import ELEMENTWISE

CODES = {name: getattr(ca, name) for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) in ELEMENTWISE}
BINARY = (
    *("OP_ADD", "OP_SUB", "OP_MUL", "OP_DIV", "OP_POW", "OP_CONSTPOW", "OP_ATAN2", "OP_HYPOT", "OP_FMOD"),
    *("OP_REMAINDER", "OP_COPYSIGN", "OP_FMIN", "OP_FMAX", "OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_AND", "OP_OR"),
    "OP_IF_ELSE_ZERO",
)
BUILDS = [
    *((build, single, "this processor") for build in ("lanes", "narrow") for single in (False, True)),
    *(("lanes", single, other) for single in (False, True) for other in PROCESSORS if other != "this processor"),
]

# All of them are the same in single precision.
NUMBERS = [0.0, 2.0**-30, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 20.0, 100.0, 4096.0, 2.0**60, np.inf]
NUMBERS = np.array([*NUMBERS, *(-x for x in NUMBERS), np.nan])


def applied(name, x, y):
    return ca.SX.binary(CODES[name], x, y) if name in BINARY else ca.SX.unary(CODES[name], x)


@pytest.fixture(scope="module", params=BUILDS, ids=lambda p: f"{p[0]}, {('double', 'single')[p[1]]}, {p[2]}")
def operations(request):
    """A kernel of u (2) in which s says which operation is done."""
    build, single, processor = request.param
    x = ca.SX.sym("x", 2)
    cases = [ca.Function(name, [x], [ca.densify(applied(name, x[0], x[1]))]) for name in CODES]
    u, s = ca.MX.sym("u", 2), ca.MX.sym("s")
    function = ca.Function("operations", [u, s], [ca.Function.conditional("which", cases[:-1], cases[-1])(s, u)])
    with code_for(processor):
        kernel = compiled(function, build, single)
    return bound(kernel), single


def test_all_are_here():
    assert len(set(CODES.values())) == len(ELEMENTWISE)


def points_of(name):
    if name not in BINARY:
        return np.stack([NUMBERS, np.zeros(NUMBERS.size)], 1)
    first = [0.0, 1.0, np.nan] if name == "OP_IF_ELSE_ZERO" else NUMBERS  # conditions are 0 or 1
    return np.array([(x, y) for x in first for y in NUMBERS])


@pytest.mark.parametrize("name", CODES)
def test_as_casadi_has_it(operations, name):
    kernel, single = operations
    points = points_of(name)
    values, gradients = kernel.evaluate(points, np.full((len(points), 1), float(list(CODES).index(name))))
    x = ca.SX.sym("x", 2)
    y = applied(name, x[0], x[1])
    reference = ca.Function("reference", [x], [ca.densify(ca.vertcat(y, ca.gradient(y, x)))]).map(len(points))
    wanted = reference(points.T).full().T
    if name == "OP_ERFINV":  # CasADi's own is good to 1e-10
        y = scipy.special.erfinv(points[:, 0])
        wanted[:, 0], wanted[:, 1] = y, np.sqrt(np.pi) / 2 * np.exp(y**2)
    got = np.column_stack([values, gradients])
    finite = np.isfinite(wanted)
    if single:  # what single precision holds; and there y - 1 may be a whole number where y is none
        finite &= (np.abs(wanted) < 1e30) & ((np.abs(wanted) > 1e-30) | (wanted == 0.0))
        wrong = np.isfinite(got).all(axis=1) & ~np.isfinite(wanted).all(axis=1)
    else:
        wrong = (np.isfinite(got) & ~np.isfinite(wanted)).any(axis=1)
    wrong |= (~np.isfinite(got) & finite).any(axis=1)
    assert not wrong.any(), np.column_stack([points, got, wanted])[wrong]
    np.testing.assert_allclose(got[finite], wanted[finite], rtol=1e-5 if single else 1e-13, atol=0)
