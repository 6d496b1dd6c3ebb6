"""Moments of rectified Gaussians, against integration."""

import casadi as ca
import mpmath
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from small_tasks import assert_close

from symgraph.learned.relu import FLOOR, Rectified, pair_covariance, rectify, rectify_held

MEANS = [-3.0, -0.7, 0.0, 1e-9, 0.4, 2.5]
VARIANCES = [1e-4, 0.03, 1.0, 7.0]


def rectified(function=rectify):
    mean, variance = ca.MX.sym("mean"), ca.MX.sym("variance")
    after = function(mean, variance)
    after = [after.mean, after.variance] if isinstance(after, Rectified) else list(after)
    slopes = [ca.jacobian(a, b) for a in after for b in (mean, variance)]
    compiled = ca.Function("f", [mean, variance], [*after, *slopes])
    # mean, variance, dE/dm, dE/dv, dV/dm, dV/dv
    return lambda m, v: np.array([float(a) for a in compiled(m, v)])


RECTIFY, HELD = rectified(), rectified(rectify_held)


def integrated(m, v):
    """Mean and variance of max(0, x) by adaptive integration over x > 0, and the mass at 0."""
    x = stats.norm(m, np.sqrt(v))
    low, high = max(0.0, m - 12 * np.sqrt(v)), max(0.0, m + 12 * np.sqrt(v))
    mean = integrate.quad(lambda t: t * x.pdf(t), low, high, epsabs=0, epsrel=1e-12, limit=200)[0]
    above = integrate.quad(lambda t: (t - mean) ** 2 * x.pdf(t), low, high, epsabs=0, epsrel=1e-12, limit=200)[0]
    return mean, above + mean**2 * x.cdf(0)


@pytest.mark.parametrize("m", MEANS)
@pytest.mark.parametrize("v", VARIANCES)
def test_moments_against_integration(m, v):
    """To 1e-11 of the size of x, and the floor under variances (half its share in Φ) where they are small."""
    if m / np.sqrt(v) > -20:
        mean, variance = integrated(m, v)
    else:
        mean, variance = 0.0, 0.0  # less than exp(-200)
    size = abs(m) + np.sqrt(v)
    got = RECTIFY(m, v)
    assert abs(got[0] - mean) <= 1e-11 * size
    assert abs(got[1] - variance) <= 1e-11 * size**2


@pytest.mark.parametrize("v", VARIANCES)
@pytest.mark.parametrize("alpha", [-40.0, -9.0, -6.0, 6.0, 9.0, 40.0])
def test_far_from_the_kink_units_are_shut_or_linear(v, alpha):
    """What passes beyond 6 standard deviations is 1e-9 of them; 40 standard deviations up, 40² roundings."""
    m = alpha * np.sqrt(v)
    mean, variance, *slopes = RECTIFY(m, v)
    is_open = float(alpha > 0)
    tail = stats.norm.pdf(alpha)
    assert_close(mean / np.sqrt(v), is_open * alpha, 1e-14 + tail)
    assert abs(variance / v - is_open) <= 1e-12 + 40 * tail
    slack = 1e-12 + 40 * tail
    np.testing.assert_allclose(slopes[0], is_open, atol=slack)
    np.testing.assert_allclose(slopes[3], is_open, atol=slack * 10)
    np.testing.assert_allclose(np.array(slopes[1:3]) * [np.sqrt(v), 1 / np.sqrt(v)], 0, atol=slack * 10)


@pytest.mark.parametrize("v", [0.0, 1e-20, 1e-17])
@pytest.mark.parametrize("m", [-2.0, -1e-3, 0.0, 1e-3, 2.0])
def test_without_variance_a_unit_is_the_plain_one(m, v):
    """The floor counts as a standard deviation of 1e-8: E max(0, x) at the kink is that over √2π."""
    mean, variance, *slopes = RECTIFY(m, v)
    assert np.isfinite(slopes).all()
    assert_close(mean, max(0, m), 1e-8)
    assert 0 <= variance <= v + FLOOR
    assert_close(slopes[0], np.heaviside(m, 0.5), 1e-12)


