"""The best shot of the two cannons, from polynomial roots.

Let b = target_x - muzzle_x > 0, u = tan(theta), so 1 / cos(theta)^2 = 1 + u^2, and A = g b^2 / (2 v^2). Then

    hit_height - target_y = D(u) = d + b u - A u^2      with d = muzzle_y - target_y - A,
    hit_time^2            = b^2 (1 + u^2) / v^2,
    R(u)                  = -D(u)^2 - w b^2 (1 + u^2) / v^2,

a quartic in u with leading coefficient -A^2, so it has at most two maxima: the low and the high arc. Since
theta -> u is monotone on (-pi/2, pi/2), the global optimum over a closed interval of theta is a real root of
the cubic R'(u) = 0 or an end of the interval. With q = u A / b and k = b^2 / A = 2 v^2 / g the cubic becomes

    (d + k (q - q^2)) (1 - 2 q) + (w k / v^2) q = 0,
    2 k q^3 - 3 k q^2 + (k - 2 d + w k / v^2) q + d = 0,

whose coefficients stay of order one however near the target is. Roots are refined by Newton's method.
Without the time's weight the target is hit where D = 0: q^2 - q - d / k = 0.

Uses neither symgraph nor models, so that it can judge both.
"""

import math
from dataclasses import dataclass

import numpy as np

G = 9.8  # [m/s^2]
V = 3.0  # [m/s]
W = 1e-3  # weight of the squared time [m^2/s^2]
MUZZLE_Y = {"lower": 0.0, "upper": 0.8}  # both at x = 0 [m]
THETA_LIMIT = 1.57  # [rad]
K = 2 * V**2 / G  # [m]


@dataclass(frozen=True)
class Shot:
    """theta: () [rad]; value: () reward [m^2]."""

    cannon: str
    theta: float
    value: float


def reward(cannon, theta, target_x, target_y=0.3):
    """R of a shot; theta may be an array [rad]."""
    u = np.tan(theta)
    seconds = target_x / (V * np.cos(theta))
    miss = MUZZLE_Y[cannon] - target_y + target_x * u - G / 2 * seconds**2
    return -(miss**2) - W * seconds**2


def _offset(cannon, target_x, target_y):
    """d of the module's docstring [m]."""
    if not target_x > 0:
        raise ValueError(f"target_x = {target_x}: the oracle needs the target in front of the muzzles, x > 0")
    return MUZZLE_Y[cannon] - target_y - target_x**2 / K


def _to_theta(q, target_x):
    return math.atan(q * K / target_x)


def _newton(cubic, q):
    slope = np.polyder(cubic)
    for _ in range(50):
        step = np.polyval(cubic, q) / np.polyval(slope, q)
        if not np.isfinite(step) or abs(step) <= np.spacing(abs(q)):
            break
        q -= step
    return q


def stationary(cannon, target_x, target_y=0.3):
    """Every theta within the limits where dR/dtheta = 0, ascending [rad]."""
    d = _offset(cannon, target_x, target_y)
    cubic = np.array([2 * K, -3 * K, K - 2 * d + W * K / V**2, d])
    roots = np.roots(cubic)
    real = roots.real[np.abs(roots.imag) < 1e-9]  # a cubic always has one
    thetas = sorted(_to_theta(_newton(cubic, q), target_x) for q in real)
    return [theta for theta in thetas if abs(theta) <= THETA_LIMIT]


def best_of(cannon, target_x, target_y=0.3):
    """The best shot of one cannon."""
    thetas = [*stationary(cannon, target_x, target_y), -THETA_LIMIT, THETA_LIMIT]
    return max(
        (Shot(cannon, theta, float(reward(cannon, theta, target_x, target_y))) for theta in thetas),
        key=lambda shot: shot.value,
    )


def best(target_x, target_y=0.3):
    """The best shot of all."""
    return max((best_of(cannon, target_x, target_y) for cannon in MUZZLE_Y), key=lambda shot: shot.value)


def cannon_gap(target_x, target_y=0.3):
    """Best value of the upper cannon minus best value of the lower one [m^2]."""
    return best_of("upper", target_x, target_y).value - best_of("lower", target_x, target_y).value


def arcs(cannon, target_x, target_y=0.3):
    """The low and the high theta that hit the target exactly [rad], or None out of reach."""
    d = _offset(cannon, target_x, target_y)
    square = 0.25 + d / K
    if square < 0:
        return None
    high = 0.5 + math.sqrt(square)
    low = -d / K / high  # their product is -d / K; the difference of near equals would lose digits
    return _to_theta(low, target_x), _to_theta(high, target_x)


def reach(cannon, target_y=0.3):
    """The farthest target_x that the cannon can hit [m]: where 1/4 + d / K = 0."""
    return math.sqrt(K * (K / 4 + MUZZLE_Y[cannon] - target_y))
