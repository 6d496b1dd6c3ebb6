"""Cubature: points with weights that stand for a Gaussian, and square roots of covariances that spread them.

A rule holds points z with weights w for the standard normal distribution, so that E[f(μ + Lz)] ≈ Σ w f(μ + Lz) with
LLᵀ = Σ. All weights are positive: a covariance that is summed up with them cannot become indefinite.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from symgraph.slots import Array


@dataclass(frozen=True, eq=False)
class Rule:
    """Points (d, K), a column each, and weights (K,) that sum to 1."""

    points: Array
    weights: Array


@cache
def gauss_hermite(directions: int, order: int) -> Rule:
    """Return a grid of order^d Gauss–Hermite points, exact to degree 2·order - 1 in each direction."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    return _tensor(nodes, weights / weights.sum(), directions)


@cache
def trapezoidal(count: int, spacing: float) -> Rule:
    """Return evenly spaced points in one direction, weighed by the density and scaled to variance 1.

    Sums over an even grid converge faster for a Gaussian than any power of the spacing; unlike Gauss–Hermite points,
    which drift apart, they leave no gap wide enough for a jump to hide in.
    """
    nodes = spacing * (np.arange(count) - (count - 1) / 2)
    weights = np.exp(-(nodes**2) / 2)
    weights /= weights.sum()
    return _tensor(nodes / np.sqrt(weights @ nodes**2), weights, 1)


@cache
def on_axes(directions: int) -> Rule:
    """Return 2d points at ±√d on the axes, exact to degree 3.

    Source: Arasaratnam & Haykin, Cubature Kalman Filters, IEEE Transactions on Automatic Control 54, 2009.
    """
    axes = np.sqrt(directions) * np.eye(directions)
    return Rule(np.hstack([axes, -axes]), np.full(2 * directions, 0.5 / directions))


@cache
def unscented(directions: int) -> Rule:
    """Return 2d points at ±√(d + κ) on the axes and, where κ = max(0, 3 - d) > 0, the middle: exact to degree 3.

    Up to three directions the fourth moment along each axis is right too; beyond, κ = 3 - d would make the weight of
    the middle negative. For d = 3 its weight is zero, and it is left out.

    Source: Julier & Uhlmann, Unscented Filtering and Nonlinear Estimation, Proceedings of the IEEE 92, 2004.
    """
    kappa = max(0, 3 - directions)
    rule = on_axes(directions)
    if not kappa:
        return rule
    total = directions + kappa
    points = np.hstack([np.zeros((directions, 1)), np.sqrt(total / directions) * rule.points])
    return Rule(points, np.concatenate([[kappa / total], np.full(2 * directions, 0.5 / total)]))


@cache
def quasi_random(directions: int, count: int = 128) -> Rule:
    """Return points of a scrambled Sobol sequence with their mirror images, of mean 0 and covariance 1.

    For averages over more directions than a grid can serve, where a relative error of a hundredth will do.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    half = ndtri(qmc.Sobol(directions, seed=0).random(count // 2)).T
    points = np.hstack([half, -half])
    root = np.linalg.cholesky(points @ points.T / count)
    return Rule(np.linalg.solve(root, points), np.full(count, 1 / count))


def _tensor(nodes: Array, weights: Array, directions: int) -> Rule:
    points = np.array(list(product(nodes, repeat=directions))).T
    return Rule(points, np.array([np.prod(w) for w in product(weights, repeat=directions)]))


def square_root(covariance: Any) -> Any:
    """Return a lower triangular L (n, n) with LLᵀ = Σ, for a covariance (n, n) of SX or MX.

    To the diagonal are added 1e-14 of each variance and 1e-18 of the trace, which is lost in rounding as long as the
    deviations lie within 1e8 of each other. Without that, the slope of the square root would be infinite where a
    variance is zero or a correlation ±1, and gradients NaN; and where the rank is lower than n, rounding would be
    divided by rounding and grow from column to column. Where Σ = 0 the slopes are 0. Of a matrix that is not quite a
    covariance, the variances are kept.
    """
    n = covariance.shape[0]
    if n == 1:
        return ca.sqrt(ca.fmax(covariance, _TINY))
    return _square_root(n).call([covariance])[0]


# Under it a variance is zero; its square root squared must still be a number.
_TINY = 1e-200


@cache
def _square_root(n: int) -> ca.Function:
    sigma = ca.SX.sym("sigma", n, n)
    trace = ca.trace(sigma)
    anything = trace > _TINY  # 0 or 1, without a slope
    left = [sigma[i, i] for i in range(n)]  # of the variances, by the columns so far
    added = [1e-14 * sigma[i, i] + 1e-18 * trace for i in range(n)]
    factor = ca.SX(n, n)
    for j in range(n):
        most = [ca.sqrt(ca.fmax(ca.fmax(left[i], 0.0) + added[i], _TINY)) for i in range(j, n)]
        factor[j, j] = most[0]
        for i in range(j + 1, n):
            inner = sum((factor[i, k] * factor[j, k] for k in range(j)), ca.SX(0))
            quotient = anything * (sigma[i, j] - inner) / most[0]
            factor[i, j] = ca.fmin(ca.fmax(quotient, -most[i - j]), most[i - j])
            left[i] -= factor[i, j] ** 2
    return ca.Function(f"square_root_{n}", [sigma], [factor])
