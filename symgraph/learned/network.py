"""StochasticNetwork: a model learned from samples, with its own uncertainty."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from symgraph.compile.interpreted import FlatFunction
from symgraph.cubature import gauss_hermite, square_root
from symgraph.errors import InputError, SlotError
from symgraph.learned import losses
from symgraph.learned.base import Experience, LearnedModel, layer_sizes
from symgraph.learned.gaussians import Mixture, pass_through
from symgraph.learned.inputs import (
    checked_number,
    checked_option,
    checked_pair,
    checked_rows,
    checked_seed,
    checked_sizes,
)
from symgraph.learned.learner import Learner, Memory, Schedule
from symgraph.learned.perceptron import Perceptron, Scaling
from symgraph.learned.snapshot import Layout, layer_shapes
from symgraph.model import Parameter
from symgraph.progress import Progress
from symgraph.slots import Array, Gaussian, as_covariance, as_numbers

Start = Literal["random", "linear"]
STARTS: tuple[Start, ...] = ("random", "linear")
ErrorModel = Literal["likelihood", "paper", "none"]
ERROR_MODELS: tuple[ErrorModel, ...] = ("likelihood", "paper", "none")
HERMITE = 5  # points for the expectation over one output of the error network
MOST_DECAY = 1e12  # far more than leaves any slope; training squares it in single precision


@dataclass(frozen=True)
class FitReport:
    """What a fit did.

    Attributes:
        samples: how many there were.
        warm: whether it went on from the weights of the fit before.
        steps: of the mean network and of the error network.
        rmse: (m,) root mean square error on samples that were left out, which without decay also decided when to stop
            [units of the outputs].
        seconds: wall time [s].
    """

    samples: int
    warm: bool
    steps: tuple[int, ...]
    rmse: Array
    seconds: float

    def __str__(self) -> str:
        errors = ", ".join(f"{error:.3g}" for error in self.rmse) if self.samples > 1 else "unknown"
        how = "warm" if self.warm else "from scratch"
        steps = " + ".join(map(str, self.steps))
        return f"{self.samples} samples, {how}, {steps} steps in {self.seconds:.2f} s; held-out RMSE {errors}"


@dataclass
class NetworkExperience(Experience):
    """The learners of mean and error, and where their networks stand."""

    mean_learner: Learner = field(default_factory=Learner)
    error_learner: Learner = field(default_factory=Learner)
    mean: Memory | None = None
    error: Memory | None = None


class StochasticNetwork(LearnedModel):
    """A network of rectified linear units that predicts a mean and its own error, and propagates Gaussians.

    y ~ N(f(x), diag(σ²(x))) for an exact x; for x ~ N(μ, Σ) mean and covariance of f are propagated through the layers
    and E[σ²(x)] is added (with the paper's error model (E σ(x))²).

    Args:
        reads: {label: number of elements} of the inputs, in the order of the columns of x.
        writes: {label: number of elements} of the outputs, likewise.
        hidden: units in each hidden layer, of the mean network and of the error network alike.
        propagation: how Gaussians pass, see the guide: "auto" (default), "split", "low-rank", "full", "full-exact",
            "quadrature", "diagonal", "paper", "mean".
        error: "likelihood" (default): σ maximises the likelihood of errors on samples that were left out; "paper":
            the paper's asymmetric loss on errors of the training samples; "none": σ = 0.
        start: where a fit from scratch begins: "random" (default) weights, or "linear", the ridge regression that
            predicts best the samples that were left out: better where samples are few and inputs many, worse where
            outliers lie far from all others.
        decay: λ of weight decay: the mean network minimises Σ error² + λ Σ weight², errors of all samples and outputs
            in standard deviations, weights but for biases and what only hands a linear start on, and does not stop
            early; 0 (default): it stops where held-out samples are predicted best.
        samples_needed: with fewer, plans that need the network explore.
        resolution: {label: standard deviation, a number or one for each element} up to which an input is taken for a
            constant that carries noise, of which nothing is learned; 0 where left out [units of the inputs].
        name: shown in messages and pictures.

    Raises:
        InputError: labels, sizes or options that make no network.

    Source: Yamaguchi & Atkeson, Humanoids 2016, section V; ICRA 2016.
    """

    def __init__(
        self,
        reads: Mapping[str, int],
        writes: Mapping[str, int],
        hidden: Sequence[int] = (200, 200, 200),
        *,
        propagation: str = "auto",
        error: ErrorModel = "likelihood",
        start: Start = "random",
        decay: float = 0.0,
        samples_needed: int = 3,
        resolution: Mapping[str, Any] | None = None,
        name: str = "network",
    ) -> None:
        super().__init__(reads, hidden, propagation, samples_needed, resolution, name)
        self.writes = checked_sizes(writes, f"{self.name}: writes")
        self.error = checked_option(error, ERROR_MODELS, f"{self.name}: error")
        self.start = checked_option(start, STARTS, f"{self.name}: start")
        self.decay = checked_number(decay, f"{self.name}: decay", MOST_DECAY)
        sizes = (sum(self.reads.values()), *self.hidden, sum(self.writes.values()))
        self._mean = Perceptron(sizes, f"{self.name}_mean")
        self._error = Perceptron(sizes, f"{self.name}_error")
        self._error_scale = Parameter(np.ones(sizes[-1]), f"{self.name}_error_scale")  # [units of the outputs]
        self._experience: NetworkExperience = NetworkExperience()
        # (mean, covariance) → (mean, covariance), by the rule and by which elements form a Gaussian of their own
        self._built: dict[tuple[str, tuple[tuple[int, ...], ...]], FlatFunction] = {}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The weights of both networks."""
        if self.error == "none":
            return self._mean.parameters
        return (*self._mean.parameters, *self._error.parameters, self._error_scale)

    @property
    def spreads(self) -> tuple[Parameter, ...]:
        """The scale of σ."""
        return () if self.error == "none" else (self._error_scale,)

    def propagate(self, inputs: Mapping[str, Gaussian]) -> dict[str, Gaussian]:
        """Return the Gaussians of what it writes, as expressions of its parameters."""
        y, covariance = self._moments(*self._stacked(inputs))
        edges = itertools.accumulate(self.writes.values(), initial=0)
        parts = zip(self.writes, itertools.pairwise(edges), strict=True)
        return {label: Gaussian(y[begin:end], covariance(begin, end)) for label, (begin, end) in parts}

    def predict(self, mean: Any, covariance: Any = None) -> tuple[Array, Array]:
        """Return mean and covariance of the outputs.

        Args:
            mean: (n,) or (N, n) inputs, in the order of `reads`.
            covariance: (n, n), or (N, n, n), of the inputs; left out: exact, as is a label whose rows are 0.

        Returns:
            (m,) and (m, m), or (N, m) and (N, m, m), in the order of `writes`.

        Raises:
            InputError: arrays of other shapes, or no covariances.
        """
        n, m = self._mean.sizes[0], self._mean.sizes[-1]
        single = np.ndim(mean) == 1
        x = checked_rows([mean] if single else mean, n, f"{self.name}: mean")
        if covariance is None:
            y, spread = self._mean(x), self._variance(x)[:, :, None] * np.eye(m)
        else:
            sigma = self._checked_covariances(covariance, len(x), single)
            shared = [p.value.ravel(order="F") for p in self.parameters]
            rows = [self._numbers(block)([row, block.ravel(), *shared]) for row, block in zip(x, sigma, strict=True)]
            y, spread = np.array([row[0] for row in rows]), np.array([row[1].reshape(m, m) for row in rows])
        return (y[0], spread[0]) if single else (y, spread)

    def fit(self, x: Any, y: Any, *, seed: int = 0, progress: bool = True) -> FitReport:
        """Learn from samples; a further call goes on from the weights there are.

        Args:
            x: (N, n) inputs in the order of `reads` [their units].
            y: (N, m) outputs in the order of `writes` [their units].
            seed: of all that is random: the same samples, seed and fits before give the same weights.
            progress: show a progress bar where it takes longer than two seconds.

        Raises:
            InputError: arrays of other shapes, or numbers that are not finite.
            MissingExtraError: torch is not installed.
        """
        begin = time.perf_counter()
        rng = checked_seed(seed, self.name)
        x = checked_rows(x, self._mean.sizes[0], f"{self.name}: x")
        y = checked_rows(y, self._mean.sizes[-1], f"{self.name}: y")
        checked_pair(x, y, self.name)
        scaling = Scaling.of(x, self._resolutions), Scaling.of(y)
        kept = self._experience
        mean_learner, error_learner, error = kept.mean_learner.copied(), kept.error_learner.copied(), kept.error
        with Progress(f"fitting {self.name}", progress) as bar:
            plan = mean_learner.plan(x, y)
            mean, trained = mean_learner.fit(
                kept.mean,
                self._mean.sizes,
                x,
                y,
                scaling,
                losses.squares,
                plan,
                rng,
                bar,
                linear=self.start == "linear",
                decay=self.decay,
            )
            fitted = Perceptron(self._mean.sizes, "fitted")
            fitted.set(mean.copies, *scaling)
            held_out = scaling[1](y) - trained.outputs
            steps: tuple[int, ...] = (trained.steps,)
            if self.error != "none":
                rows, errors = self._errors(scaling[1](y) - scaling[1](fitted(x)), held_out)
                error_plan = error_learner.plan(x[rows], y[rows], warm=plan.warm and error is not None)
                error, made = self._fit_error(x[rows], errors, scaling[0], error_learner, error_plan, rng, bar)
                steps += (made,)
        # Only now, so that a fit that was interrupted has changed nothing.
        self._mean.set(mean.copies, *scaling)
        if error is not None and self.error != "none":
            self._error.set(error.copies, scaling[0], None)
            self._error_scale.value = scaling[1].divisor
        kept.mean_learner, kept.error_learner, kept.mean, kept.error = mean_learner, error_learner, mean, error
        kept.samples = len(x)
        rmse = np.sqrt(np.nanmean(held_out**2, axis=0)) * scaling[1].divisor
        return FitReport(len(x), plan.warm, steps, rmse, time.perf_counter() - begin)

    def _errors(self, seen: Array, held_out: Array) -> tuple[npt.NDArray[np.intp], Array]:
        """Return which samples σ is learned from, and the errors there [standard deviations of the targets].

        Args:
            seen: (N, m) errors of the network that has learned from all samples.
            held_out: (N, m) errors of those that have not seen the sample, NaN where all have.
        """
        if self.error == "paper":
            return np.arange(len(seen)), np.abs(seen)
        rows = np.flatnonzero(~np.isnan(held_out).any(axis=1))
        return rows, held_out[rows]

    def _fit_error(
        self,
        x: Array,
        errors: Array,
        scaling: Scaling,
        learner: Learner,
        plan: Schedule,
        rng: np.random.Generator,
        bar: Progress,
    ) -> tuple[Memory, int]:
        """Learn σ from errors (N, m), and return where its network stands and the steps that it took."""
        likelihood = self.error == "likelihood"
        # From the errors' size, the same everywhere, it can only get better.
        size = np.sqrt(np.mean(errors**2, axis=0)) + 1e-9  # softplus is never 0
        memory, trained = learner.fit(
            self._experience.error,
            self._error.sizes,
            x,
            errors,
            (scaling, None),
            losses.gaussian if likelihood else losses.asymmetric,
            plan,
            rng,
            bar,
            losses.inverse_softplus(size) if likelihood else size,
        )
        return memory, trained.steps

    def _checked_covariances(self, given: Any, count: int, single: bool) -> Array:
        """Return covariances (count, n, n); raise InputError where they are none."""
        n = self._mean.sizes[0]
        place = f"{self.name}: covariance"
        try:
            sigma = as_numbers(given, place)
            if sigma.shape == (n, n):
                return np.broadcast_to(as_covariance(sigma, n, self.name), (count, n, n))
            if single or sigma.shape != (count, n, n):
                expected = f"({n}, {n})" + ("" if single else f" or ({count}, {n}, {n})")
                raise InputError(f"{place} has shape {sigma.shape}; give {expected}")
            return np.array([as_covariance(one, n, f"{self.name}: row {i}") for i, one in enumerate(sigma)])
        except SlotError as error:
            raise InputError(str(error)) from None

    def _variance(self, x: Array) -> Array:
        """Return σ² (N, m) at exact inputs (N, n)."""
        if self.error == "none":
            return np.zeros((len(x), self._mean.sizes[-1]))
        output = self._error(x)
        sd = output if self.error == "paper" else np.logaddexp(0.0, output) + losses.LEAST_DEVIATION
        return (sd * self._error_scale.value[:, 0]) ** 2

    def _moments(self, mean: ca.MX, root: ca.MX | None) -> tuple[ca.MX, Callable[[int, int], ca.MX]]:
        """Return the outputs' mean (m, 1), and their covariance from one to another, given N(mean, root rootᵀ)."""
        passed = pass_through(self.propagation, self._mean.layers, mean, root)
        if self.error == "none":
            return passed.mean, passed.covariance
        errors = pass_through(self.propagation, self._error.layers, mean, root)
        scale = self._error_scale.symbol
        variance = (errors.mean**2 if self.error == "paper" else _expected_square(errors)) * scale**2
        return passed.mean, lambda begin, end: passed.covariance(begin, end) + ca.diag(variance[begin:end])

    def _numbers(self, covariance: Array) -> FlatFunction:
        """Return the function that predicts for a covariance (n, n) of this structure: what a graph would compute."""
        edges = np.cumsum([0, *self.reads.values()]).tolist()
        labels = [list(range(a, b)) for a, b in itertools.pairwise(edges)]
        uncertain = [rows for rows in labels if covariance[rows].any()]
        if any(covariance[np.ix_(a, b)].any() for a, b in itertools.combinations(uncertain, 2)):
            uncertain = [
                [i for rows in uncertain for i in rows]
            ]  # labels that depend on each other, which a graph's never do
        key = self.propagation, tuple(tuple(rows) for rows in uncertain)
        if key not in self._built:
            n = self._mean.sizes[0]
            mean, sigma = ca.MX.sym("mean", n), ca.MX.sym("sigma", n, n)
            places = [ca.sparsify(ca.DM(np.eye(n)[:, rows])) for rows in uncertain]
            roots = [
                ca.mtimes(place, square_root(sigma[rows, rows])) for place, rows in zip(places, uncertain, strict=True)
            ]
            y, spread = self._moments(mean, ca.horzcat(*roots) if roots else None)
            moments = y, spread(0, y.numel())
            symbols = [mean, sigma, *(p.symbol for p in self.parameters)]
            self._built[key] = FlatFunction(ca.Function("predict", symbols, [ca.densify(part) for part in moments]))
        return self._built[key]

    @property
    def settings(self) -> dict[str, Any]:
        settings = (
            "name",
            "reads",
            "writes",
            "hidden",
            "propagation",
            "error",
            "start",
            "decay",
            "samples_needed",
            "resolution",
        )
        return {name: getattr(self, name) for name in settings}

    @classmethod
    def _layout(cls, settings: Mapping[str, Any]) -> Layout:
        sizes = layer_sizes(settings, sum(checked_sizes(settings["writes"], "writes").values()))
        if settings["error"] == "none":
            return Layout(layer_shapes("mean", sizes), {"mean": (sizes, True)})
        parameters = layer_shapes("mean", sizes) | layer_shapes("error", sizes) | {"error.scale": (sizes[-1], 1)}
        return Layout(parameters, {"mean": (sizes, True), "error": (sizes, False)})

    @property
    def _networks(self) -> dict[str, tuple[Learner, Memory | None]]:
        kept = self._experience
        networks = {"mean": (kept.mean_learner, kept.mean), "error": (kept.error_learner, kept.error)}
        return {name: networks[name] for name in self._layout(self.settings).networks}

    def _resume(self, samples: int, networks: Mapping[str, tuple[Learner, Memory | None]]) -> None:
        kept = self._experience
        kept.samples = samples
        kept.mean_learner, kept.mean = networks["mean"]
        if "error" in networks:
            kept.error_learner, kept.error = networks["error"]

    def __getstate__(self) -> dict[str, Any]:  # CasADi's functions are built anew, with the parameters' new symbols
        return {**self.__dict__, "_built": {}}


def _expected_square(errors: Mixture) -> ca.MX:
    """Return E[σ²] (m, 1) with σ = softplus(h) + least and h from the mixture, by Gauss–Hermite over each h."""
    if errors.variances is None:
        squares = _deviation(errors.means) ** 2
    else:
        rule = gauss_hermite(1, HERMITE)
        spread = ca.sqrt(errors.variances + 1e-16)
        squares = sum(
            (
                w * _deviation(errors.means + z * spread) ** 2
                for z, w in zip(rule.points[0].tolist(), rule.weights.tolist(), strict=True)
            ),
            ca.MX(0.0),
        )
    return squares if len(errors.weights) == 1 else ca.mtimes(squares, ca.DM(errors.weights))


def _deviation(output: ca.MX) -> ca.MX:
    above = ca.fmax(output, 0.0)
    return ca.log1p(ca.exp(output - 2 * above)) + above + losses.LEAST_DEVIATION
