"""BranchNetwork: which branch of a chance happens, learned from what did."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from symgraph.cubature import gauss_hermite, quasi_random, square_root
from symgraph.errors import InputError, did_you_mean, names
from symgraph.learned import losses
from symgraph.learned.base import Experience, LearnedModel, layer_sizes
from symgraph.learned.gaussians import Mixture, pass_through
from symgraph.learned.inputs import checked_rows, checked_seed
from symgraph.learned.learner import Learner, Memory
from symgraph.learned.perceptron import Perceptron, Scaling
from symgraph.learned.snapshot import Layout, layer_shapes
from symgraph.model import Parameter
from symgraph.progress import Progress
from symgraph.slots import Array, Gaussian

HERMITE = {1: 9, 2: 5}  # points for each difference of logits, by their number


@dataclass(frozen=True)
class BranchReport:
    """What a fit did.

    Attributes:
        samples: how many there were.
        warm: whether it went on from the weights of the fit before.
        steps: of the network.
        log_loss: mean of -log(probability of what happened), on samples that were left out.
        seconds: wall time [s].
    """

    samples: int
    warm: bool
    steps: int
    log_loss: float
    seconds: float

    def __str__(self) -> str:
        how = "warm" if self.warm else "from scratch"
        return (
            f"{self.samples} samples, {how}, {self.steps} steps in {self.seconds:.2f} s; "
            f"held-out log loss {self.log_loss:.3g}"
        )


@dataclass
class BranchExperience(Experience):
    """The learner, and where the network stands."""

    learner: Learner = field(default_factory=Learner)
    memory: Memory | None = None


class BranchNetwork(LearnedModel):
    """A network that gives each branch of a chance its probability, for `graph.chance(…, probability=…)`.

    p = softmax(f(x)); for x ~ N(μ, Σ) the expectation E[p] over what is propagated. The probabilities sum
    to 1.

    Args:
        reads: {label: number of elements} of the inputs, in the order of the columns of x.
        branches: the names of the branches.
        hidden: units in each hidden layer.
        propagation: how Gaussians pass, as in `StochasticNetwork`.
        samples_needed: with fewer, plans that need the network explore.
        resolution: {label: standard deviation, a number or one for each element} up to which an input is taken for a
            constant that carries noise, of which nothing is learned; 0 where left out [units of the inputs].
        name: shown in messages and pictures.

    Raises:
        InputError: labels, branches or options that make no network.

    Source: the bifurcation models F^P of Yamaguchi & Atkeson, Humanoids 2016, section II-A.
    """

    def __init__(
        self,
        reads: Mapping[str, int],
        branches: Sequence[str],
        hidden: Sequence[int] = (200, 200),
        *,
        propagation: str = "auto",
        samples_needed: int = 3,
        resolution: Mapping[str, Any] | None = None,
        name: str = "branches",
    ) -> None:
        super().__init__(reads, hidden, propagation, samples_needed, resolution, name)
        listed = tuple(branches) if isinstance(branches, Sequence) and not isinstance(branches, str) else ()
        if not all(isinstance(b, str) and b for b in listed) or len(set(listed)) < max(2, len(listed)):
            raise InputError(f"{self.name}: branches = {branches!r}; give two or more different names")
        self.writes = listed
        self._logits = Perceptron((sum(self.reads.values()), *self.hidden, len(listed)), self.name)
        self._experience: BranchExperience = BranchExperience()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The weights of the network."""
        return self._logits.parameters

    def propagate(self, inputs: Mapping[str, Gaussian]) -> dict[str, Gaussian]:
        """Return {branch: its probability}, as expressions of its parameters."""
        p = _expected_softmax(pass_through(self.propagation, self._logits.layers, *self._stacked(inputs)))
        return {branch: Gaussian(p[i]) for i, branch in enumerate(self.writes)}

    def predict(self, mean: Any) -> Array:
        """Return the probabilities (N, branches) at exact inputs (N, n), or (branches,) at (n,).

        Raises:
            InputError: an array of another shape.
        """
        single = np.ndim(mean) == 1
        logits = self._logits(checked_rows([mean] if single else mean, self._logits.sizes[0], f"{self.name}: mean"))
        likelihoods = np.exp(logits - logits.max(axis=1, keepdims=True))
        p: Array = likelihoods / likelihoods.sum(axis=1, keepdims=True)
        return p[0] if single else p

    def fit(self, x: Any, happened: Sequence[str], *, seed: int = 0, progress: bool = True) -> BranchReport:
        """Learn from what happened; a further call goes on from the weights there are.

        Args:
            x: (N, n) inputs in the order of `reads` [their units].
            happened: N names of branches.
            seed: of all that is random.
            progress: show a progress bar where it takes longer than two seconds.

        Raises:
            InputError: arrays of other shapes, numbers that are not finite, unknown branches.
            MissingExtraError: torch is not installed.
        """
        begin = time.perf_counter()
        rng = checked_seed(seed, self.name)
        x = checked_rows(x, self._logits.sizes[0], f"{self.name}: x")
        if isinstance(happened, str) or not all(isinstance(b, str) for b in happened):
            shown = repr(happened) if isinstance(happened, str) else repr(list(happened)[:3])[:60]
            raise InputError(
                f"{self.name}: happened = {shown} …; give a name for each row of x. Branches: {names(self.writes)}"
            )
        happened = list(happened)
        if len(happened) != len(x):
            raise InputError(f"{self.name}: x has {len(x)} rows, happened {len(happened)} names; give one for each row")
        unknown = [b for b in happened if b not in self.writes]
        if unknown:
            hint = did_you_mean(unknown[0], self.writes)
            row = happened.index(unknown[0])
            raise InputError(
                f"{self.name}: happened[{row}] = {unknown[0]!r} is no branch{hint} Branches: {names(self.writes)}"
            )
        hot = np.array([[float(b == branch) for branch in self.writes] for b in happened])
        scaling = Scaling.of(x, self._resolutions), None
        frequency = (hot.sum(axis=0) + 1.0) / (len(hot) + len(self.writes))  # Laplace's: no branch is impossible
        learner = self._experience.learner.copied()
        with Progress(f"fitting {self.name}", progress) as bar:
            plan = learner.plan(x, hot)
            memory, trained = learner.fit(
                self._experience.memory,
                self._logits.sizes,
                x,
                hot,
                scaling,
                losses.cross_entropy,
                plan,
                rng,
                bar,
                np.log(frequency),
            )
        # Only now, so that a fit that was interrupted has changed nothing.
        self._logits.set(memory.copies, *scaling)
        self._experience.learner, self._experience.memory, self._experience.samples = learner, memory, len(x)
        return BranchReport(len(x), plan.warm, trained.steps, trained.loss, time.perf_counter() - begin)

    @property
    def settings(self) -> dict[str, Any]:
        settings = "name", "reads", "hidden", "propagation", "samples_needed", "resolution"
        return {name: getattr(self, name) for name in settings} | {"branches": self.writes}

    @classmethod
    def _layout(cls, settings: Mapping[str, Any]) -> Layout:
        if not isinstance(settings["branches"], list | tuple):
            raise InputError(f"branches is {settings['branches']!r}, and no list")
        sizes = layer_sizes(settings, len(settings["branches"]))
        return Layout(layer_shapes("logits", sizes), {"logits": (sizes, False)})

    @property
    def _networks(self) -> dict[str, tuple[Learner, Memory | None]]:
        return {"logits": (self._experience.learner, self._experience.memory)}

    def _resume(self, samples: int, networks: Mapping[str, tuple[Learner, Memory | None]]) -> None:
        kept = self._experience
        kept.samples = samples
        kept.learner, kept.memory = networks["logits"]


