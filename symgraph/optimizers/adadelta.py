"""ADADELTA from many start points that wait in a queue: the optimizer of the paper, section II-D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symgraph.compile.kernel import AdadeltaSteps, BoundKernel
from symgraph.errors import InputError
from symgraph.optimizers.draws import below, normal
from symgraph.optimizers.problem import Optimizer, Problem, Run, Search, best_of
from symgraph.optimizers.settings import number, positive_whole
from symgraph.optimizers.starts import climbed, promising_points, status_of

SMALLEST_EPSILON = 1e-300  # 0 would keep every point where it is
SAMPLES_PER_COMBINATION = 8
POLISHED = 2  # best runs of each combination of selections that are polished
POLISH_ITERATIONS = 200
CONSTRAINED_ITERATIONS = 2000  # where one climb follows the other until requirements are met


@dataclass(frozen=True)
class Adadelta(Optimizer):
    """Multi-start ADADELTA with a start-point queue and a list of finished points.

    A point is taken from the queue, moved for at most `run_iterations` steps and ends a run (1) converged:
    0 ≤ J_new − J < tolerance, (2) at the iteration limit, or (3) oscillating: `oscillation` steps lowered J.
    Case (1) joins the finished list, (2) and (3) only when better than all so far; with `requeue`, every point then
    goes back to the queue. The search ends when (a) `finished` points are finished, (b) the queue is empty, or
    (c) `total_iterations` are spent. From a queue that points come back to, the next is the best point (probability
    0.4), a random one (0.3), or else the worst is dropped for a perturbed copy of the best finished point.

    The defaults go beyond the paper where measurement showed gain: steps in units of the bounds' range, starts spread
    evenly over selections and bounds, one longer run for each, the best iterate instead of the last, a polish by L-BFGS
    before selections are compared. `Adadelta.paper()` has the paper's settings.

    Args:
        starts: start points.
        decay: ρ of ADADELTA.
        epsilon: ε of ADADELTA [range² if scaled, else unit²]; sets the first steps, about √(ε/(1 − ρ)).
        run_iterations: steps of one run.
        total_iterations: steps of all runs together; default starts · run_iterations.
        finished: finished points wanted; default all starts.
        tolerance: gain below which a step counts as converged [the spread of J over the bounds if scaled, else reward].
        oscillation: falling steps that end a run.
        sampling: "spread" (Latin hypercube), "uniform" or "gaussian" (around the middle, a quarter of the range).
        evenly: spread the starts evenly over the combinations of selections; else uniformly at random.
        requeue: points go back to the queue after a run; else each start has one run.
        scaled: actions in units of the bounds' range and rewards in units of the spread of J over the bounds.
        keep_best: a run's result is its best iterate; else its last.
        polish: climb on from the best runs of each combination with L-BFGS.
        start_per_selection: one more start for each selection variable, as in the paper.

    Source: Yamaguchi & Atkeson, Humanoids 2016, section II-D; Zeiler, arXiv:1212.5701 (ADADELTA).
    """

    starts: int = 20
    decay: float = 0.9
    epsilon: float = 1e-4
    run_iterations: int = 300
    total_iterations: int | None = None
    finished: int | None = None
    tolerance: float = 1e-10
    oscillation: int = 10
    sampling: str = "spread"
    evenly: bool = True
    requeue: bool = False
    scaled: bool = True
    keep_best: bool = True
    polish: bool = True
    start_per_selection: bool = False

    @classmethod
    def paper(cls) -> Adadelta:
        """Return the settings behind the paper's results."""
        return cls(
            starts=20,
            decay=0.98,
            epsilon=1e-6,
            run_iterations=50,
            total_iterations=2000,
            finished=20,
            tolerance=1e-6,
            oscillation=10,
            sampling="uniform",
            evenly=False,
            requeue=True,
            scaled=False,
            keep_best=False,
            polish=False,
            start_per_selection=True,
        )

    def __post_init__(self) -> None:
        for name in ("starts", "run_iterations", "oscillation"):
            positive_whole(name, getattr(self, name), "Adadelta")
        for name in ("total_iterations", "finished"):
            if getattr(self, name) is not None:
                positive_whole(name, getattr(self, name), "Adadelta")
        number("decay", self.decay, "Adadelta", 0.0, 1.0)
        number("epsilon", self.epsilon, "Adadelta", SMALLEST_EPSILON)
        number("tolerance", self.tolerance, "Adadelta", 0.0)
        if self.sampling not in ("spread", "uniform", "gaussian"):
            raise InputError(f"Adadelta: sampling = {self.sampling!r}; give 'spread', 'uniform' or 'gaussian'")

    def run(self, problem: Problem, rng: np.random.Generator) -> Search:
        queue = _Queue(self, problem, rng)
        total = self.total_iterations or len(queue.waiting) * self.run_iterations
        wanted = self.finished or len(queue.waiting)
        spent = 0
        ended: list[Run] = []
        finished: list[Run] = []
        interrupted = False
        while (
            len(finished) < wanted
            and queue.waiting
            and spent < total
            and not interrupted
            and not (ended and problem.stop)
        ):
            # Where runs come back to the queue, each decides which one is next.
            affordable = -(-(total - spent) // self.run_iterations)
            batch = queue.pop(1 if self.requeue else min(wanted - len(finished), affordable), finished)
            limit = min(self.run_iterations, max(1, (total - spent) // len(batch)))
            moved, interrupted = self._moved(problem, batch, limit)
            for run in moved:
                spent += len(run.history) - 1
                best = best_of(finished)
                if run.outcome == "converged" or (
                    run.outcome in ("iteration limit", "oscillation") and (best is None or run.value > best.value)
                ):
                    finished.append(run)
                if self.requeue and run.outcome in ("converged", "iteration limit", "oscillation"):
                    queue.waiting.append(run)
            ended += moved
            problem.progress.update(max(spent / total, len(finished) / wanted), 1.0)
        polished: list[Run] = []
        if self.polish and not interrupted and not problem.stop:
            polished, interrupted = self._polished(problem, ended)
        ended = [*map(problem.judge, ended), *polished]
        return Search(ended, status_of(problem, ended), interrupted)

    def _moved(self, problem: Problem, batch: list[Run], limit: int) -> tuple[list[Run], bool]:
        """Move points for at most `limit` steps each; also say whether that was interrupted."""
        steps = AdadeltaSteps(self.decay, self.epsilon, self.tolerance, self.oscillation, self.scaled, self.keep_best)
        moved: dict[int, Run] = {}  # by place in the batch: which one ends first depends on the machine
        try:
            groups: dict[int, tuple[BoundKernel, list[int]]] = {}
            for place, run in enumerate(batch):
                kernel = problem.kernel_for(run.choices)
                groups.setdefault(id(kernel), (kernel, []))[1].append(place)
            for kernel, places in groups.values():
                runs = [batch[place] for place in places]
                points, choices = np.array([run.point for run in runs]), np.array([run.choices for run in runs])
                scales = np.array([problem.scale(run.choices) if self.scaled else 1.0 for run in runs])
                for p, ended in kernel.ascend(points, problem.one_hot(choices), limit, steps, scales):
                    # A point that came back keeps where it first started.
                    moved[places[p]] = Run.of(runs[p].start, runs[p].choices, ended)
                    problem.progress.update(len(moved), len(batch))
        except KeyboardInterrupt:
            return [moved[p] for p in sorted(moved)], True
        return [moved[p] for p in sorted(moved)], False

    @staticmethod
    def _polished(problem: Problem, runs: list[Run]) -> tuple[list[Run], bool]:
        """Climb on from the best runs of each combination of selections; also say whether that was interrupted."""
        by_choice: dict[bytes, list[Run]] = {}
        for run in sorted(runs, key=lambda run: -run.value):
            group = by_choice.setdefault(run.choices.tobytes(), [])
            if np.isfinite(run.value) and len(group) < POLISHED:
                group.append(run)
        chosen = [run for group in by_choice.values() for run in group]
        if not chosen:
            return [], False
        points = np.array([run.point for run in chosen])
        choices = np.array([run.choices for run in chosen])
        iterations = POLISH_ITERATIONS if problem.constrained is None else CONSTRAINED_ITERATIONS
        polished, interrupted = climbed(problem, points, choices, iterations, 1e-9)
        first = {run.point.tobytes() + run.choices.tobytes(): run.start for run in chosen}
        for run in polished:
            run.start = first[run.start.tobytes() + run.choices.tobytes()]
        return polished, interrupted


class _Queue:
    """The start points that wait, fresh ones and those that come back."""

    def __init__(self, settings: Adadelta, problem: Problem, rng: np.random.Generator) -> None:
        self._problem = problem
        self._rng = rng
        count = settings.starts + (len(problem.allowed) if settings.start_per_selection else 0)
        if settings.evenly and problem.combinations > count:  # only the most promising have a start
            points, choices = promising_points(problem, rng, count, SAMPLES_PER_COMBINATION)
        else:
            choices = problem.draw_choices(rng, count, settings.evenly)
            points = problem.draw_points(rng, count, settings.sampling)
        if problem.guesses:
            guessed, guessed_choices = problem.started_from_guesses(rng)
            points, choices = np.concatenate([guessed, points]), np.concatenate([guessed_choices, choices])
        self.starts = len(points)
        values, _ = problem.merits(points, choices, problem.values(points, choices))
        self._in_turn = not settings.requeue
        self.waiting = [
            Run(point, point, choice, float(value), "iteration limit", np.zeros(0))
            for point, choice, value in zip(points, choices, values, strict=True)
        ]

    def pop(self, most: int, finished: list[Run]) -> list[Run]:
        """Take up to `most` points."""
        batch: list[Run] = []
        while self.waiting and len(batch) < most:
            batch.append(self._pop_one(finished))
        return batch

    def _pop_one(self, finished: list[Run]) -> Run:
        if self._in_turn:
            return self.waiting.pop(0)
        draw = self._rng.random()
        if draw < 0.4:
            return self.waiting.pop(int(np.argmax([run.value for run in self.waiting])))
        best = best_of(finished)
        if draw < 0.7 or best is None:
            return self.waiting.pop(below(self._rng, len(self.waiting)))
        self.waiting.pop(int(np.argmin([run.value for run in self.waiting])))
        low, high = self._problem.low, self._problem.high
        noise = 0.001 * (high - low) * normal(self._rng, self._problem.n)
        point = np.clip(best.point + noise, low, high)
        return Run(point, point, best.choices, -np.inf, "iteration limit", np.zeros(0))
