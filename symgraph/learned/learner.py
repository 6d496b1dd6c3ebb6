"""Learner: what a network remembers from one fit to the next, and how it goes on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from symgraph.learned.initialisation import begin_linear, carries_linear, initial_copies, unit_carriers
from symgraph.learned.perceptron import Scaling, rescaled
from symgraph.learned.training import Copies, Folds, Loss, Training, active_folds, default_steps, train
from symgraph.progress import Progress
from symgraph.slots import Array

GROWTH = 1.5  # times the samples of the last fit from scratch at which one begins anew
WARM_SHARE = 0.3  # of the steps from scratch that a warm start takes if at least a tenth of its samples is new
LEAST_WARM = 60  # steps of a warm start, however little is new: ten until the rate is up, and time to come down again


@dataclass
class Memory:
    """Where the last training ended.

    Attributes:
        copies: all of them, also those that leave samples out.
        x, y: the scaling of inputs and targets then.
    """

    copies: Copies
    x: Scaling
    y: Scaling | None


@dataclass(frozen=True)
class Schedule:
    """How one fit goes: the same for all networks of a model."""

    folds: npt.NDArray[np.int64]
    active: int
    warm: bool
    news: float  # share of the samples that no fit has seen


class Learner:
    """Keeps folds and decides, fit by fit, whether to go on from the weights there are.

    A warm start is quick, but networks that began on few samples generalise worse than fresh ones (Ash & Adams, On
    warm-starting neural network training, NeurIPS 2020). So a fit goes on only while two thirds of its samples were
    there at the last fit from scratch.

    Attributes:
        folds: of all samples since the last fit from scratch, those of that fit first.
        begun_with: different samples of that fit.
    """

    def __init__(self) -> None:
        self.folds = Folds()
        self.begun_with = 0

    def copied(self) -> Learner:
        """Return a copy to plan a fit with: an interrupted fit must leave everything as it was."""
        other = Learner()
        other.folds, other.begun_with = Folds(dict(self.folds.known)), self.begun_with
        return other

    def plan(self, *columns: Array, warm: bool | None = None) -> Schedule:
        """Give samples (N, …) their folds, and say how a fit to them goes.

        Args:
            columns: inputs and outputs of the samples.
            warm: whether it goes on from the weights there are; decided by the samples if left out.
        """
        n = len(columns[0])
        if warm is None:
            warm = self.folds.count_first(self.begun_with, *columns) > n / GROWTH
        news = 1 - self.folds.count_first(len(self.folds.known), *columns) / n
        if not warm:
            self.folds = Folds()
        folds = self.folds.assign(*columns)
        if not warm:
            self.begun_with = len(self.folds.known)
        return Schedule(folds, active_folds(n), warm, news)

    def fit(
        self,
        memory: Memory | None,
        sizes: Sequence[int],
        x: Array,
        y: Array,
        scaling: tuple[Scaling, Scaling | None],
        loss: Loss,
        schedule: Schedule,
        rng: np.random.Generator,
        progress: Progress,
        last_bias: Array | None = None,
        *,
        linear: bool = False,
        decay: float = 0.0,
    ) -> tuple[Memory, Training]:
        """Train one network.

        Args:
            memory: from the last fit of this network.
            sizes: of its layers.
            x: (N, n), not scaled.
            y: (N, m), not scaled; as the loss takes it where its scaling is None.
            scaling: of x and y.
            loss: see `train`.
            schedule: of this fit.
            rng: source of randomness.
            progress: to report to.
            last_bias: (m,) where a fit from scratch begins; 0 if left out.
            linear: whether it begins as a ridge regression, if it is wide enough; the targets must be scaled.
            decay: see `train`.
        """
        count = 1 + schedule.active
        linear = linear and carries_linear(sizes)
        # What does not vary has no part in predictions; a network that saw how it deviates would rely on it.
        inputs = np.where(scaling[0].varies, scaling[0](x), 0.0)
        targets = y if scaling[1] is None else scaling[1](y)
        if schedule.warm and memory is not None and memory.copies.count >= count:
            copies = rescaled(memory.copies.first(count), (memory.x, memory.y), scaling)
            if linear:
                unit_carriers(copies)
        else:
            copies = initial_copies(sizes, inputs, count, rng)
            if last_bias is not None:
                copies.biases[-1][:] = last_bias
            if linear:
                begin_linear(copies, inputs, targets, schedule.folds)
        steps = default_steps(len(x), max(sizes[1:-1], default=100))
        if schedule.warm:
            steps = max(LEAST_WARM, round(WARM_SHARE * min(1.0, 10 * schedule.news) * steps))
        training = train(
            copies, inputs, targets, schedule.folds, loss, steps, rng, progress, decay=decay, linear=linear
        )
        return Memory(training.copies, *scaling), training
