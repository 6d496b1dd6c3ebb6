"""Gaussians through networks: where each rule is exact, its limits, and how near it comes elsewhere."""

import itertools

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from small_tasks import assert_close

from symgraph.cubature import square_root
from symgraph.learned import gaussians
from symgraph.learned.gaussians import MOST_SPLIT, RULES, pass_through

SPREADING = [rule for rule in RULES if rule != "mean"]
KEEPS_COVARIANCES = ["auto", "split", "low-rank", "full", "full-exact", "quadrature"]


def network(rng, sizes, shift=0.0):
    """Weights of He's size, and biases; `shift` is added to those of hidden units."""
    layers = []
    for i, (n, m) in enumerate(itertools.pairwise(sizes)):
        last = i == len(sizes) - 2
        layers.append((rng.normal(size=(m, n)) * np.sqrt(2 / n), rng.normal(size=m) * 0.5 + (0 if last else shift)))
    return layers


def plain(layers, x):
    """(N, n) → (N, m)."""
    for w, b in layers[:-1]:
        x = np.maximum(0, x @ w.T + b)
    return x @ layers[-1][0].T + layers[-1][1]


def slope(layers, x):
    """The Jacobian (m, n) at x (n,)."""
    product = np.eye(len(x))
    for w, b in layers[:-1]:
        x = w @ x + b
        product = (x > 0)[:, None] * (w @ product)
        x = np.maximum(0, x)
    return layers[-1][0] @ product


def symbolic(layers):
    return [(ca.MX(ca.DM(w)), ca.MX(ca.DM(b))) for w, b in layers]


def propagation(rule, layers, through=pass_through):
    """(mean, Σ) → mean, covariance, and the derivatives of both by both."""
    n = layers[0][0].shape[1]
    mean, sigma = ca.MX.sym("mean", n), ca.MX.sym("sigma", n, n)
    mixture = through(rule, symbolic(layers), mean, square_root(sigma))
    results = [mixture.mean, ca.densify(mixture.covariance())]
    slopes = [ca.jacobian(r, x) for r in results for x in (mean, sigma)]
    function = ca.Function("f", [mean, sigma], results + slopes)
    return lambda m, s: [np.array(r) for r in function(m, s)]


def random_covariance(rng, n, size=1.0):
    root = rng.normal(size=(n, n)) * size
    return root @ root.T + 0.1 * size**2 * np.eye(n)


# Where nothing is lost


@pytest.mark.parametrize("rule", RULES)
def test_a_network_without_hidden_layers_is_exact(rule):
    """To rounding; the points of "auto" and "split" leave 1e-16 of weights that do not sum to 1."""
    rng = np.random.default_rng(0)
    layers = network(rng, (3, 2))
    m, s = rng.normal(size=3), random_covariance(rng, 3)
    mean, covariance, *_ = propagation(rule, layers)(m, s)
    w, b = layers[0]
    assert_close(mean[:, 0], w @ m + b)
    assert_close(covariance, np.zeros((2, 2)) if rule == "mean" else w @ s @ w.T, 1e-13)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("inputs", [1, 2, 3, 7])
def test_units_far_above_their_kinks_are_linear(rule, inputs):
    """Means are exact, and covariances wherever those between units are kept.

    With biases of 100, and 1000 numbers of order 1 on the way: 1e-12 of 100 of them squared.
    """
    rng = np.random.default_rng(inputs)
    layers = network(rng, (inputs, 6, 5, 2), shift=100.0)
    layers = [layers[0], (np.abs(layers[1][0]), layers[1][1]), layers[2]]
    m, s = rng.normal(size=inputs), random_covariance(rng, inputs, 0.5)
    mean, covariance, *_ = propagation(rule, layers)(m, s)
    assert_close(mean[:, 0], plain(layers, m[None])[0])
    jacobian = slope(layers, m)
    if rule in KEEPS_COVARIANCES:
        assert_close(covariance, jacobian @ s @ jacobian.T, 1e-10)
    elif rule == "mean":
        assert_close(covariance, np.zeros((2, 2)))
    else:  # what is left when the covariances between units are dropped, layer by layer
        (w0, _), (w1, _), (w2, _) = layers
        variances = (w1**2) @ np.diag(w0 @ s @ w0.T)
        assert_close(covariance, (w2 * variances) @ w2.T, 1e-10)


