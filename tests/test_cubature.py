"""Cubature: the moments of each rule, and square roots of covariances of every kind."""

from itertools import product

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_tasks import assert_close

from symgraph.cubature import gauss_hermite, on_axes, quasi_random, square_root, trapezoidal, unscented


def normal_moment(powers):
    """E[z₁^a₁ z₂^a₂ …] of independent standard normals: 0 where a power is odd, else the product of (a - 1)!!."""
    if any(a % 2 for a in powers):
        return 0.0
    return float(np.prod([np.prod(np.arange(a - 1, 0, -2)) for a in powers]))


def assert_moments(rule, powers):
    """Within 1e-13 of the sum of what is summed: the rounding of nodes, powers and weights."""
    for power in powers:
        terms = rule.weights * np.prod(rule.points ** np.array(power)[:, None], axis=0)
        assert abs(terms.sum() - normal_moment(power)) <= 1e-13 * (np.abs(terms).sum() + 1), power


def total_degree(directions, degree):
    return [power for power in product(range(degree + 1), repeat=directions) if sum(power) <= degree]


EVERY_RULE = {
    **{f"grid of {k}^{d}": gauss_hermite(d, k) for d, k in [(1, 1), (1, 3), (1, 9), (2, 3), (2, 5), (3, 3), (3, 5)]},
    **{f"{d} axes": on_axes(d) for d in range(1, 9)},
    **{f"middle and {d} axes": unscented(d) for d in range(1, 9)},
    "even 13": trapezoidal(13, 0.5),
    "even 12": trapezoidal(12, 0.7),
}


@pytest.mark.parametrize("name", EVERY_RULE)
def test_weights_are_positive_and_sum_to_one(name):
    rule = EVERY_RULE[name]
    assert (rule.weights > 0).all()
    assert_close(rule.weights.sum(), 1)
    assert rule.points.shape[1:] == rule.weights.shape


@pytest.mark.parametrize("name", EVERY_RULE)
def test_every_rule_is_right_for_means_and_covariances(name):
    rule = EVERY_RULE[name]
    if name != "grid of 1^1":
        assert_moments(rule, total_degree(len(rule.points), 3 if len(rule.points) <= 5 else 2))


@pytest.mark.parametrize(("directions", "order"), [(1, 1), (1, 3), (1, 5), (1, 9), (2, 3), (2, 5), (3, 3), (3, 5)])
def test_grids_are_exact_to_their_degree_in_each_direction(directions, order):
    assert gauss_hermite(directions, order).points.shape == (directions, order**directions)
    assert_moments(gauss_hermite(directions, order), product(range(2 * order), repeat=directions))


def test_a_grid_is_not_exact_beyond_its_degree():
    """The error at degree 2k is k!, that of the monic Hermite polynomial of degree k squared."""
    rule = gauss_hermite(1, 3)
    assert_close(rule.weights @ rule.points[0] ** 6, normal_moment([6]) - 6)


@pytest.mark.parametrize("directions", [1, 2, 3])
def test_the_fourth_moment_along_an_axis_is_right_for_up_to_three_directions(directions):
    assert_moments(unscented(directions), np.eye(directions, dtype=int) * 4)


def test_even_grids_converge_faster_than_powers():
    """Poisson: aliasing is exp(-2π²/h²), 5e-35 at h = 0.5; 41 points end at 10 standard deviations."""
    assert_moments(trapezoidal(41, 0.5), [(k,) for k in range(13)])


def test_even_grids_have_even_spacing_and_variance_one():
    rule = trapezoidal(13, 0.5)
    gaps = np.diff(rule.points[0])
    assert_close(gaps, gaps[0])
    assert_close(rule.weights @ rule.points[0] ** 2, 1)
    # The ratios of the weights are those of the density at nodes before they were scaled.
    assert_close(np.log(rule.weights / rule.weights[6]), -((0.5 * np.arange(-6, 7)) ** 2) / 2)


# Square roots


def roots(n, kind):
    """Σ → L and its derivatives by the elements of Σ."""
    sigma = kind.sym("sigma", n, n)
    root = ca.densify(square_root(sigma))
    return ca.Function("root", [sigma], [root, ca.jacobian(root, sigma)])


ROOTS = {(n, kind): roots(n, kind) for n in range(1, 7) for kind in (ca.SX, ca.MX)}


def assert_is_root(sigma, kind):
    """LLᵀ = Σ to the 1e-14 of each variance and 1e-18 of the trace that are added, and n roundings."""
    root, slopes = [np.array(m) for m in ROOTS[len(sigma), kind](sigma)]
    assert np.isfinite(root).all()
    assert np.isfinite(slopes).all()
    assert (np.triu(root, 1) == 0).all()
    assert (np.diag(root) > 0).all()
    sd = np.sqrt(np.diag(sigma))
    allowed = 2e-14 * np.outer(sd, sd) + 2e-18 * np.trace(sigma) + 1e-199
    assert (np.abs(root @ root.T - sigma) <= allowed).all()


