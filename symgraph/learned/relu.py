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

from symgraph.compile.rules import set_adjoint

FLOOR = 1e-16  # variance of a whitened quantity that counts as none
QUADRATURE_POINTS = 16  # of the integral over correlations


@dataclass(frozen=True)
class Rectified:
    """What `rectify` returns, all of the shape of the means."""

    mean: ca.MX
    variance: ca.MX
    gain: ca.MX  # Φ(α): the slope of the mean, and the share of a deviation that passes


def rectify(mean: ca.MX, variance: ca.MX) -> Rectified:
    """Return the moments of max(0, x), element by element."""
    shape = mean.shape
    function = _rectified()
    if mean.numel() > 1:
        function = function.map(mean.numel())
    moments = function.call([ca.vec(part).T for part in (mean, ca.densify(variance))])
    return Rectified(*(ca.reshape(part, *shape) for part in moments[:3]))


@cache
def _rectified() -> ca.Function:
    """(m, v) → the moments E and E[max(0, x)²] - E², Φ(α), and ∂E/∂v = φ(α)/2s."""
    m, v = ca.SX.sym("m"), ca.SX.sym("v")
    inverse = ca.sqrt(1 / (v + FLOOR))  # CasADi would turn products with 1 / √ into divisions
    x = m * inverse * math.sqrt(0.5)
    gain = 0.5 + 0.5 * ca.erf(x)
    slope = ca.exp(-(x * x)) * inverse * (0.5 / math.sqrt(2 * math.pi))
    mean = m * gain + 2 * (v + FLOOR) * slope
    # E[max(0, x)²] - E² with E[max(0, x)²] = vΦ + mE; written so that nothing cancels where m is many s above zero.
    spread = ca.fmax(v * gain + (m - mean) * mean, 0.0)
    function = ca.Function("rectified", [m, v], [mean, spread, gain, slope])

    # ∂E/∂m = Φ, ∂E/∂v = slope; of E[max(0, x)²] they are 2E and Φ. ∂Φ/∂m = 2 slope, ∂Φ/∂v = -m slope / v.
    given = [ca.SX.sym(name) for name in ("mean", "spread", "gain", "slope", "a_mean", "a_spread", "a_gain", "a_slope")]
    mean, _, gain, slope, of_mean, of_spread, of_gain, of_slope = given
    lost = 2 * mean * of_spread
    down = m / (v + FLOOR)  # of log slope by m, but for the sign; it is 1 / v times α²/2 - 1/2 by v
    by_m = gain * (of_mean - lost) + lost + 2 * slope * of_gain - slope * down * of_slope
    by_v = slope * (of_mean - lost) + gain * of_spread - slope * down * of_gain
    by_v += slope * (down * down - 1 / (v + FLOOR)) / 2 * of_slope
    set_adjoint(function, ca.Function("rectified_adjoint", [m, v, *given], [by_m, by_v]))
    return function


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


def pair_covariance(mean: ca.MX, before: ca.MX, after: Rectified, exact: bool) -> ca.MX:
    """Return the covariance (n, n) of n units, given mean and covariance before the units and the moments after them.

    With ρ the correlation before the units, sᵢsⱼ times

        Σ_{k=1..4} ρᵏ/k! c_k(αᵢ)c_k(αⱼ),  c₁ = Φ, c_k = (-1)ᵏ He_{k-2}(α)φ(α)                          (series)
        ρΦ(αᵢ)Φ(αⱼ) + 1/2π ∫₀^{asin ρ} (ρ - sin t) exp(-(αᵢ² + αⱼ² - 2αᵢαⱼ sin t)/(2cos²t)) dt      (exact)

    Args:
        mean: (n, 1) of the units' inputs.
        before: (n, n) their covariance.
        after: moments (n, 1) of their outputs.
        exact: the integral, good to 1e-7, instead of the series, good to about 5e-3 and several times cheaper.
    """
    n = before.shape[0]
    sd = ca.sqrt(ca.diag(before) + FLOOR)
    alpha = mean / sd
    density = ca.exp(-0.5 * alpha * alpha) * (1 / math.sqrt(2 * math.pi))
    scale = ca.mtimes(sd, sd.T)
    # asin has no slope at ±1, and rounding can carry a correlation beyond.
    rho = ca.fmin(ca.fmax(before / scale, -_LARGEST_CORRELATION), _LARGEST_CORRELATION)
    total = rho * ca.mtimes(after.gain, after.gain.T)
    if exact:
        total += _integral(alpha, rho)
    else:
        power, hermite, previous, factorial = rho, density, ca.MX(n, 1), 1.0
        for k in range(2, 5):
            power, factorial = power * rho, factorial * k
            total += power * (1 / factorial) * ca.mtimes(hermite, hermite.T)
            hermite, previous = alpha * hermite - (k - 2) * previous, hermite
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