@pytest.mark.parametrize("rule", SPREADING)
def test_one_hidden_unit_has_no_covariances_to_lose(rule):
    """Every rule is exact about a single open unit."""
    rng = np.random.default_rng(4)
    layers = [(rng.normal(size=(1, 3)), np.array([50.0])), (rng.normal(size=(2, 1)), rng.normal(size=2))]
    m, s = rng.normal(size=3), random_covariance(rng, 3)
    mean, covariance, *_ = propagation(rule, layers)(m, s)
    jacobian = slope(layers, m)
    assert_close(mean[:, 0], plain(layers, m[None])[0])
    assert_close(covariance, jacobian @ s @ jacobian.T, 1e-11)


# Little variance, and none


def away_from_kinks(layers, rng):
    """A point at which every unit is at least 0.02 from its kink."""
    while True:
        x = point = rng.normal(size=layers[0][0].shape[1])
        nearest = np.inf
        for w, b in layers[:-1]:
            x = w @ x + b
            nearest, x = min(nearest, np.abs(x).min()), np.maximum(0, x)
        if nearest > 0.02:
            return point


@pytest.mark.parametrize("rule", SPREADING)
@pytest.mark.parametrize("inputs", [1, 2, 8])
def test_little_variance_passes_as_through_the_tangent(rule, inputs):
    """With standard deviations of 1e-4, 100 of which lie between a unit and its kink: mean to 1e-9 and JΣJᵀ.

    "diagonal" and "paper" instead sum the squares of the paths of each unit of the first layer and of later ones. The
    floor of 1e-16 under variances is 1e-8 of these, for each of 8 units and two layers.
    """
    rng = np.random.default_rng(inputs)
    layers = network(rng, (inputs, 8, 8, 2))
    m, s = away_from_kinks(layers, rng), random_covariance(rng, inputs, 1e-5)
    mean, covariance, *_ = propagation(rule, layers)(m, s)
    assert_close(mean[:, 0], plain(layers, m[None])[0], 1e-9)
    jacobian = slope(layers, m)
    expected = jacobian @ s @ jacobian.T
    if rule not in KEEPS_COVARIANCES:
        (w0, b0), (w1, b1), (w2, _) = layers
        first = w0 @ m + b0
        second = w1 @ np.maximum(0, first) + b1
        variances = (second > 0) * ((w1**2) @ ((first > 0) * np.diag(w0 @ s @ w0.T)))
        expected = (w2 * variances) @ w2.T
    np.testing.assert_allclose(covariance, expected, rtol=0, atol=1e-5 * np.trace(expected))


DEGENERATE = {
    "none": np.zeros((2, 2)),
    "tiny": 1e-18 * np.eye(2),
    "one input": np.diag([0.3, 0.0]),
    "the other input": np.diag([0.0, 0.3]),
    "correlation 1": np.array([[0.2, 0.4], [0.4, 0.8]]),
    "correlation -1": np.array([[0.2, -0.4], [-0.4, 0.8]]),
    "large": 1e6 * np.eye(2),
}


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("at_kink", [False, True], ids=["away", "at a kink"])
def test_degenerate_covariances_are_finite_and_limits(rule, at_kink):
    """Near by: with 1e-9 of the identity added, which moves smooth moments by its size, means at a kink by its root."""
    rng = np.random.default_rng(5)
    layers = network(rng, (2, 8, 8, 2))
    m = away_from_kinks(layers, rng)
    if at_kink:  # of a unit of the first layer
        layers[0][1][0] = -layers[0][0][0] @ m
    function = propagation(rule, layers)
    for name, s in DEGENERATE.items():
        results = function(m, s)
        assert all(np.isfinite(r).all() for r in results), name
        if name != "large":
            near = function(m, s + 1e-9 * np.eye(2))
            for got, limit in zip(results[:2], near[:2], strict=True):
                assert_close(got, limit, 3e-4)
    mean, covariance, by_mean, *_ = function(m, np.zeros((2, 2)))
    assert_close(mean[:, 0], plain(layers, m[None])[0], 1e-7)
    assert_close(covariance, np.zeros((2, 2)), 1e-14)
    if not at_kink:
        assert_close(by_mean, slope(layers, m), 1e-9)


