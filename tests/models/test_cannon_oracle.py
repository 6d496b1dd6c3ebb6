import itertools
import math

import cannon_oracle as oracle
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

CANNONS = ["lower", "upper"]
TARGETS = [1e-3, 0.01, 0.05, 0.1, 0.15, 0.3, 0.5, 0.54, 0.545, 0.9, 1.3, 1.327, 1.33, 1.5, 3.0]  # [m]
HEIGHTS = [0.3, 0.0, 0.8, -1.0]  # [m]


def brute_force(cannon, x, y):
    """Best value of 200,000 thetas, spaced so that steep shots are seen too, then of the cells around it."""
    limit = math.tan(oracle.THETA_LIMIT)
    u = np.concatenate([np.linspace(-limit, limit, 100_000), np.tan(np.linspace(-1.57, 1.57, 100_000))])
    theta = np.unique(np.clip(np.arctan(u), -oracle.THETA_LIMIT, oracle.THETA_LIMIT))
    values = oracle.reward(cannon, theta, x, y)
    i = int(np.argmax(values))
    low, high = theta[max(i - 1, 0)], theta[min(i + 1, theta.size - 1)]
    for _ in range(4):  # each round divides the cell by 500
        cell = np.linspace(low, high, 1001)
        j = int(np.argmax(oracle.reward(cannon, cell, x, y)))
        low, high = cell[max(j - 1, 0)], cell[min(j + 1, 1000)]
    return float(oracle.reward(cannon, cell, x, y).max())


@pytest.mark.parametrize("y", HEIGHTS)
@pytest.mark.parametrize("x", TARGETS)
@pytest.mark.parametrize("cannon", CANNONS)
def test_best_agrees_with_brute_force(cannon, x, y):
    shot = oracle.best_of(cannon, x, y)
    assert abs(shot.theta) <= oracle.THETA_LIMIT
    assert shot.value == pytest.approx(brute_force(cannon, x, y), rel=1e-9, abs=1e-13)


@pytest.mark.parametrize("x", TARGETS)
@pytest.mark.parametrize("cannon", CANNONS)
def test_stationary_points_are_all_there_is(cannon, x):
    """Between two neighbours R is monotone, at each it turns; R' by differences of R along u = tan(theta)."""
    found = np.tan(oracle.stationary(cannon, x))
    limit = math.tan(oracle.THETA_LIMIT)
    edges = np.concatenate([[-limit], found, [limit]])
    signs = []
    for low, high in itertools.pairwise(edges):
        u = np.linspace(low, high, 2001)[1:-1]
        steps = np.sign(np.diff(oracle.reward(cannon, np.arctan(u), x))[5:-5])  # flat at the ends
        assert np.all(steps == steps[0])
        signs.append(steps[0])
    assert signs == [(-1) ** i for i in range(len(signs))]  # up, down, up, down


@pytest.mark.parametrize("x", TARGETS)
@pytest.mark.parametrize("cannon", CANNONS)
def test_stationary_points_are_exact_to_the_last_digits(cannon, x):
    """What one more Newton step on R(u) would gain or lose is below the rounding of R itself."""
    for theta in oracle.stationary(cannon, x):
        u = math.tan(theta)
        a = oracle.G * x**2 / (2 * oracle.V**2)
        miss = oracle.MUZZLE_Y[cannon] - 0.3 - a + x * u - a * u**2
        first = -2 * miss * (x - 2 * a * u) - 2 * oracle.W * x**2 * u / oracle.V**2
        second = -2 * (x - 2 * a * u) ** 2 + 4 * a * miss - 2 * oracle.W * x**2 / oracle.V**2
        assert abs(first**2 / second) <= 1e-25


def test_best_is_the_better_cannon():
    for x in TARGETS:
        shots = [oracle.best_of(cannon, x) for cannon in CANNONS]
        assert oracle.best(x) == max(shots, key=lambda shot: shot.value)
        assert oracle.cannon_gap(x) == shots[1].value - shots[0].value


def test_a_bound_can_be_best():
    """So near to the target that 1.57 rad is too flat for a lofted shot, and -1.57 for one down."""
    assert oracle.best_of("lower", 1e-4).theta == oracle.THETA_LIMIT
    assert oracle.best_of("upper", 1e-4).theta == -oracle.THETA_LIMIT


@pytest.mark.parametrize("cannon", CANNONS)
def test_arcs_hit_the_target(cannon):
    for x in np.arange(0.01, oracle.reach(cannon), 0.01):
        low, high = oracle.arcs(cannon, x)
        assert low < high
        for theta in (low, high):  # what reward is left is the time's
            seconds = x / (oracle.V * math.cos(theta))
            miss_squared = -oracle.reward(cannon, theta, x) - oracle.W * seconds**2
            assert miss_squared == pytest.approx(0.0, abs=1e-15)


def test_best_is_near_the_low_arc():
    for cannon, x in [("lower", 0.1), ("lower", 0.5), ("upper", 0.5), ("upper", 1.2)]:
        low, _high = oracle.arcs(cannon, x)
        assert oracle.best_of(cannon, x).theta == pytest.approx(low, abs=2e-3)


@pytest.mark.parametrize("cannon", CANNONS)
def test_reach(cannon):
    """The farthest x at which the best shot's miss is nil without the time's weight, by search."""
    reach = oracle.reach(cannon)
    assert oracle.arcs(cannon, reach * (1 - 1e-9)) is not None
    assert oracle.arcs(cannon, reach * (1 + 1e-9)) is None

    def shortfall(x):
        found = minimize_scalar(
            lambda u: -(oracle.MUZZLE_Y[cannon] - 0.3 + x * u - oracle.G * x**2 * (1 + u**2) / 18),
            bounds=(-5, 5),
            method="bounded",
            options={"xatol": 1e-10},
        )
        return found.fun

    assert reach == pytest.approx(brentq(shortfall, 0.1, 3.0), abs=1e-9)


def test_published_figures():
    """The paper's figure 3 ends the lower cannon's solutions at 0.54 m and the upper's at 1.32 m."""
    assert oracle.reach("lower") == pytest.approx(0.541, abs=1e-3)
    assert oracle.reach("upper") == pytest.approx(1.327, abs=1e-3)


def test_the_lower_cannon_is_best_near_by_only():
    change = brentq(oracle.cannon_gap, 0.05, 0.3)
    assert change == pytest.approx(0.154, abs=1e-3)
    for x in np.arange(0.01, 1.5, 0.01):
        assert oracle.best(x).cannon == ("lower" if x < change else "upper")


def test_targets_behind_are_refused():
    for x in (0.0, -0.1, math.nan):
        with pytest.raises(ValueError, match="x > 0"):
            oracle.best(x)
