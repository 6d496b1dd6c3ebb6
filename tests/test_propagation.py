"""Rules for plain functions, where the moments are known in closed form."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from small_tasks import assert_close, refuses

import symgraph as sg
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


# Rules of points


def normal_moments(m, v, most):
    """E[x^k], k = 0 … most, of N(m, v): E[x^k] = m E[x^(k-1)] + (k - 1) v E[x^(k-2)]."""
    found = [1.0, m]
    for k in range(2, most + 1):
        found.append(m * found[-1] + (k - 1) * v * found[-2])
    return np.array(found[: most + 1])


def linear_form(a, m, s):
    return a @ m, a @ s @ a


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_unscented_means_of_cubics_are_exact(seed):
    """Sums of (a'x)^k span the polynomials of degree k, and a'x is a Gaussian; two slots, five directions."""
    rng = np.random.default_rng(seed)
    sizes = {"x": 3, "z": 2}
    slots = {label: (rng.normal(size=n), random_covariance(rng, n)) for label, n in sizes.items()}
    m, s = np.concatenate([m for m, _ in slots.values()]), np.zeros((5, 5))
    s[:3, :3], s[3:, 3:] = slots["x"][1], slots["z"][1]
    forms, powers = rng.normal(size=(8, 5)), rng.integers(0, 4, size=8)
    for kind in (ca.SX, ca.MX):
        mean, _ = moments(
            "unscented",
            lambda x, z: sum(
                (ca.mtimes(ca.DM(a).T, ca.vertcat(x, z)) ** k for a, k in zip(forms, powers, strict=True)), 0
            ),
            slots,
            kind,
        )
        terms = [normal_moments(*linear_form(a, m, s), 3)[k] for a, k in zip(forms, powers, strict=True)]
        assert abs(mean[0] - sum(terms)) <= 1e-12 * (
            1 + np.abs(forms).max() ** 3 * (np.abs(m).max() + np.trace(s)) ** 3
        )


@pytest.mark.parametrize(("directions", "degree"), [(1, 17), (2, 9), (3, 9)])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_quadrature_is_exact_to_its_degree(directions, degree, seed):
    """(a'x)^k, whose mean is of degree k and whose variance is of degree 2k; rounding relative to the sum of sizes."""
    rng = np.random.default_rng(seed)
    m, s, a = rng.normal(size=directions), random_covariance(rng, directions), rng.normal(size=directions)
    exact = normal_moments(*linear_form(a, m, s), 2 * degree)
    sizes = normal_moments(abs(a) @ abs(m), abs(a) @ abs(s) @ abs(a), 2 * degree)  # the sums themselves may cancel
    for k in (1, 2, degree // 2, degree):
        mean, covariance = moments("quadrature", lambda x, k=k: ca.mtimes(ca.DM(a).T, x) ** k, {"x": (m, s)})
        assert abs(mean[0] - exact[k]) <= 1e-12 * sizes[k]
        if 2 * k <= degree:
            assert (
                abs(covariance[0, 0] - (exact[2 * k] - exact[k] ** 2)) <= 1e-11 * sizes[2 * k]
            )  # a difference of both


@pytest.mark.parametrize("rule", ["unscented", "quadrature"])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_rules_of_points_are_exact_for_affine_functions_of_several_slots(rule, seed):
    """One of the slots is exact: it moves no point."""
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(3, 2)), rng.normal(size=(3, 2)), rng.normal(size=(3, 1))
    m, k, h, s, v = rng.normal(size=2), rng.normal(size=2), rng.normal(), random_covariance(rng, 2), 0.7
    mean, covariance = moments(
        rule, lambda x, z, w: ca.DM(a) @ x + ca.DM(b) @ z + ca.DM(c) * w, {"x": (m, s), "z": (k, None), "w": (h, v)}
    )
    assert_close(mean, a @ m + b @ k + c[:, 0] * h)
    assert_close(covariance, a @ s @ a.T + v * c @ c.T)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_unscented_over_a_covariance_without_full_rank(seed):
    """Six elements that two numbers decide, as a model with more outputs than inputs leaves them.

    To the 1e-14 that the square root adds to each variance.
    """
    rng = np.random.default_rng(seed)
    a, root, m = rng.normal(size=(2, 6)), rng.normal(size=(6, 2)), rng.normal(size=6)
    s = root @ root.T
    mean, covariance = moments("unscented", lambda x: ca.DM(a) @ x, {"x": (m, s)})
    assert_close(mean, a @ m)
    assert_close(covariance, a @ s @ a.T, 1e-12)


@pytest.mark.parametrize("rule", ["unscented", "quadrature"])
def test_products_of_independent_slots(rule):
    """E[xz] = mk, var[xz] = m²t + k²s + st: of degree 4 across slots, which points on the axes do not see."""
    mean, covariance = moments(rule, lambda x, z: x * z, {"x": (2.0, 0.5), "z": (3.0, 0.1)})
    assert_close(mean, 6.0)
    assert_close(covariance, 9 * 0.5 + 4 * 0.1 + (0.05 if rule == "quadrature" else 0))


@pytest.mark.parametrize("m", np.linspace(-2, 2, 9))
@pytest.mark.parametrize("sd", [0.01, 1.0])
def test_quadrature_of_a_kink(m, sd):
    """E|x| = s√(2/π) exp(-m²/2s²) + m(1 - 2Φ(-m/s)), to a tenth of s.

    The kink is off by twice the integral, up to it, of the difference between the distribution functions, which
    changes its sign in every gap: half a gap (1.02) times half a weight (0.41), and less when the signs cancel.
    """
    mean, _ = moments("quadrature", lambda x: ca.fabs(x), {"x": (m * sd, sd**2)})
    expected = sd * np.sqrt(2 / np.pi) * np.exp(-(m**2) / 2) + m * sd * (1 - 2 * stats.norm.cdf(-m))
    assert abs(mean[0] - expected) <= 0.1 * sd


@pytest.mark.parametrize("m", np.linspace(-3, 3, 13))
def test_quadrature_of_a_jump(m):
    """P(x > 0) is off by no more than the weight of one point (Chebyshev, Markov and Stieltjes): 0.41 at most."""
    mean, covariance = moments("quadrature", lambda x: x > 0, {"x": (m, 1.0)})
    assert abs(mean[0] - stats.norm.cdf(m)) <= 0.41
    assert_close(covariance, mean[0] * (1 - mean[0]))
    assert 0 <= mean[0] <= 1 + 1e-12


def test_quadrature_over_many_directions_is_refused():
    x, z = ca.SX.sym("x", 2), ca.SX.sym("z", 2)
    sigma = {"x": ca.SX.sym("s", 2, 2), "z": ca.SX.sym("t", 2, 2)}
    refuses(
        lambda: RULES["quadrature"](x + z, {"x": x, "z": z}, sigma),
        sg.GraphError,
        "'quadrature' over 4 uncertain directions ('x' 2, 'z' 2)",
        "up to 3",
        "use 'unscented'",
    )


@pytest.mark.parametrize("rule", ["unscented", "quadrature"])
def test_functions_that_only_a_call_can_evaluate(rule):
    """A table between whose points a straight line runs, far from its corners: the mean of an affine function."""
    table = ca.interpolant("table", "linear", [[-10.0, 0.0, 10.0]], [20.0, 0.0, -20.0])
    mean, covariance = moments(rule, lambda x: table(x), {"x": (5.0, 0.04)}, ca.MX)
    assert_close(mean, -10.0)
    assert_close(covariance, 0.16)


# Through an objective


def chain(rule, later):
    """y = (a₁x₁ + a₂, a₂x₂ + 0.3) of two actions, then a reward of y by the rule."""
    graph = sg.Graph({"x": sg.State(2), "y": sg.State(2), "a": sg.Action(2, low=-1, high=1)}, start="n")
    graph.edge("n", "end", lambda x, a: {"y": ca.vertcat(a[0] * x[0] + a[1], a[1] * x[1] + 0.3)})
    graph.reward("end", sg.Model(later, propagation=rule))
    return sg.Objective(sg.unroll(graph), compiled=False)


STATE = {"x": sg.Gaussian([1.0, -0.5], [[0.3, 0.1], [0.1, 0.2]])}


@pytest.mark.parametrize("rule", ["unscented", "quadrature"])
@pytest.mark.parametrize("a", [[0.5, -0.7], [0.3, 0.4], [-0.9, 0.2]], ids=str)
def test_gradients_against_central_differences(rule, a):
    """h = 1e-5: the third derivatives, of order 10, leave 1e-9; the rounding of values 1e-11."""
    objective = chain(rule, lambda y: ca.sin(2 * y[0]) * ca.exp(0.5 * y[1]))
    got = objective.gradient(STATE, {"a": a})["a"]
    ahead, behind = [np.array([objective.value(STATE, {"a": a + h * e}) for e in np.eye(2)]) for h in (1e-5, -1e-5)]
    assert_close(got, (ahead - behind) / 2e-5, 1e-8)


@pytest.mark.parametrize("rule", ["unscented", "quadrature"])
@pytest.mark.parametrize("zero", [[0.0, 0.0], [0.0, 0.6], [0.6, 0.0]], ids=str)
def test_gradients_where_actions_drive_a_variance_to_zero(rule, zero):
    """Finite, and the limit from where it is not zero, to 1e-3: where a standard deviation goes through zero, the
    square root of the covariance turns, and points on its axes differ from others by terms of the fourth degree.

    With both actions 0 nothing is uncertain, and the gradient is that of the plain function.
    """
    objective = chain(rule, lambda y: ca.sin(2 * y[0]) * ca.exp(0.5 * y[1]))
    got = objective.gradient(STATE, {"a": zero})["a"]
    near = [objective.gradient(STATE, {"a": np.array(zero) + d * np.array([1, 1])})["a"] for d in (1e-4, -1e-4)]
    assert_close(got, np.mean(near, axis=0), 1e-3)
    if not any(zero):
        y = np.array([0.0, 0.3])
        slopes = np.array([2 * np.cos(2 * y[0]), 0.5 * np.sin(2 * y[0])]) * np.exp(0.5 * y[1])
        assert_close(got, [slopes @ [1.0, 0.0], slopes @ [1.0, -0.5]], 1e-9)
        assert_close(objective.value(STATE, {"a": zero}), 0.0, 1e-9)


@pytest.mark.parametrize("rule", ["unscented", "quadrature"])
def test_gradients_where_a_variance_grows_from_zero(rule):
    """var[y] = a⁺ has a slope where it begins; the sum over points has none there, and no infinite one either."""
    slots = {"y": sg.State(2), "a": sg.Action(low=0, high=1)}
    graph = sg.Graph(slots, start="n")
    graph.reward("n", sg.Model(lambda y, a: ca.exp(a * y[0] + y[1]), propagation=rule))
    objective = sg.Objective(sg.unroll(graph), compiled=False)
    got = objective.gradient({"y": sg.Gaussian([0.2, 0.1], np.zeros((2, 2)))}, {"a": 0.5})["a"]
    assert_close(got, 0.2 * np.exp(0.2), 1e-9)
