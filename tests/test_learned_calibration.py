"""Calibration against closed forms: predictions that are right, too narrow, too wide, and correlated."""

import math
import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from small_tasks import refuses

import symgraph as sg
from symgraph.learned import StochasticNetwork, calibrate

COVARIANCE = np.array([[4.0, 1.2], [1.2, 1.0]])
N = 20_000


class Known:
    """Predicts N(x, covariance), whatever the truth is."""

    def __init__(self, covariance=COVARIANCE, writes=None):
        self.writes = writes or {"place": 2}
        self.covariance = np.asarray(covariance, dtype=float)

    def predict(self, x):
        return x, np.broadcast_to(self.covariance, (len(x), *self.covariance.shape))


ONE_OUTPUT = Known([[1.0]], {"y": 1})


@pytest.fixture(scope="module")
def sample():
    """Means, and what happened under COVARIANCE."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-3, 3, (N, 2))
    return x, x + rng.multivariate_normal(np.zeros(2), COVARIANCE, N)


def test_right_predictions_have_the_scores_of_their_distribution(sample):
    """E log N = -½ log((2πe)ᵐ|Σ|), RMSE = σ, E CRPS = σ/√π; tolerances are five standard errors."""
    report = calibrate(Known(), *sample)
    assert list(report.outputs) == ["place[0]", "place[1]"]
    for i, scores in enumerate(report.outputs.values()):
        sd = math.sqrt(COVARIANCE[i, i])
        assert scores.log_likelihood == pytest.approx(-0.5 * math.log(2 * math.pi * math.e * sd**2), abs=0.026)
        assert scores.rmse == pytest.approx(sd, rel=0.026)
        assert scores.crps == pytest.approx(sd / math.sqrt(math.pi), rel=0.026)
        for level, share in scores.coverage.items():
            assert share == pytest.approx(level, abs=5 * math.sqrt(level * (1 - level) / N))
    joint = -0.5 * math.log((2 * math.pi * math.e) ** 2 * np.linalg.det(COVARIANCE))
    assert report.overall.log_likelihood == pytest.approx(joint, abs=0.036)
    assert report.overall.coverage.keys() == {0.68, 0.95}
    assert report.overall.rmse == pytest.approx(math.sqrt(2.5), rel=0.026)


def test_right_predictions_have_uniform_pits(sample):
    report = calibrate(Known(), *sample, bins=20)
    for label, histogram in report.histograms.items():
        assert stats.kstest(report.pit[label], "uniform").pvalue > 1e-3
        assert histogram.counts.sum() == N
        assert len(histogram.counts) == 20
        assert histogram.uniform


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_deviations_show(sample, factor):
    """The interval that claims 68 % holds P(|Z| ≤ factor · quantile)."""
    report = calibrate(Known(factor**2 * COVARIANCE), *sample)
    for label, scores in report.outputs.items():
        for level, share in scores.coverage.items():
            true = 1 - 2 * stats.norm.sf(factor * stats.norm.ppf(0.5 + level / 2))
            assert share == pytest.approx(true, abs=5 * math.sqrt(true * (1 - true) / N))
        counts = report.histograms[label].counts
        assert not report.histograms[label].uniform
        assert (counts[0] > counts[4]) == (factor < 1)  # horns or a hump
    assert "not uniform" in str(report)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_scores_are_those_of_scipy(seed):
    """Also in units that differ by twelve orders of magnitude; the CRPS as an integral."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-6, 6, 2)
    root = rng.standard_normal((2, 2)) * units[:, None]
    covariance = root @ root.T
    x, y = rng.standard_normal((2, 3, 2)) * units
    report = calibrate(Known(covariance), x, y)
    # Scaled back, since scipy takes such a covariance for singular; det of the scaling adds to the log.
    scaled = stats.multivariate_normal([0, 0], covariance / np.outer(units, units), allow_singular=True)
    expected = np.mean(scaled.logpdf((y - x) / units)) - np.log(units).sum()
    assert report.overall.log_likelihood == pytest.approx(expected, rel=1e-5, abs=1e-5)
    for i, (label, scores) in enumerate(report.outputs.items()):
        predicted = stats.norm(x[:, i], math.sqrt(covariance[i, i]))
        assert scores.log_likelihood == pytest.approx(np.mean(predicted.logpdf(y[:, i])), rel=1e-9, abs=1e-9)
        np.testing.assert_allclose(report.pit[label], predicted.cdf(y[:, i]), rtol=1e-9, atol=1e-12)
        assert scores.rmse == pytest.approx(math.sqrt(np.mean((y - x)[:, i] ** 2)), rel=1e-12)