@pytest.mark.parametrize("m", MEANS)
@pytest.mark.parametrize("v", VARIANCES)
def test_slopes_of_moments(m, v):
    """dE/dm = Φ, dE/dv = φ/(2s) (the heat equation), dV/dm = 2E(1 - Φ), dV/dv = Φ - Eφ/s."""
    s = np.sqrt(v)
    mean, _, *slopes = RECTIFY(m, v)
    gain, density = stats.norm.cdf(m / s), stats.norm.pdf(m / s)
    expected = [gain, density / (2 * s), 2 * mean * (1 - gain), gain - mean * density / s]
    # The floor, which tilts V's slopes by its share of the variance, and cancellation at α = 40 or so.
    assert_close(slopes, expected, 1e-11 + FLOOR / v * 40)


@pytest.mark.parametrize("m", MEANS)
@pytest.mark.parametrize("v", [0.0, *VARIANCES])
def test_held_moments_have_the_slope_of_the_mean_alone(m, v):
    got, full = HELD(m, v), RECTIFY(m, v)
    assert_close(got[:3], full[:3], 1e-14)
    assert (got[3:] == 0).all()


@settings(max_examples=200)
@given(m=st.floats(-1e6, 1e6), v=st.one_of(st.just(0.0), st.floats(1e-30, 1e12)))
def test_moments_and_slopes_are_finite_and_in_order(m, v):
    mean, variance, *slopes = RECTIFY(m, v)
    assert np.isfinite([mean, variance, *slopes]).all()
    s = np.sqrt(v + FLOOR)
    assert max(0.0, m) - 1e-15 * abs(m) <= mean <= max(0.0, m) + 0.4 * s * (1 + 1e-12) + 1e-15 * abs(m)
    assert 0 <= variance <= v * (1 + 1e-12) + FLOOR + 1e-15 * m**2


# Pairs


def covariance_after(exact):
    def build(n):
        mean, before = ca.MX.sym("mean", n), ca.MX.sym("before", n, n)
        after = pair_covariance(mean, before, rectify(mean, ca.diag(before)), exact)
        slopes = [ca.jacobian(after, mean), ca.jacobian(after, before)]
        return ca.Function("f", [mean, before], [after, *slopes])

    made = {}
    return lambda m, c: [np.array(a) for a in made.setdefault(len(m), build(len(m)))(m, c)]


EXACT, SERIES = covariance_after(True), covariance_after(False)


def true_covariance(a, b, rho):
    """cov(max(0, x), max(0, y)) of N((a, b), [[1, ρ], [ρ, 1]]) = ∫₀^ρ P(x > 0, y > 0; r) dr, in 25 digits.

    Price's theorem; the probability in turn is Φ(a)Φ(b) + ∫₀^r of the bivariate density at (a, b), and exchanging the
    integrals leaves ρΦ(a)Φ(b) + ∫₀^ρ (ρ - t) density(t) dt.
    """
    with mpmath.workdps(30):
        a, b, rho = mpmath.mpf(a), mpmath.mpf(b), mpmath.mpf(rho)

        def inner(t):
            rest = 1 - t * t
            return (rho - t) * mpmath.exp(-(a * a - 2 * t * a * b + b * b) / (2 * rest)) / mpmath.sqrt(rest)

        steps = [rho * mpmath.mpf(k) for k in (("0", "1") if abs(rho) < 0.9 else ("0", "0.9", "0.99", "0.999", "1"))]
        return float(rho * mpmath.ncdf(a) * mpmath.ncdf(b) + mpmath.quad(inner, steps) / (2 * mpmath.pi))


ALPHAS = [-2.0, 0.0, 0.5, 0.5001, 0.52, 3.0]
PAIRS = [(a, b) for i, a in enumerate(ALPHAS) for b in ALPHAS[i:]]
RHOS = [-0.9999, -0.5, 1e-6, 0.8, 0.99, 0.9999]


def pair(rule, a, b, rho, scales=(1.0, 1.0)):
    s = np.array(scales)
    return rule(s * [a, b], s[:, None] * np.array([[1, rho], [rho, 1]]) * s)[0]


def density(x, y, rho):
    return np.exp((x * y * rho - (x * x + y * y) / 2) / (1 - rho**2)) / (2 * np.pi * np.sqrt(1 - rho**2))


