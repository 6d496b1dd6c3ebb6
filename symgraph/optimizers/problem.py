"""What an optimizer sees of a task, a box of actions with values and gradients, and what it returns."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from symgraph.compile.kernel import NEVER, BoundKernel, Ended, Outcome, Stop
from symgraph.optimizers.constrained import Constrained
from symgraph.optimizers.draws import distinct, generator, latin_hypercubes, normal
from symgraph.progress import Progress
from symgraph.situation import Situation
from symgraph.slots import Array, Choices

SCALE_SAMPLES = 32
FEWEST_SAMPLES = 16
SAME = 1e-6  # breaches that differ by less are equal
EQUAL = 1e-12  # and values
GUESS_COMBINATIONS = 1024  # of selections that a guess leaves out


@dataclass(frozen=True)
class Problem:
    """Maximise the kernel's value over a box of actions and the allowed choices.

    Attributes:
        kernel: values, gradients and local search, bound to the start state.
        situation: that state, with the symbolic expression behind it.
        low, high: (n,) bounds of the stacked actions; a held action has low = high.
        sizes: number of choices of each selection.
        allowed: for each selection, the choices that are not ruled out.
        cut: choices (s,) → the situation with the tree that they leave.
        guesses: start points from the user, each (n,) actions (NaN: not given) and (s,) choices (-1: not given).
        progress: to report to.
        constrained: the requirements, None if there are none.
        stop: set when time is over: searches end with what they have.
    """

    kernel: BoundKernel
    situation: Situation
    low: Array
    high: Array
    sizes: tuple[int, ...]
    allowed: tuple[tuple[int, ...], ...]
    cut: Callable[[Choices], Situation]
    guesses: tuple[tuple[Array, Choices], ...] = ()
    progress: Progress = field(default_factory=lambda: Progress("planning", shown=False))
    constrained: Constrained | None = None
    stop: Stop = NEVER
    _scales: dict[bytes, float] = field(default_factory=dict)

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

    def merits(self, points: Array, choices: Choices, values: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Judge samples by what a search from there may come to.

        Args:
            points: (P, n).
            choices: (P, s).
            values: (P,) of J.

        Returns:
            values less penalties for requirements that are missed (P,), and which points meet all (P,).
        """
        if self.constrained is None:
            return values, np.ones(len(points), dtype=bool)
        hot, met = self.one_hot(choices), np.zeros(len(points), dtype=bool)
        margins = np.full((len(points), self.constrained.count), np.nan)
        for p in range(len(points)):
            if p and self.stop:
                break
            margins[p] = self.constrained.margins(points[p : p + 1], hot[p : p + 1])[0]
        penalties = np.zeros(len(points))
        groups, which = np.unique(choices, axis=0, return_inverse=True)
        for g, group in enumerate(groups):
            rows = which.ravel() == g
            self.know(group)
            penalties[rows] = self.constrained.penalty(margins[rows], group, self.scale(group))
            met[rows] = self.constrained.share(margins[rows], group) <= 0.0
        return np.where(np.isfinite(penalties), values - penalties, -np.inf), met

    def most_promising(self, points: Array, choices: Choices) -> int:
        """Return which of points (P, n) under choices (P, s) a single search starts from."""
        merits, met = self.merits(points, choices, self.values(points, choices))
        return int(np.lexsort((-merits, ~met))[0])

    def kernel_for(self, choice: Choices) -> BoundKernel:
        """Return the kernel that a search without constraints climbs under choices (s,): J, less penalties."""
        if self.constrained is None:
            return self.kernel
        self.know(choice)
        return self.constrained.penalised(choice, self.scale(choice))

    def judge(self, run: Run) -> Run:
        """Give a run under constraints the value of J, and say what it misses."""
        if self.constrained is None:
            return run
        self.know(run.choices)
        run.value = float(self.values(run.point[None], run.choices[None])[0])
        breaches = self.constrained.breaches(run.point, run.choices, self.one_hot(run.choices[None])[0])
        run.missed = float(breaches.max(initial=0.0))
        return run

    def know(self, choice: Choices) -> None:
        """Find out the units of requirements under choices (s,)."""
        if self.constrained is not None and not self.constrained.knows(choice):
            points = self.draw_points(generator(0), SCALE_SAMPLES, "spread")
            hot = np.tile(self.one_hot(choice[None]), (SCALE_SAMPLES, 1))
            self.constrained.learn(choice, self.constrained.margins(points, hot))

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

    def scale(self, choice: Choices) -> float:
        """Return the size of the differences of J that matter under choices (s,): the spread of samples [reward].

        Tolerances are relative to it, so that scaling the rewards, or adding a constant to them, changes nothing; it is
        taken for each combination of selections, since those may differ by far more than the actions can change.
        """
        if choice.tobytes() not in self._scales:
            points = self.draw_points(generator(0), SCALE_SAMPLES, "spread")
            self.remember_scale(choice, self.values(points, np.tile(choice, (SCALE_SAMPLES, 1))))
        return self._scales.setdefault(choice.tobytes(), 1.0)

    def remember_scale(self, choice: Choices, values: Array) -> None:
        """Take the scale of choices (s,) from sampled values, if they are enough."""
        finite = np.sort(values[np.isfinite(values)])
        n = len(finite)
        if n < FEWEST_SAMPLES:
            return
        # The middle half, or the whole range where there is a peak on a plain.
        spread = float(finite[-1 - n // 4] - finite[n // 4]) or float(finite[-1] - finite[0])
        self._scales[choice.tobytes()] = spread or 1.0

    def draw_choices(self, rng: np.random.Generator, count: int, evenly: bool) -> Choices:
        """Draw choices (count, s): evenly over the combinations, or independently and uniformly."""
        if not evenly or self.combinations > 10**9:
            sizes = np.array([len(choices) for choices in self.allowed], dtype=np.int64)
            places = (rng.random((count, len(sizes))) * sizes).astype(np.int64)
            columns = [np.asarray(choices)[places[:, s]] for s, choices in enumerate(self.allowed)]
            return np.array(columns, dtype=np.int64).reshape(len(self.allowed), count).T
        repeats, rest = divmod(count, self.combinations)
        partial = distinct(rng, self.combinations, rest)
        codes = np.concatenate([np.tile(np.arange(self.combinations), repeats), partial]) if repeats else partial
        return self.decode(codes)

    def decode(self, codes: npt.NDArray[np.int64]) -> Choices:
        """Turn numbers in [0, combinations) into choices (P, s)."""
        choices = np.zeros((len(codes), len(self.allowed)), dtype=np.int64)
        for s, allowed in enumerate(self.allowed):
            codes, digit = np.divmod(codes, len(allowed))
            choices[:, s] = np.asarray(allowed)[digit]
        return choices

    def draw_points(self, rng: np.random.Generator, count: int, sampling: str, blocks: int = 1) -> Array:
        """Draw points (blocks · count, n).

        Args:
            rng: source of randomness.
            count: how many in a block.
            sampling: "uniform"; "gaussian", around the middle with a quarter of the range as standard deviation,
                clipped; or "spread", each block a Latin hypercube.
            blocks: how many blocks, one after the other.
        """
        span = self.high - self.low
        shape = (blocks, count, self.n)
        if sampling == "gaussian":
            points = (self.low + self.high) / 2 + span / 4 * normal(rng, math.prod(shape)).reshape(shape)
        elif sampling == "spread":
            points = self.low + span * latin_hypercubes(rng, blocks, count, self.n)
        else:
            points = self.low + span * rng.random(shape)
        return np.clip(points, self.low, self.high).reshape(blocks * count, self.n)

    def started_from_guesses(self, rng: np.random.Generator) -> tuple[Array, Choices]:
        """Return the guesses as points (P, n) and choices (P, s).

        Actions that they leave out are drawn at random, selections are those with the best value there.
        """
        count = len(self.guesses)
        points, choices = self.draw_points(rng, count, "uniform"), np.zeros((count, len(self.allowed)), dtype=np.int64)
        for i, (point, choice) in enumerate(self.guesses):
            points[i] = np.where(np.isnan(point), points[i], np.clip(point, self.low, self.high))
            tried = self.draw_choices(rng, min(self.combinations, GUESS_COMBINATIONS), evenly=True)
            tried = np.unique(np.where(choice < 0, tried, choice), axis=0)
            if len(tried) > 1:
                tried = tried[[self.most_promising(np.tile(points[i], (len(tried), 1)), tried)]]
            choices[i] = tried[0]
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
        missed: the largest breach of a requirement, in the unit of its model, 0 if it is rounding.
    """

    start: Array
    point: Array
    choices: Choices
    value: float
    outcome: Outcome
    history: Array
    missed: float = 0.0

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
    """Return the run with the highest finite value of those that meet all requirements, the first of equals.

    If none does, the one whose largest breach is least, of equal ones that with the highest value. Values that differ
    by rounding alone are equal: which run a plan comes from must not depend on the machine.
    """
    best: Run | None = None
    for run in runs:
        if np.isfinite(run.value) and not np.isnan(run.missed) and (best is None or _is_better(run, best)):
            best = run
    return best


def _is_better(run: Run, best: Run) -> bool:
    if run.missed > best.missed * (1.0 + SAME):
        return False
    fewer = best.missed > run.missed * (1.0 + SAME)
    return fewer or run.value > best.value + EQUAL * abs(best.value)