def test_crps_is_its_integral():
    sd, y = 1.7, 0.6
    below = integrate.quad(lambda t: stats.norm.cdf(t, 0, sd) ** 2, -40, y)[0]
    above = integrate.quad(lambda t: stats.norm.sf(t, 0, sd) ** 2, y, 40)[0]
    report = calibrate(Known([[sd**2]] * np.eye(2)), [[0.0, 0.0]], [[y, y]])
    assert report.overall.crps == pytest.approx(below + above, rel=1e-9)


def test_certain_predictions_have_their_limits():
    """σ = 0: no density, the absolute error as CRPS, and what hits the mean lies inside every interval."""
    report = calibrate(Known(np.diag([0.0, 1.0])), [[0.0, 0.0]] * 4, [[0.0, 0.0], [1.0, 0.0], [-3.0, 0.0], [0.0, 0.0]])
    certain = report.outputs["place[0]"]
    assert certain.log_likelihood == report.overall.log_likelihood == -math.inf
    assert certain.crps == 1.0
    assert certain.coverage == {0.68: 0.5, 0.95: 0.5}
    np.testing.assert_array_equal(report.pit["place[0]"], [0.5, 1.0, 0.0, 0.5])
    assert "-inf" in str(report)
    plt.close(report.plot())


def test_outputs_that_are_bound_to_each_other_have_no_joint_density():
    report = calibrate(Known(np.ones((2, 2))), [[0.0, 0.0]], [[1.0, 1.0]])
    assert report.overall.log_likelihood == -math.inf
    assert report.outputs["place[0]"].log_likelihood == pytest.approx(stats.norm.logpdf(1.0))


def test_the_band_holds_uniform_counts_together():
    """In 19 of 20 histograms of uniform values, or a few more, all counts lie in the band."""
    rng = np.random.default_rng(1)
    y = rng.standard_normal((500, 200))
    inside = [calibrate(ONE_OUTPUT, np.zeros(200), row).histograms["y"].uniform for row in y]
    assert 0.94 <= np.mean(inside) <= 0.99


def test_the_table_names_the_outputs(sample):
    lines = str(calibrate(Known(writes=("left", "right")), *sample)).splitlines()
    assert lines[0] == "20000 held-out samples"
    assert lines[1].split() == ["output", "log-likelihood", "RMSE", "CRPS", "in", "68%", "in", "95%", "PIT"]
    assert [line.split()[0] for line in lines[2:]] == ["left", "right", "all"]
    assert len(str(calibrate(ONE_OUTPUT, [0.0], [0.1])).splitlines()) == 3


def test_the_figure_shows_every_output(sample):
    report = calibrate(Known(), *(array[:300] for array in sample))
    figure = report.plot()
    assert [axes.get_title() for axes in figure.axes] == ["place[0]", "place[0]", "place[1]", "place[1]"]
    histogram, deviations = figure.axes[:2]
    np.testing.assert_array_equal(histogram.patches[0].get_data().values, report.histograms["place[0]"].counts)
    _, binned, _ = deviations.lines
    np.testing.assert_allclose(binned.get_xdata(), 2.0)
    groups = np.array_split(np.arange(300), len(binned.get_ydata()))
    expected = [math.sqrt(np.mean(report.errors[group, 0] ** 2)) for group in groups]
    np.testing.assert_allclose(binned.get_ydata(), expected)
    plt.close(figure)