def test_the_true_covariance_of_pairs_against_integration_in_the_plane():
    """What the other tests compare with, from its definition, to the integration's 1e-8."""
    for a, b, rho in [(0.5, -1.0, 0.8), (0.0, 0.5001, -0.5), (2.0, 2.0, 0.3)]:
        product, _ = integrate.dblquad(
            lambda y, x, a=a, b=b, rho=rho: x * y * density(x - a, y - b, rho), 0, a + 8, 0, b + 8, epsabs=1e-9
        )
        means = [m * stats.norm.cdf(m) + stats.norm.pdf(m) for m in (a, b)]
        assert_close(true_covariance(a, b, rho), product - means[0] * means[1], 1e-8)


@pytest.mark.parametrize("rho", RHOS)
def test_covariances_of_pairs(rho):
    """The integral to the 1e-7 that its docstring says, of s²; the series to 6e-3."""
    for a, b in PAIRS:
        expected = true_covariance(a, b, rho)
        assert abs(pair(EXACT, a, b, rho)[0, 1] - expected) <= 1e-7
        assert abs(pair(SERIES, a, b, rho)[0, 1] - expected) <= 6e-3


@pytest.mark.parametrize("rule", [EXACT, SERIES], ids=["exact", "series"])
def test_covariances_scale_with_the_standard_deviations(rule):
    """To the floor under variances, of which the smaller one here has 1e-12."""
    plain, scaled = pair(rule, 0.5, -1.0, 0.8), pair(rule, 0.5, -1.0, 0.8, (0.01, 300.0))
    np.testing.assert_allclose(scaled, plain * np.outer([0.01, 300], [0.01, 300]), rtol=1e-10)


def random_units(seed, n, rank):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, rank))
    return rng.normal(size=n), root @ root.T


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 5), rank=st.integers(0, 5))
@example(seed=0, n=4, rank=1)
def test_matrices_of_units(seed, n, rank):
    """Symmetric, with the variances on the diagonal; positive semidefinite to the integral's 1e-7 an element."""
    m, before = random_units(seed, n, rank)
    for rule in (EXACT, SERIES):
        after, *slopes = rule(m, before)
        assert all(np.isfinite(s).all() for s in slopes)
        assert_close(after, after.T, 1e-14)
        assert_close(np.diag(after), [RECTIFY(a, v)[1] for a, v in zip(m, np.diag(before), strict=True)], 1e-13)
    after = EXACT(m, before)[0]
    assert np.linalg.eigvalsh(after)[0] >= -1e-7 * n * before.diagonal().max() - 1e-15


@pytest.mark.parametrize("rule", [EXACT, SERIES], ids=["exact", "series"])
@pytest.mark.parametrize("rho", [-1.0, 1.0])
@pytest.mark.parametrize("alphas", [(0.0, 0.0), (0.3, 0.3), (-0.5, 1.2), (50.0, 50.0)])
def test_perfectly_correlated_units(rule, rho, alphas):
    """cov = E[max(0, x) max(0, y)] - E E with y = b + ρ(x - a): one integral. Tolerances as for other correlations."""
    after, *slopes = rule(np.array(alphas), np.array([[1, rho], [rho, 1]]))
    assert all(np.isfinite(s).all() for s in slopes)
    a, b = alphas
    z = np.linspace(-10, 10, 200_001)
    weights = stats.norm.pdf(z)
    weights /= weights.sum()
    x, y = np.maximum(0, a + z), np.maximum(0, b + rho * z)
    expected = weights @ (x * y) - (weights @ x) * (weights @ y)
    assert abs(after[0, 1] - expected) <= (1e-6 if rule is EXACT else 6e-3)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_slopes_of_matrices_of_units(seed):
    """Central differences: their error is the third derivative, of order 1 where ρ < 0.9, times 1e-10."""
    rng = np.random.default_rng(seed)
    m, root = rng.normal(size=3), rng.normal(size=(3, 3))
    before = root @ root.T + 2 * np.eye(3)
    dm, dc = rng.normal(size=3), rng.normal(size=(3, 3))
    dc += dc.T
    h = 1e-5
    for rule in (EXACT, SERIES):
        _, by_mean, by_before = rule(m, before)
        got = by_mean @ dm + by_before @ dc.ravel(order="F")
        ahead, behind = [rule(m + k * dm, before + k * dc)[0] for k in (h, -h)]
        assert_close(got, ((ahead - behind) / (2 * h)).ravel(order="F"), 1e-8)