@pytest.mark.parametrize("rule", RULES)
def test_without_a_root_the_network_is_the_plain_one(rule):
    rng = np.random.default_rng(6)
    layers = network(rng, (3, 5, 2))
    x = rng.normal(size=3)
    mixture = pass_through(rule, symbolic(layers), ca.MX(ca.DM(x)), None)
    assert_close(np.array(ca.evalf(mixture.mean))[:, 0], plain(layers, x[None])[0])
    assert mixture.covariance().nnz() == 0


# Elsewhere, against sampling

# The mean errors over the networks below in standard deviations of the output: of the mean, and of the deviation.
# They are what the rules leave out, not roundings: about a half more than what was found.
ALLOWED = {
    "auto": (0.035, 0.07),
    "split": (0.035, 0.07),
    "low-rank": (0.065, 0.2),
    "full": (0.05, 0.12),
    "full-exact": (0.05, 0.12),
    "quadrature": (0.03, 0.045),
    "diagonal": (0.1, 1.1),
    "paper": (0.1, 1.1),
}
DRAWS = 200_000


def sampled(number):
    """A small network, an input, and mean and deviation of its output over draws."""
    rng = np.random.default_rng(number)
    inputs = 1 + number % 3
    layers = network(rng, (inputs, 8, 8, 1))
    m, s = rng.normal(size=inputs), random_covariance(rng, inputs, 0.3)
    y = plain(layers, m + rng.normal(size=(DRAWS, inputs)) @ np.linalg.cholesky(s).T)
    return layers, m, s, y.mean(), y.std()


@pytest.fixture(scope="module")
def errors():
    found = {rule: [] for rule in SPREADING}
    for layers, m, s, mean, sd in map(sampled, range(9)):
        if sd < 1e-3:  # a network of shut units has nothing to compare
            continue
        for rule in SPREADING:
            got, covariance, *_ = propagation(rule, layers)(m, s)
            found[rule].append([abs(got[0, 0] - mean) / sd, abs(np.sqrt(covariance[0, 0]) - sd) / sd])
    return {rule: np.mean(rows, axis=0) for rule, rows in found.items()}


@pytest.mark.parametrize("rule", SPREADING)
def test_small_networks_against_sampling(errors, rule):
    """Sampling itself is off by 1/√200,000 = 0.002 of a standard deviation."""
    assert (errors[rule] <= np.array(ALLOWED[rule]) + 0.002).all(), errors[rule]


def test_rules_that_keep_more_are_nearer(errors):
    deviation = {rule: errors[rule][1] for rule in SPREADING}
    assert deviation["split"] < deviation["low-rank"] < 0.7 * deviation["diagonal"]
    assert deviation["full-exact"] < 0.7 * deviation["diagonal"]


# Slopes


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("rule", [rule for rule in SPREADING if rule not in ("paper", "quadrature")])
def test_slopes_of_smooth_rules(rule, seed):
    """Central differences: h = 1e-5, and third derivatives as large as 1/s² where components have little variance."""
    rng = np.random.default_rng(seed)
    layers = network(rng, (2, 6, 5, 2))
    m, s = rng.normal(size=2), random_covariance(rng, 2)
    dm, ds = rng.normal(size=2), rng.normal(size=(2, 2)) * 0.3
    ds += ds.T
    function = propagation(rule, layers)
    _, _, mean_by_mean, mean_by_sigma, spread_by_mean, spread_by_sigma = function(m, s)
    change = ds.ravel(order="F")
    got = np.concatenate([mean_by_mean @ dm + mean_by_sigma @ change, spread_by_mean @ dm + spread_by_sigma @ change])
    h = 1e-5
    (mean, spread), (mean_before, spread_before) = [function(m + k * dm, s + k * ds)[:2] for k in (h, -h)]
    expected = np.concatenate([(mean - mean_before).ravel("F"), (spread - spread_before).ravel("F")]) / (2 * h)
    assert_close(got, expected, 1e-6)


