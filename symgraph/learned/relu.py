"""Moments of max(0, x) under a Gaussian x: what a layer of rectified linear units does to means and covariances.

With x ~ N(m, v), s = √v and α = m/s:  E = mΦ(α) + sφ(α),  E[max(0, x)²] = (m² + v)Φ(α) + msφ(α). Variances count as at
least `FLOOR`, so that v = 0 gives max(0, m) with finite slopes; units are whitened, so that 1 is a usual size.

Source: Yamaguchi & Atkeson, Neural networks and differential dynamic programming, ICRA 2016, for mean and variance;
the covariance of two units by Price's theorem (Price, IRE Transactions on Information Theory 4, 1958).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

FLOOR = 1e-16  # variance of a whitened quantity that counts as none
QUADRATURE_POINTS = 16  # of the integral over correlations


@dataclass(frozen=True)
class Rectified:
    """What `rectify` returns, all of the shape of the means."""

    mean: ca.MX
    variance: ca.MX
    gain: ca.MX  # Φ(α): the slope of the mean, and the share of a deviation that passes
    alpha: ca.MX  # m/s
    sd: ca.MX  # s
    density: ca.MX  # φ(α)


def rectify(mean: ca.MX, variance: ca.MX) -> Rectified:
    """Return the moments of max(0, x), element by element."""
    sd = ca.sqrt(variance + FLOOR)
    alpha = mean * (1 / sd)  # the slope of 1/s needs no further division
    x = alpha * math.sqrt(0.5)
    gain = 0.5 + 0.5 * ca.erf(x)
    density = ca.exp(-(x * x)) * (1 / math.sqrt(2 * math.pi))  # an exponential that the slope of erf(x) holds too
    rectified = mean * gain + sd * density
    # E[max(0, x)²] - E² with E[max(0, x)²] = vΦ + mE; written so that nothing cancels where m is many s above zero.
    spread = variance * gain + (mean - rectified) * rectified
    return Rectified(rectified, ca.fmax(spread, 0.0), gain, alpha, sd, density)


def rectify_held(mean: ca.MX, variance: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return mean and variance of max(0, x) with the slope of the mean alone, as in the paper's gradients."""
    moments = _held(*mean.shape).call([mean, variance], False, True)
    return moments[0], moments[1]


@cache
def _held(rows: int, columns: int) -> ca.Function:
    mean, variance = ca.MX.sym("mean", rows, columns), ca.MX.sym("variance", rows, columns)
    after = rectify(mean, variance)
    options = {"is_diff_in": [True, False], "is_diff_out": [True, False]}
    return ca.Function("held", [mean, variance], [after.mean, after.variance], options)


def pair_covariance(before: ca.MX, after: Rectified, exact: bool) -> ca.MX:
    """Return the covariance (n, n) of n units, given the one before the units and their moments.

    With ρ the correlation before the units, sᵢsⱼ times

        Σ_{k=1..4} ρᵏ/k! c_k(αᵢ)c_k(αⱼ),  c₁ = Φ, c_k = (-1)ᵏ He_{k-2}(α)φ(α)                          (series)
        ρΦ(αᵢ)Φ(αⱼ) + 1/2π ∫₀^{asin ρ} (ρ - sin t) exp(-(αᵢ² + αⱼ² - 2αᵢαⱼ sin t)/(2cos²t)) dt      (exact)

    Args:
        before: (n, n) covariance of the units' inputs.
        after: moments (n, 1) of their outputs.
        exact: the integral, good to 1e-7, instead of the series, good to about 5e-3 and several times cheaper.
    """
    n = before.shape[0]
    scale = ca.mtimes(after.sd, after.sd.T)
    # asin has no slope at ±1, and rounding can carry a correlation beyond.
    rho = ca.fmin(ca.fmax(before / scale, -_LARGEST_CORRELATION), _LARGEST_CORRELATION)
    total = rho * ca.mtimes(after.gain, after.gain.T)
    if exact:
        total += _integral(after.alpha, rho)
    else:
        power, hermite, previous, factorial = rho, after.density, ca.MX(n, 1), 1.0
        for k in range(2, 5):
            power, factorial = power * rho, factorial * k
            total += power * (1 / factorial) * ca.mtimes(hermite, hermite.T)
            hermite, previous = after.alpha * hermite - (k - 2) * previous, hermite
    # On the diagonal the variance is known.
    off = ca.DM.ones(n, n) - ca.DM.eye(n)
    return scale * total * off + ca.diag(after.variance)


_LARGEST_CORRELATION = 1 - 1e-12


def _integral(alpha: ca.MX, rho: ca.MX) -> ca.MX:
    """Return the integral of `pair_covariance`, by Gauss–Legendre in t."""
    n = alpha.numel()
    rows, columns = ca.repmat(alpha, 1, n), ca.repmat(alpha.T, n, 1)
    squares, product = 0.5 * (rows * rows + columns * columns), rows * columns
    end = ca.asin(rho)
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
    total = ca.MX(n, n)
    for node, weight in zip(nodes, weights, strict=True):
        sine = ca.sin(end * (0.5 * (node + 1)))
        density = ca.exp((product * sine - squares) / (1 - sine * sine))
        total += weight * (rho - sine) * density
    return total * end * (0.25 / math.pi)
