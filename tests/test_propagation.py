"""Rules for plain functions, where the moments are known in closed form."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import assert_close

from symgraph.propagation import RULES


def moments(rule, function, inputs, kind=ca.SX):
    """Mean (m,) and covariance (m, m) of function(**inputs); inputs: label -> (mean, covariance or None)."""
    x = {label: kind.sym(label, np.size(mean)) for label, (mean, _) in inputs.items()}
    uncertain = {label: np.atleast_2d(c) for label, (_, c) in inputs.items() if c is not None}
    sigma = {label: kind.sym(f"{label}_cov", *c.shape) for label, c in uncertain.items()}
    results = RULES[rule](ca.densify(kind(function(**x))), x, sigma)
    evaluated = ca.Function("f", [*x.values(), *sigma.values()], list(results)).call(
        [ca.DM(mean) for mean, _ in inputs.values()] + [ca.DM(c) for c in uncertain.values()]
    )
    return np.array(evaluated[0]).ravel(), np.array(evaluated[1])


def random_covariance(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("rule", ["linear", "second-order"])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_affine_functions_are_exact(rule, kind, seed):
    """y = Ax + Bz + c: N(A m + B k + c, A S A' + B T B') where x and z are independent."""
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(2, 3)), rng.normal(size=(2, 2)), rng.normal(size=2)
    m, k, s, t = rng.normal(size=3), rng.normal(size=2), random_covariance(rng, 3), random_covariance(rng, 2)
    mean, covariance = moments(
        rule, lambda x, z: ca.DM(a) @ x + ca.DM(b) @ z + ca.DM(c), {"x": (m, s), "z": (k, t)}, kind
    )
    assert_close(mean, a @ m + b @ k + c)
    assert_close(covariance, a @ s @ a.T + b @ t @ b.T)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_second_order_mean_of_a_quadratic_is_exact(seed):
    """E[x'Qx + q'x] = m'Qm + q'm + tr(QS)."""
    rng = np.random.default_rng(seed)
    q, root, m, s = rng.normal(size=3), rng.normal(size=(3, 3)), rng.normal(size=3), random_covariance(rng, 3)
    quadratic = root + root.T
    mean, _ = moments("second-order", lambda x: x.T @ ca.DM(quadratic) @ x + ca.DM(q).T @ x, {"x": (m, s)})
    assert_close(mean, m @ quadratic @ m + q @ m + np.trace(quadratic @ s), 1e-11)


def test_second_order_mean_of_a_cubic_is_exact():
    """E[x^3] = m^3 + 3 m s."""
    mean, _ = moments("second-order", lambda x: x**3, {"x": (1.5, 0.4)})
    assert_close(mean, 1.5**3 + 3 * 1.5 * 0.4)


def test_each_output_has_its_own_curvature():
    mean, _ = moments("second-order", lambda x: ca.vertcat(x**2, 3 * x, x**3), {"x": (2.0, 0.5)})
    assert_close(mean, [4.5, 6.0, 11.0])


def test_product_of_independent_slots_has_no_curvature():
    """E[xz] = E[x] E[z]."""
    mean, covariance = moments("second-order", lambda x, z: x * z, {"x": (2.0, 0.5), "z": (3.0, 0.1)})
    assert_close(mean, 6.0)
    assert_close(covariance, 9 * 0.5 + 4 * 0.1)


@pytest.mark.parametrize("rule", RULES)
def test_exact_inputs_leave_an_exact_output(rule):
    x = ca.SX.sym("x", 2)
    mean, covariance = RULES[rule](ca.vertcat(x[0] * x[1], ca.sin(x[0]), 1), {"x": x}, {})
    assert ca.Function("f", [x], [covariance]).nnz_out(0) == 0
    assert_close(np.array(ca.Function("f", [x], [mean])([2, 3])).ravel(), [6, np.sin(2), 1])


def test_mean_ignores_the_spread():
    mean, covariance = moments("mean", lambda x: x**2, {"x": (3.0, 0.7)})
    assert_close(mean, 9)
    assert_close(covariance, [[0]])


@pytest.mark.parametrize("rule", RULES)
def test_variance_zero_is_the_plain_function(rule):
    mean, covariance = moments(rule, lambda x: ca.exp(x), {"x": (0.3, 0.0)})
    assert_close(mean, np.exp(0.3))
    assert_close(covariance, [[0]])


@pytest.mark.parametrize("rule", ["linear", "second-order"])
def test_small_variances_agree_with_sampling(rule):
    """The rule's error is of the order of the variance squared; that of sampling 3 sd / sqrt(10^6)."""
    rng = np.random.default_rng(0)
    m, s = 0.4, 1e-3
    samples = np.exp(m + np.sqrt(s) * rng.standard_normal(10**6))
    mean, covariance = moments(rule, lambda x: ca.exp(x), {"x": (m, s)})
    curvature = 0 if rule == "second-order" else 0.5 * np.exp(m) * s
    assert abs(mean[0] + curvature - samples.mean()) < 3 * samples.std() / 1e3 + s**2
    assert covariance[0, 0] == pytest.approx(samples.var(), rel=0.01)