def test_the_paper_has_the_values_of_diagonal_and_its_own_gradient():
    """∂E/∂μ = W₃ diag(Φ₂) W₂ diag(Φ₁) W₁ with Φ = Φ(m/s) of each unit; no variance has a slope."""
    rng = np.random.default_rng(8)
    layers = network(rng, (3, 8, 7, 2))
    m, s = rng.normal(size=3), random_covariance(rng, 3)
    held, full = propagation("paper", layers)(m, s), propagation("diagonal", layers)(m, s)
    for got, expected in zip(held[:2], full[:2], strict=True):
        assert_close(got, expected, 1e-14)
    (w0, b0), (w1, b1), (w2, _) = layers
    mean, variance = w0 @ m + b0, np.diag(w0 @ s @ w0.T)
    product = ndtr(mean / np.sqrt(variance))[:, None] * w0
    # The rectified moments again, written out: E = mΦ + sφ, E² + V = (m² + v)Φ + msφ.
    alpha, sd = mean / np.sqrt(variance), np.sqrt(variance)
    density, gain = np.exp(-(alpha**2) / 2) / np.sqrt(2 * np.pi), ndtr(alpha)
    after = mean * gain + sd * density
    spread = (mean**2 + variance) * gain + mean * sd * density - after**2
    mean, variance = w1 @ after + b1, (w1**2) @ spread
    expected = w2 @ (ndtr(mean / np.sqrt(variance))[:, None] * (w1 @ product))
    _, _, mean_by_mean, mean_by_sigma, spread_by_mean, spread_by_sigma = held
    assert_close(mean_by_mean, expected, 1e-12)
    assert (mean_by_sigma == 0).all()
    assert (spread_by_mean == 0).all()
    assert (spread_by_sigma == 0).all()


# Mixtures


@pytest.mark.parametrize("directions", [1, 3, MOST_SPLIT, MOST_SPLIT + 1])
def test_auto_splits_along_few_directions(directions):
    rng = np.random.default_rng(directions)
    layers = network(rng, (8, 5, 1))
    mean, root = ca.MX(ca.DM(rng.normal(size=8))), ca.MX(ca.DM(rng.normal(size=(8, directions))))
    auto = pass_through("auto", symbolic(layers), mean, root)
    expected = pass_through("split" if directions <= MOST_SPLIT else "low-rank", symbolic(layers), mean, root)
    assert len(auto.weights) == len(expected.weights)
    assert (len(auto.weights) > 1) == (directions <= MOST_SPLIT)
    for got, wanted in [(auto.mean, expected.mean), (auto.covariance(), expected.covariance())]:
        assert_close(np.array(ca.evalf(got)), np.array(ca.evalf(wanted)), 1e-15)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), inputs=st.integers(1, 8), outputs=st.integers(1, 4))
def test_covariances_are_symmetric_and_positive_semidefinite(seed, inputs, outputs):
    """To rounding; "full-exact" to the 1e-7 of its integral, the series of "full" promises it of variances alone."""
    rng = np.random.default_rng(seed)
    layers = network(rng, (inputs, 6, 5, outputs))
    m, s = rng.normal(size=inputs), random_covariance(rng, inputs)
    for rule in SPREADING:
        mean, covariance, *_ = propagation(rule, layers)(m, s)
        size = np.trace(covariance)
        assert_close(covariance, covariance.T, 1e-14)
        if rule != "full":
            assert np.linalg.eigvalsh(covariance)[0] >= -(1e-5 if rule == "full-exact" else 1e-13) * (1 + size)
        mixture = pass_through(rule, symbolic(layers), ca.MX(ca.DM(m)), square_root(ca.MX(ca.DM(s))))
        assert_close(mixture.weights.sum(), 1)
        if mixture.variances is not None:  # the law of total variance, from the components
            means, variances = np.array(ca.evalf(mixture.means)), np.array(ca.evalf(mixture.variances))
            total = variances @ mixture.weights + (means - mean) ** 2 @ mixture.weights
            assert_close(np.diag(covariance), total, 1e-12)
            parts = [np.array(ca.evalf(mixture.covariance_of(k))) for k in range(len(mixture.weights))]
            for part, variance in zip(parts, variances.T, strict=True):
                assert_close(np.diag(part), variance, 1e-12)
            within = sum(weight * part for weight, part in zip(mixture.weights, parts, strict=True))
            assert_close(within, np.array(ca.evalf(mixture.within)), 1e-12)


def test_every_rule_serves_many_directions():
    rng = np.random.default_rng(0)
    layers = network(rng, (gaussians.MOST_SPLIT + 4, 5, 2))
    n = gaussians.MOST_SPLIT + 4
    for rule in RULES:
        assert all(np.isfinite(r).all() for r in propagation(rule, layers)(rng.normal(size=n), 0.1 * np.eye(n)))