def test_a_network_is_calibrated_on_what_it_has_not_seen():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (400, 1))
    y = x + (0.1 + 0.4 * (x > 0)) * rng.standard_normal((400, 1))
    network = StochasticNetwork({"x": 1}, {"y": 1}, (16, 16))
    network.fit(x[:300], y[:300], progress=False)
    report = calibrate(network, x[300:, 0], y[300:, 0])
    assert report.samples == 100
    assert report.overall.log_likelihood == pytest.approx(report.outputs["y"].log_likelihood, rel=1e-12)
    assert 0.5 < report.overall.coverage[0.68] < 0.85
    low, high = (report.sd[side, 0].mean() for side in (x[300:, 0] < 0, x[300:, 0] > 0))
    assert high > 2 * low


class Alone(Known):
    def predict(self, x):
        return x


class Wrong(Known):
    def __init__(self, mean, covariance):
        super().__init__()
        self.predicted = np.asarray(mean), np.asarray(covariance)

    def predict(self, x):
        return self.predicted


GOOD = [[0.0, 0.0]], [np.eye(2)]
REFUSED = {
    "y": (lambda: calibrate(Known(), [[0, 0]], [0.0]), ["y has shape", "(N, 2)"]),
    "rows": (lambda: calibrate(Known(), [[0, 0]], [[0, 0], [1, 1]]), ["x has 1 rows, y 2"]),
    "nan": (lambda: calibrate(Known(), [[0, np.nan]], [[0, 0]]), ["x[0]", "not finite"]),
    "empty": (lambda: calibrate(Known(), np.zeros((0, 2)), np.zeros((0, 2))), ["x has no rows"]),
    "words": (lambda: calibrate(Known(), "a", [[0, 0]]), ["x = 'a' is not a number"]),
    "no rows": (lambda: calibrate(Known(), 1.0, [[0, 0]]), ["x has shape ()"]),
    "bins": (lambda: calibrate(Known(), [[0, 0]], [[0, 0]], bins=0), ["bins is 0"]),
    "no pair": (lambda: calibrate(Alone(), [[0, 0]], [[0, 0]]), ["predict returned a ndarray", "pair"]),
    "mean": (lambda: calibrate(Wrong([0.0, 0.0], GOOD[1]), *2 * GOOD[:1]), ["mean of shape (2,)", "(1, 2)"]),
    "covariance": (lambda: calibrate(Wrong(GOOD[0], np.eye(2)), *2 * GOOD[:1]), ["covariance of shape", "(1, 2, 2)"]),
    "negative": (lambda: calibrate(Wrong(GOOD[0], [-np.eye(2)]), *2 * GOOD[:1]), ["x[0]", "no Gaussian", "at least 0"]),
    "infinite": (lambda: calibrate(Wrong([[0.0, np.inf]], GOOD[1]), *2 * GOOD[:1]), ["x[0]", "no Gaussian", "inf"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_calibrated_is_refused(case):
    call, words = REFUSED[case]
    refuses(call, sg.InputError, *words)


def test_missing_packages_name_their_extra(sample, monkeypatch):
    report = calibrate(Known(), *sample)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    refuses(report.plot, sg.MissingExtraError, "symgraph[plots]")
    monkeypatch.setitem(sys.modules, "scoringrules", None)
    refuses(lambda: calibrate(Known(), *sample), sg.MissingExtraError, "symgraph[learned]")


def test_the_import_brings_nothing_heavy():
    code = "import sys, symgraph.learned; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"torch", "safetensors", "matplotlib", "scipy.stats", "scoringrules", "pandas"}
    assert not heavy & set(done.stdout.split())