@st.composite
def covariances(draw):
    """(n, n) of any rank and scale, with rows of zeros and correlations of ±1 among them."""
    n = draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    root = rng.normal(size=(n, draw(st.integers(0, n))))
    zero = draw(st.lists(st.integers(0, n - 1), max_size=2))
    root[zero] = 0
    for to, of in draw(st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=2)):
        root[to] = draw(st.sampled_from([-3.0, -1.0, 0.5, 1.0])) * root[of]
    sigma = root @ root.T * 10.0 ** draw(st.integers(-12, 12))
    if draw(st.booleans()):  # each row with a unit of its own
        units = 10.0 ** rng.integers(-3, 4, size=n)
        sigma = units[:, None] * sigma * units
    return (sigma + sigma.T) / 2


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@settings(max_examples=150)
@given(sigma=covariances())
@example(sigma=np.zeros((1, 1)))
@example(sigma=np.zeros((4, 4)))
@example(sigma=np.ones((6, 6)))
@example(sigma=np.array([[1.0, -1.0], [-1.0, 1.0]]))
@example(sigma=np.diag([0.0, 2.0, 0.0]))
@example(sigma=np.diag([1e12, 1e-12]) + 0.0)
@example(sigma=np.diag([1e-12, 1e12, 1.0]))
@example(sigma=np.array([[4.0, 2, 6], [2, 1, 3], [6, 3, 9]]) * 1e-12)
def test_a_square_root_squared_is_the_covariance(kind, sigma):
    assert_is_root(sigma, kind)


@settings(max_examples=100)
@given(n=st.integers(2, 6), rank=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
@example(n=5, rank=3, seed=12163)
@example(n=6, rank=2, seed=1)
def test_rounding_does_not_grow_where_the_rank_is_low(n, rank, seed):
    root = np.random.default_rng(seed).normal(size=(n, min(rank, n)))
    if seed % 3 == 0:  # the first two rows are almost one: their difference is mostly rounding
        root[1] = root[0] + 1e-6 * root[1]
    assert_is_root(root @ root.T, ca.SX)


@settings(max_examples=50)
@given(n=st.integers(2, 6), seed=st.integers(0, 2**32 - 1), size=st.floats(-14, -1))
def test_variances_are_kept_where_a_matrix_is_not_quite_a_covariance(n, seed, size):
    """As rounding, or a series cut short, leaves them; each column adds the 1e-14 anew."""
    rng = np.random.default_rng(seed)
    a, error = rng.normal(size=(n, 2)), 10**size * rng.normal(size=(n, n))
    sigma = a @ a.T + np.triu(error, 1) + np.triu(error, 1).T
    root, slopes = [np.array(m) for m in ROOTS[n, ca.SX](sigma)]
    assert np.isfinite(slopes).all()
    assert_close(np.diag(root @ root.T), np.diag(sigma), n * 2e-14)


@settings(max_examples=30)
@given(n=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_slopes_of_square_roots_of_regular_covariances(n, seed):
    """dL = L P(L⁻¹ dΣ L⁻ᵀ) where P takes the lower triangle and halves the diagonal; rounding times the condition."""
    rng = np.random.default_rng(seed)
    a, d = rng.normal(size=(2, n, n))
    sigma, change = a @ a.T + 0.3 * np.eye(n), d + d.T
    exact = np.linalg.cholesky(sigma)
    inner = np.linalg.solve(exact, np.linalg.solve(exact, change).T)
    expected = exact @ (np.tril(inner, -1) + np.diag(np.diag(inner)) / 2)
    for kind in (ca.SX, ca.MX):
        root, slopes = [np.array(m) for m in ROOTS[n, kind](sigma)]
        assert_close(root, exact, 1e-12)
        got = (slopes @ change.ravel(order="F")).reshape(n, n, order="F")
        assert_close(got, expected, 1e-11)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_slopes_are_zero_where_nothing_is_uncertain(n, kind):
    """Anything else, times the rounding of a sum over points, would be a slope of the sum."""
    root, slopes = ROOTS[n, kind](np.zeros((n, n)))
    assert np.abs(np.array(root)).max() <= 1e-100
    assert (np.array(slopes) == 0).all()


def test_what_is_exact_beside_something_uncertain_is_spread_by_rounding():
    """By 1e-9 of the root of the trace."""
    root = np.array(ca.evalf(square_root(ca.SX([[4.0, 0.0], [0.0, 0.0]]))))
    assert_close(root, [[2, 0], [0, 2e-9]], 1e-13)


@pytest.mark.parametrize("directions", [1, 3, 7])
def test_quasi_random_points_have_mean_zero_and_covariance_one(directions):
    rule = quasi_random(directions)
    assert_close(rule.points @ rule.weights, 0, 1e-12)
    assert_close((rule.points * rule.weights) @ rule.points.T, np.eye(directions), 1e-12)
    even = np.mean(np.abs(rule.points))  # E|z| = √(2/π)
    assert even == pytest.approx(np.sqrt(2 / np.pi), rel=0.02)
