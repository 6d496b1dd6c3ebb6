"""What an optimizer sees of a task, a box of actions with values and gradients, and what it returns."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from symgraph.compile.kernel import BoundKernel, Ended, Outcome
from symgraph.objective import Situation
from symgraph.progress import Progress
from symgraph.slots import Array

SCALE_SAMPLES = 64

Choices = npt.NDArray[np.int64]  # (P, number of selections): which choice of each selection, a row per point


@dataclass(frozen=True)
class Problem:
    """Maximise the kernel's value over a box of actions and the allowed choices.

    Attributes:
        kernel: values, gradients and local search, bound to the start state.
        situation: that state, with the symbolic expression behind it.
        low, high: (n,) bounds of the stacked actions; a held action has low = high.
        sizes: number of choices of each selection.
        allowed: for each selection, the choices that are not ruled out.
        guesses: start points from the user, each (n,) actions (NaN: not given) and (s,) choices (-1: not given).
        progress: to report to.
    """

    kernel: BoundKernel
    situation: Situation
    low: Array
    high: Array
    sizes: tuple[int, ...]
    allowed: tuple[tuple[int, ...], ...]
    guesses: tuple[tuple[Array, Choices], ...] = ()
    progress: Progress = field(default_factory=lambda: Progress("planning", shown=False))

    @property
    def n(self) -> int:
        return self.low.size

    @property
    def combinations(self) -> int:
        """Number of combinations of allowed choices."""
        return math.prod(len(choices) for choices in self.allowed)

    def values(self, points: Array, choices: Choices) -> Array:
        """Return the values (P,) of points (P, n) under choices (P, s), -inf where they are not finite."""
        values, _ = self.kernel.evaluate(points, self.one_hot(choices))
        return np.where(np.isfinite(values), values, -np.inf)

    def one_hot(self, choices: Choices) -> Array:
        """Return (P, Σ sizes) one-hot rows."""
        hot = np.zeros((len(choices), sum(self.sizes)))
        rows = np.arange(len(choices))
        offset = 0
        for s, size in enumerate(self.sizes):
            hot[rows, offset + choices[:, s]] = 1.0
            offset += size
        return hot

    def unit(self, points: Array) -> Array:
        """Scale points to [0, 1] within the bounds; held actions become 0."""
        span = self.high - self.low
        return (points - self.low) / np.where(span > 0.0, span, 1.0)

    @cached_property
    def scale(self) -> float:
        """Size of the differences of J that matter here: the middle half of sampled values spans it [reward].

        Tolerances are relative to it, so that scaling the rewards, or adding a constant to them, changes nothing.
        """
        rng = np.random.default_rng(0)
        choices = self.draw_choices(rng, SCALE_SAMPLES, evenly=True)
        values = np.sort(self.values(self.draw_points(rng, SCALE_SAMPLES, "spread"), choices))
        finite = values[np.isfinite(values)]
        for share in (4, SCALE_SAMPLES):  # a peak on a plain: then the whole range
            spread = finite[-1 - len(finite) // share] - finite[len(finite) // share] if len(finite) else 0.0
            if spread > 0.0:
                return float(spread)
        return 1.0

    def draw_choices(self, rng: np.random.Generator, count: int, evenly: bool) -> Choices:
        """Draw choices (count, s): evenly over the combinations, or independently and uniformly."""
        if not evenly or self.combinations > 10**9:
            columns = [rng.choice(choices, size=count) for choices in self.allowed]
            return np.array(columns, dtype=np.int64).reshape(len(self.allowed), count).T
        repeats, rest = divmod(count, self.combinations)
        partial = rng.choice(self.combinations, size=rest, replace=False) if rest else np.zeros(0, dtype=np.int64)
        codes = np.concatenate([np.tile(np.arange(self.combinations), repeats), partial]) if repeats else partial
        return self.decode(codes)

    def decode(self, codes: npt.NDArray[np.int64]) -> Choices:
        """Turn numbers in [0, combinations) into choices (P, s)."""
        choices = np.zeros((len(codes), len(self.allowed)), dtype=np.int64)
        for s, allowed in enumerate(self.allowed):
            codes, digit = np.divmod(codes, len(allowed))
            choices[:, s] = np.asarray(allowed)[digit]
        return choices

    def draw_points(self, rng: np.random.Generator, count: int, sampling: str) -> Array:
        """Draw points (count, n).

        Args:
            rng: source of randomness.
            count: how many.
            sampling: "uniform"; "gaussian", around the middle with a quarter of the range as standard deviation,
                clipped; or "spread", a Latin hypercube (McKay, Beckman & Conover 1979).
        """
        if sampling == "gaussian":
            points = (self.low + self.high) / 2 + (self.high - self.low) / 4 * rng.standard_normal((count, self.n))
            return np.clip(points, self.low, self.high)
        unit = rng.random((count, self.n))
        if sampling == "spread":
            ranks = rng.permuted(np.tile(np.arange(count)[:, None], (1, self.n)), axis=0)
            unit = (ranks + unit) / count
        return np.clip(self.low + (self.high - self.low) * unit, self.low, self.high)

    def started_from_guesses(self, rng: np.random.Generator) -> tuple[Array, Choices]:
        """Return the guesses as points (P, n) and choices (P, s), what they leave out drawn at random."""
        count = len(self.guesses)
        points, choices = self.draw_points(rng, count, "uniform"), self.draw_choices(rng, count, evenly=False)
        for i, (point, choice) in enumerate(self.guesses):
            points[i] = np.where(np.isnan(point), points[i], np.clip(point, self.low, self.high))
            choices[i] = np.where(choice < 0, choices[i], choice)
        return points, choices


@dataclass
class Run:
    """What became of one start point.

    Attributes:
        start: (n,) actions at the start.
        point: (n,) actions at the end.
        choices: (s,) the selections, which a run keeps.
        value: the expected reward at `point`, -inf where nothing finite was met.
        outcome: why it ended.
        history: the values on the way, one per gradient.
    """

    start: Array
    point: Array
    choices: Choices
    value: float
    outcome: Outcome
    history: Array

    @classmethod
    def of(cls, start: Array, choices: Choices, ended: Ended) -> Run:
        return cls(start, ended.point, choices, ended.value, ended.outcome, ended.history)


@dataclass
class Search:
    """All runs of an optimizer and, where it was cut short, what cut it short."""

    runs: list[Run]
    status: str
    interrupted: bool = False


class Optimizer(ABC):
    """A way to find good actions and selections: one method, from a problem to its runs."""

    @abstractmethod
    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        """Search for the maximum; a KeyboardInterrupt ends it with the runs so far."""


def best_of(runs: Sequence[Run]) -> Run | None:
    """Return the run with the highest finite value, the first of equals."""
    finite = [run for run in runs if np.isfinite(run.value)]
    return max(finite, key=lambda run: run.value) if finite else None