def _expected_softmax(logits: Mixture) -> ca.MX:
    """Return E[softmax] (m, 1).

    Only differences of logits matter, which are one fewer; over each component's they are averaged at points.
    """
    if logits.covariance_of is None:
        return ca.mtimes(_softmax(logits.means), ca.DM(logits.weights))
    m = logits.means.shape[0]
    differences = ca.DM(np.hstack([np.eye(m - 1), -np.ones((m - 1, 1))]))
    rule = gauss_hermite(m - 1, HERMITE[m - 1]) if m - 1 in HERMITE else quasi_random(m - 1)
    middles = ca.mtimes(differences, logits.means)
    columns = []
    for k in range(len(logits.weights)):
        root = square_root(ca.mtimes([differences, logits.covariance_of(k), differences.T]))
        columns.append(ca.repmat(middles[:, k], 1, len(rule.weights)) + ca.mtimes(root, ca.DM(rule.points)))
    joined = ca.horzcat(*columns)
    weights = ca.DM(np.kron(logits.weights, rule.weights))
    return ca.mtimes(_softmax(ca.vertcat(joined, ca.MX(1, joined.shape[1]))), weights)


def _softmax(columns: ca.MX) -> ca.MX:
    """Return the softmax of each column, the largest of which is taken out so that nothing overflows."""
    rows = ca.vertsplit(columns)
    largest = rows[0]
    for row in rows[1:]:
        largest = ca.fmax(largest, row)
    likelihoods = ca.exp(columns - ca.repmat(largest, len(rows), 1))
    return likelihoods / ca.repmat(ca.sum1(likelihoods), len(rows), 1)
