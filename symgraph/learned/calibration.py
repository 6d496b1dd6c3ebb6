"""Calibration: whether predictions are as good as they say, on samples that no fit has seen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from symgraph.errors import InputError, MissingExtraError, SlotError
from symgraph.learned.inputs import checked_count, checked_pair, checked_rows
from symgraph.slots import Array, as_numbers

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEVELS = (0.68, 0.95)  # probabilities of the central intervals whose coverage is counted
BAND = 0.95  # probability with which all counts of uniform PITs lie in the band
LEAST_IN_A_BIN = 8  # samples in a bin of predicted deviations, fewer of which say little
MOST_BINS = 10


class Predictor(Protocol):
    """What can be calibrated: a `StochasticNetwork` or anything else that predicts Gaussians.

    `writes` maps labels to numbers of elements; where it only lists labels, each is a scalar.
    """

    @property
    def writes(self) -> Mapping[str, int] | Iterable[str]:
        """The outputs, in the order of the columns of y."""
        ...

    def predict(self, mean: Any, /) -> tuple[Array, Array]:
        """Return means (N, m) and covariances (N, m, m) for inputs (N, n)."""
        ...


@dataclass(frozen=True)
class Scores:
    """How good predictions were, on average over the samples.

    Attributes:
        log_likelihood: log of the predicted density at what was observed [nats]; higher is better, -inf where a
            prediction claims certainty.
        rmse: root mean square error of the mean [unit of the output].
        crps: continuous ranked probability score ∫(F(t) - 1{y ≤ t})² dt [unit of the output]; lower is better, and
            the absolute error where a prediction claims certainty.
        coverage: {level: share of the observations inside the central interval of that probability}.

    Source: Gneiting & Raftery, Strictly proper scoring rules, prediction, and estimation, JASA 2007.
    """

    log_likelihood: float
    rmse: float
    crps: float
    coverage: dict[float, float]


@dataclass(frozen=True)
class PitHistogram:
    """Counts of PIT values in equal bins over [0, 1]: flat for a calibrated prediction.

    A hump in the middle says that predicted deviations are too large, horns at the ends that they are too small, a
    slope that the mean is off.

    Attributes:
        counts: (bins,).
        low, high: with a probability of 95 % *all* counts of uniform values lie in [low, high].

    Source: Gneiting, Balabdaoui & Raftery, Probabilistic forecasts, calibration and sharpness, JRSS B 2007.
    """

    counts: npt.NDArray[np.int64]
    low: int
    high: int

    @property
    def uniform(self) -> bool:
        """Whether all counts lie in the band."""
        return bool(((self.counts >= self.low) & (self.counts <= self.high)).all())


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` found; printed, it is a table.

    Attributes:
        samples: how many there were.
        outputs: {output: scores}; an element of a vector is "label[i]".
        overall: of all outputs together: the log-likelihood is that of the joint density under the full covariance,
            the others are pooled, which says something where the outputs share a unit.
        pit: {output: (N,) values Φ((y - mean)/σ)}, uniform over [0, 1] for a calibrated prediction.
        histograms: {output: its histogram}.
        errors: (N, m) y - mean [units of the outputs].
        sd: (N, m) σ, predicted [units of the outputs].
    """

    samples: int
    outputs: dict[str, Scores]
    overall: Scores
    pit: dict[str, Array]
    histograms: dict[str, PitHistogram]
    errors: Array = field(repr=False)
    sd: Array = field(repr=False)

    def __str__(self) -> str:
        rows = [["output", "log-likelihood", "RMSE", "CRPS", *(f"in {level:.0%}" for level in LEVELS), "PIT"]]
        for label, scores in self.outputs.items():
            rows.append([label, *_cells(scores), "uniform" if self.histograms[label].uniform else "not uniform"])
        if len(self.outputs) > 1:
            rows.append(["all", *_cells(self.overall), ""])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        aligned = (
            "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
            for row in rows
        )
        return "\n".join([f"{self.samples} held-out samples", *(line.rstrip() for line in aligned)])

    def plot(self) -> Figure:
        """Draw for each output the PIT histogram with its band, and errors over predicted deviations.

        Returns:
            a matplotlib figure; `figure.savefig("calibration.png")` writes it to a file.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        try:
            import matplotlib.pyplot as plt
        except ImportError:
            raise MissingExtraError("matplotlib", "plots", "Calibration.plot") from None
        rows = len(self.outputs)
        figure, panels = plt.subplots(rows, 2, figsize=(8.0, 3.2 * rows), layout="constrained", squeeze=False)
        for i, label in enumerate(self.outputs):
            for axes in panels[i]:
                for side in ("top", "right"):
                    axes.spines[side].set_visible(False)
            _draw_histogram(panels[i, 0], label, self.histograms[label])
            _draw_deviations(panels[i, 1], label, np.abs(self.errors[:, i]), self.sd[:, i])
        return figure


def calibrate(network: Predictor, x: Any, y: Any, *, bins: int = 10) -> Calibration:
    """Compare predictions with what was observed, on samples that the network was not fitted to.

    Args:
        network: what predicts: `predict(x)` returns means (N, m) and covariances (N, m, m), `writes` names the outputs.
        x: (N, n) inputs [their units].
        y: (N, m) observed outputs [their units].
        bins: of the PIT histograms.

    Raises:
        InputError: arrays of other shapes, numbers that are not finite, predictions that are no Gaussians.
        MissingExtraError: scoringrules is not installed.
    """
    labels = _elements(network.writes)
    try:
        columns = as_numbers(x, "x")
    except SlotError as error:
        raise InputError(str(error)) from None
    columns = columns[:, None] if columns.ndim == 1 else columns
    x = checked_rows(columns, columns.shape[-1] if columns.ndim == 2 else 1, "x")
    y = checked_rows(y, len(labels), "y")
    checked_pair(x, y, "calibrate")
    bins = checked_count(bins, "bins")
    mean, covariance = _checked_predictions(network.predict(x), y.shape)
    errors, sd = y - mean, np.sqrt(covariance.diagonal(axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(errors == 0, 0.0, errors / sd)  # what hits its mean lies in its middle, even when certain
    pit, density, crps = _cdf(z), _log_density(z, sd), _crps(errors, sd)
    histograms = [_histogram(column, bins) for column in pit.T]

    def scores(columns: slice, log_likelihood: Array) -> Scores:
        coverage = {level: float(np.mean(np.abs(z[:, columns]) <= _quantile(level))) for level in LEVELS}
        rmse = math.sqrt(np.mean(errors[:, columns] ** 2))
        return Scores(float(np.mean(log_likelihood)), rmse, float(np.mean(crps[:, columns])), coverage)

    return Calibration(
        samples=len(x),
        outputs={label: scores(slice(i, i + 1), density[:, i]) for i, label in enumerate(labels)},
        overall=scores(slice(None), _joint_log_density(errors, sd, covariance)),
        pit=dict(zip(labels, pit.T, strict=True)),
        histograms=dict(zip(labels, histograms, strict=True)),
        errors=errors,
        sd=sd,
    )


def _elements(writes: Mapping[str, int] | Iterable[str]) -> list[str]:
    """Return a name for each column of y."""
    sizes = writes if isinstance(writes, Mapping) else dict.fromkeys(writes, 1)
    return [label if size == 1 else f"{label}[{element}]" for label, size in sizes.items() for element in range(size)]


def _checked_predictions(predicted: Any, shape: tuple[int, ...]) -> tuple[Array, Array]:
    n, m = shape
    if not isinstance(predicted, tuple) or len(predicted) != 2:
        raise InputError(f"predict returned a {type(predicted).__name__}; return a pair, means and covariances")
    mean, covariance = (np.asarray(array, dtype=float) for array in predicted)
    if mean.shape != (n, m) or covariance.shape != (n, m, m):
        raise InputError(
            f"predict returned a mean of shape {mean.shape} and a covariance of shape {covariance.shape} "
            f"for {n} samples of {m} outputs; return ({n}, {m}) and ({n}, {m}, {m})"
        )
    good = np.isfinite(mean).all(1) & np.isfinite(covariance).all((1, 2))
    good &= (covariance.diagonal(axis1=1, axis2=2) >= 0).all(1)
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise InputError(
            f"the prediction for x[{row}] is no Gaussian: mean {mean[row].tolist()}, covariance "
            f"{covariance[row].tolist()}; predict finite numbers and variances of at least 0"
        )
    return mean, covariance


def _cdf(z: Array) -> Array:
    from scipy.special import ndtr

    return np.asarray(ndtr(z), dtype=float)


def _quantile(level: float) -> float:
    """Return z with P(|Z| ≤ z) = level."""
    from scipy.special import ndtri

    return float(ndtri(0.5 + 0.5 * level))


def _log_density(z: Array, sd: Array) -> Array:
    """Return log N(y; mean, σ²) for z = (y - mean)/σ; -inf where σ = 0, since certainty has no density."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sd > 0, -0.5 * z**2 - np.log(sd) - 0.5 * math.log(2 * math.pi), -np.inf)


def _joint_log_density(errors: Array, sd: Array, covariance: Array) -> Array:
    """Return log N(y; mean, Σ) (N,), along the eigenvectors of the correlations, so that units may differ widely."""
    scale = np.where(sd > 0, sd, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / (scale[:, :, None] * scale[:, None, :]))
    along = np.einsum("nij,ni->nj", vectors, errors / scale)
    # Rounding leaves a variance of zero a little off it.
    spread = np.sqrt(np.where(eigenvalues > 1e-12, eigenvalues, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((_log_density(along / spread, spread) - np.log(scale)).sum(axis=1))


def _crps(errors: Array, sd: Array) -> Array:
    """Return σ(z(2Φ(z) - 1) + 2φ(z) - 1/√π), and its limit |y - mean| where σ = 0."""
    try:
        import scoringrules
    except ImportError as error:
        raise MissingExtraError("scoringrules", "learned", "calibrate") from error
    certain = sd == 0
    spread = np.where(certain, 1.0, sd)
    return np.where(certain, np.abs(errors), scoringrules.crps_normal(errors, 0.0, spread))


def _histogram(pit: Array, bins: int) -> PitHistogram:
    """Return counts, and the band of a binomial count: by Bonferroni, so that it holds for all bins at once."""
    from scipy.stats import binom

    low, high = binom.interval(1 - (1 - BAND) / bins, len(pit), 1 / bins)
    return PitHistogram(np.histogram(pit, bins, (0.0, 1.0))[0], int(low), int(high))


def _cells(scores: Scores) -> list[str]:
    shares = [f"{scores.coverage[level]:.1%}" for level in LEVELS]
    return [f"{scores.log_likelihood:.3f}", f"{scores.rmse:.4g}", f"{scores.crps:.4g}", *shares]


def _draw_histogram(axes: Axes, label: str, histogram: PitHistogram) -> None:
    bins = len(histogram.counts)
    edges, top = np.linspace(0.0, 1.0, bins + 1), 1.3 * max(histogram.high, int(histogram.counts.max()))
    axes.stairs(histogram.counts, edges, fill=True, color="C0", alpha=0.5)
    axes.axhspan(
        histogram.low, histogram.high, color="black", alpha=0.15, lw=0, label=f"band of uniform PITs, {BAND:.0%}"
    )
    axes.set(xlim=(0, 1), ylim=(0, top), title=label, xlabel="PIT = Φ((y − mean) / sd)", ylabel="samples")
    axes.legend(frameon=False, loc="upper center")


def _draw_deviations(axes: Axes, label: str, errors: Array, sd: Array) -> None:
    """Draw |error| over σ, and root mean squares of both in bins of equally many samples."""
    order = np.argsort(sd, kind="stable")
    count = max(1, min(MOST_BINS, len(sd) // LEAST_IN_A_BIN))
    groups = [group for group in np.array_split(order, count) if len(group)]
    predicted, observed = (
        np.array([math.sqrt(np.mean(values[group] ** 2)) for group in groups]) for values in (sd, errors)
    )
    axes.plot(sd, errors, ".", color="C0", ms=3, alpha=0.4, label="samples")
    axes.plot(predicted, observed, "o-", color="C1", ms=4, label="root mean square")
    end = float(max(sd.max(), observed.max()))
    axes.plot([0, end], [0, end], color="black", lw=0.8, ls="--", label="calibrated")
    axes.set(title=label, xlabel="predicted sd", ylabel="|error|")
    axes.legend(frameon=False)
